"""All methods by name: ours, and the baselines it is measured against."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from lidarflow import baselines, pipeline
from lidarflow.config import Config
from lidarflow.errors import ConfigError
from lidarflow.pipeline import Estimator
from lidarflow.settings import to_dict
from lidarflow.types import FlowResult, ScanPair

OURS = "ours"


@dataclass(frozen=True, slots=True)
class Method:
    """A way to compute flow.

    estimate  of one pair
    along     a fresh estimator for a sequence
    settings  sections, and single settings, that it asks for; empty = all
    """

    estimate: Callable[[ScanPair, Config], FlowResult]
    along: Callable[[Config], Estimator]
    settings: tuple[str, ...] = ()


_FOR_SCORES = ("preparation", "ground", "crispness")     # what is counted, whatever the method
_BASELINES = {
    baselines.Zero: (), baselines.Ego: ("ego",), baselines.Icp: (),
    baselines.RansacIcp: ("normals", "shot", "matching", "ego.voxel_m"),
}
METHODS = {
    OURS: Method(pipeline.estimate_flow, pipeline.FlowEstimator),
    **{baseline.name: Method(baseline.estimate, baseline, (*_FOR_SCORES, *settings))
       for baseline, settings in _BASELINES.items()},
}


def find(name: str) -> Method:
    """The method called `name`; ConfigError, which names the known ones, where there is none."""
    if name not in METHODS:
        raise ConfigError(f"unknown method '{name}'; known are {', '.join(METHODS)}")
    return METHODS[name]


def without_effect(names: Sequence[str], config: Config, along: bool = True) -> list[str]:
    """Lines on settings that differ from the defaults for nothing: no method of these `names` asks for them.

    along  whether the methods go along a sequence, or see one pair alone
    """
    used, usual = to_dict(config), to_dict(Config())
    changed = [f"{section}.{name}" for section, values in used.items() for name, value in values.items()
               if value != usual[section][name]]
    unasked = [key for key in changed if not any(_is_among(key, find(name).settings) for name in names)]
    idle = dict.fromkeys(unasked, f"--method {', '.join(names)}")
    for reason, keys in _switched_off(names, config, along):
        idle |= {key: reason for key in changed if key not in idle and _is_among(key, keys)}
    return [f"{', '.join(key for key in idle if idle[key] == reason)}: no effect with {reason}"
            for reason in dict.fromkeys(idle.values())]


def _switched_off(
    names: Sequence[str], config: Config, along: bool
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """What the value of one setting takes the effect from, sections or settings; reasons first."""
    if config.ego.method == "registration":
        yield "ego.method = registration", ("ego.refine",)
    if not along and "ego" not in names:
        yield "a single pair", ("ego.method", "ego.refine")     # nothing comes before it
    if config.objects.enabled:
        yield "objects.enabled = true", ("dynamic",)
    else:
        others = tuple(f"objects.{name}" for name in to_dict(config)["objects"] if name != "enabled")
        yield "objects.enabled = false", (*others, "solver.tie_weight", "solver.tie_truncation")
    if config.refine.rounds == 0:
        yield "refine.rounds = 0", tuple(
            f"refine.{name}" for name in to_dict(config)["refine"] if name != "rounds")


def _is_among(key: str, keys: tuple[str, ...]) -> bool:
    """Whether a setting, or its section, is one of `keys`; none at all stand for every setting."""
    return not keys or key in keys or key.partition(".")[0] in keys
