"""All methods by name: ours, and the baselines it is measured against."""

from collections.abc import Callable
from dataclasses import dataclass

from lidarflow import baselines, pipeline
from lidarflow.config import Config
from lidarflow.errors import ConfigError
from lidarflow.pipeline import Estimator
from lidarflow.types import FlowResult, ScanPair

OURS = "ours"


@dataclass(frozen=True, slots=True)
class Method:
    """A way to compute flow.

    estimate  of one pair
    along     a fresh estimator for a sequence
    """

    estimate: Callable[[ScanPair, Config], FlowResult]
    along: Callable[[Config], Estimator]


_BASELINES = (baselines.Zero, baselines.Ego, baselines.Icp, baselines.RansacIcp)
METHODS = {
    OURS: Method(pipeline.estimate_flow, pipeline.FlowEstimator),
    **{baseline.name: Method(baseline.estimate, baseline) for baseline in _BASELINES},
}


def find(name: str) -> Method:
    """The method called `name`; ConfigError, which names the known ones, where there is none."""
    if name not in METHODS:
        raise ConfigError(f"unknown method '{name}'; known are {', '.join(METHODS)}")
    return METHODS[name]
