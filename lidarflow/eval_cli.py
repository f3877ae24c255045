"""The command `lidarflow eval`, for cli.py."""

from pathlib import Path
from typing import Annotated

import typer

from lidarflow.errors import DataError
from lidarflow.terminal import check_exists, show, working


def evaluate(
    what: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="A run folder, or a flow file (.npz).")],
    truth: Annotated[Path | None, typer.Option(
        help="Folder of <scan>.npz with the truth, or one file; that of the data if not given.")] = None,
    data: Annotated[Path | None, typer.Option(help="Where the run's data are now, if they moved.")] = None,
    out: Annotated[Path | None, typer.Option(
        "--out", help="Metrics file (.json) to write; RUN_DIR/metrics.json if not given.")] = None,
) -> None:
    """Score results against the truth."""
    from lidarflow import evaluation, io, score_tables
    from lidarflow.tables import run_table

    check_exists(what, "a run folder or a flow file (.npz)")
    if out is not None:
        io.check_output("--out", out, ".json", inputs=(what,))
    if data is not None and not what.is_dir():
        raise DataError(f"--data {data}: is for a run folder; the flow file {what} needs --truth alone")
    with working(f"scores of {what}"):
        if what.is_dir():
            done = evaluation.evaluate_run(what, truth, data)
            out = out or what / io.METRICS_FILE
        else:
            done = evaluation.evaluate_file(what, truth)
        if out is not None:
            io.write_json(out, done.metrics())
    print(f"results    {what}")
    print(f"truth      {done.truth}, from {done.truth_place}")
    for note in done.notes:
        print(f"note       {note}")
    print()
    for table in (run_table(done.reports, done.config), *score_tables.tables_of(done)):
        show(table)
        print()
    if out is not None:
        print(f"metrics    {out}")
