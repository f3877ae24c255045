"""Flow files: the answer for one pair with the points it is about, the settings, and what the solver did."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from lidarflow import io, pose
from lidarflow.config import Config
from lidarflow.datasets.clouds import one_line
from lidarflow.errors import DataError
from lidarflow.settings import to_dict
from lidarflow.types import FlowResult, SolveStats

# name: (shape, after N for the arrays with a row per point; dtype kind)
_ROW_ARRAYS = {"flow": ((3,), "f"), "points": ((3,), "f"), "motion": ((7,), "f"), "valid": ((), "b"),
               "in_graph": ((), "b"), "is_dynamic": ((), "b"), "is_ground": ((), "b"), "object": ((), "i"),
               "std": ((), "f")}
_WHOLE_ARRAYS = {"ego_motion": ((4, 4), "f"), "config": ((), "U"), "stats": ((), "U")}


@dataclass(frozen=True, slots=True, eq=False)
class FlowFile:
    """What a flow file holds, rows aligned with the source scan.

    points      (N, 3) float32     the source scan, metres
    flow        (N, 3) float32     metres, total: ego-motion included
    motions     (N, 4, 4) float64  target_from_source of every point
    valid       (N,) bool          the motion rests on evidence
    in_graph    (N,) bool          the motion was solved for
    is_dynamic  (N,) bool          moves over ground by itself
    is_ground   (N,) bool          ground of the static world
    object_id   (N,) int32         the moving object the point is on, -1 = none
    std_m       (N,) float32       standard deviation of the flow, metres; NaN = unknown
    ego_motion  (4, 4) float64     target_from_source of the static world
    config      dict               the settings it was made with
    stats       dict               what the solver did
    """

    points: np.ndarray
    flow: np.ndarray
    motions: np.ndarray
    valid: np.ndarray
    in_graph: np.ndarray
    is_dynamic: np.ndarray
    is_ground: np.ndarray
    object_id: np.ndarray
    std_m: np.ndarray
    ego_motion: np.ndarray
    config: dict
    stats: dict

    def result(self) -> FlowResult:
        """The answer that the file holds, to 32-bit accuracy; without matches, boxes of objects and times."""
        return FlowResult(
            self.flow.astype(np.float64), self.motions, self.valid, self.in_graph, self.is_dynamic,
            self.ego_motion, SolveStats(**self.stats), is_ground=self.is_ground, object_id=self.object_id,
            std_m=self.std_m.astype(np.float64))


def save_flow(path: Path, points: np.ndarray, result: FlowResult, config: Config) -> None:
    """Write a flow file (.npz) of the source scan's `points` (N, 3), metres, and its `result`.

    The same input gives the same bytes. Raises ValueError where points and result differ in length.
    """
    if points.shape != result.flow.shape:
        raise ValueError(f"save_flow: points {points.shape} do not match the flow {result.flow.shape}")
    arrays = {
        "points": points.astype(np.float32),
        "flow": result.flow.astype(np.float32),
        "motion": _rows_of_motions(result.motions),
        "valid": result.valid,
        "in_graph": result.in_graph,
        "is_dynamic": result.is_dynamic,
        "is_ground": result.is_ground,
        "object": result.object_id.astype(np.int32),
        "std": result.std_m.astype(np.float32),
        "ego_motion": result.ego_motion.astype(np.float64),
        "config": np.array(io.as_json(to_dict(config))),
        "stats": np.array(io.as_json(asdict(result.stats))),
    }
    with io.written_aside(path) as aside:
        aside.write_bytes(io.archive(arrays))


def load_flow(path: Path) -> FlowFile:
    """Read a flow file; DataError where it is damaged, or not a flow file."""
    arrays = io.read_archive(Path(path), (*_ROW_ARRAYS, *_WHOLE_ARRAYS))
    count = len(arrays["flow"]) if arrays["flow"].ndim else 0
    for name, (shape, kind) in (_ROW_ARRAYS | _WHOLE_ARRAYS).items():
        expected = (count, *shape) if name in _ROW_ARRAYS else shape
        array = arrays[name]
        if array.shape != expected or array.dtype.kind != kind:
            raise DataError(f"{path}: '{name}' is {array.shape} of {array.dtype}; expected {expected} "
                            "of the kind that lidarflow writes")
    try:
        config, stats = json.loads(str(arrays["config"])), json.loads(str(arrays["stats"]))
        motions = _motions_of_rows(arrays["motion"])
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: damaged flow file ({one_line(error)})") from None
    ego_motion = arrays["ego_motion"].astype(np.float64)
    if not pose.is_rigid(ego_motion, 1e-4) or not isinstance(config, dict) or not isinstance(stats, dict):
        raise DataError(f"{path}: damaged flow file; its ego_motion, config or stats make no sense")
    return FlowFile(arrays["points"], arrays["flow"], motions, arrays["valid"], arrays["in_graph"],
                    arrays["is_dynamic"], arrays["is_ground"], arrays["object"], arrays["std"], ego_motion,
                    config, stats)


def _rows_of_motions(motions: np.ndarray) -> np.ndarray:
    """Rows (N, 7) float32 of motions (N, 4, 4); NaN where a motion is not finite."""
    rows = np.full((len(motions), 7), np.nan, dtype=np.float32)
    known = np.isfinite(motions).all(axis=(1, 2))
    if known.any():
        rows[known] = pose.to_translation_quaternion(motions[known])
    return rows


def _motions_of_rows(rows: np.ndarray) -> np.ndarray:
    """Motions (N, 4, 4) float64 of rows (N, 7); NaN where a row is not finite."""
    motions = np.full((len(rows), 4, 4), np.nan)
    known = np.isfinite(rows).all(axis=1)
    if known.any():
        motions[known] = pose.from_translation_quaternion(rows[known])
    return motions
