"""lidarflow: a rigid motion for every LiDAR point between consecutive scans.

What is named here is for programs that use it as a library; the rest may change.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarflow.config import Config, load
    from lidarflow.datasets import open_dataset, read_scan
    from lidarflow.errors import LidarflowError
    from lidarflow.pipeline import FlowEstimator, estimate_flow
    from lidarflow.types import FlowResult, MovingObject, Scan, ScanPair

__version__ = "0.1.0"
__all__ = ["Config", "FlowEstimator", "FlowResult", "LidarflowError", "MovingObject", "Scan", "ScanPair",
           "__version__", "estimate_flow", "load", "open_dataset", "read_scan"]

_HOMES = {
    "Config": "config", "load": "config", "open_dataset": "datasets", "read_scan": "datasets",
    "LidarflowError": "errors", "FlowEstimator": "pipeline", "estimate_flow": "pipeline",
    "FlowResult": "types", "MovingObject": "types", "Scan": "types", "ScanPair": "types"}


def __getattr__(name: str) -> Any:
    """The public names, imported when they are first asked for: the command line must answer at once."""
    if name not in _HOMES:
        raise AttributeError(f"module 'lidarflow' has no attribute '{name}'")
    return getattr(importlib.import_module(f"lidarflow.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
