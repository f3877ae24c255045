"""One self-contained HTML page on one run or several: how well it works, and what moves.

`read_run` takes what a run folder holds; `page_of` is a pure function of that.
"""

from lidarflow.report.page import page_of
from lidarflow.report.reading import Picture, Run, read_run, shown_per_run

__all__ = ["Picture", "Run", "page_of", "read_run", "shown_per_run"]
