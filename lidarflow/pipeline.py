"""Two scans in, flow out: the method from start to end."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.config import Config
from lidarflow.datasets import Dataset
from lidarflow.errors import DataError
from lidarflow.lidar import dynamic, ego, features, frontend, mesh, objects, preparation, start
from lidarflow.solve import gtsam_lm
from lidarflow.stopwatch import Stopwatch
from lidarflow.types import FlowResult, MovingObject, Scan, ScanPair


@dataclass(frozen=True, slots=True, eq=False)
class Previous:
    """What one pair leaves for the next: its source points, its result, and its target's features."""

    points: np.ndarray
    result: FlowResult
    target: features.Features


def estimate_flow(pair: ScanPair, config: Config | None = None) -> FlowResult:
    """Dense rigid flow from one scan to the next; raises DataError for scans that cannot be used."""
    return _estimate(pair, config or Config(), previous=None, ego_guess=None)[0]


class FlowEstimator:
    """Flow along a sequence: motions, features and ego-motion are carried from pair to pair."""

    def __init__(self, config: Config | None = None):
        self.config = config or Config()
        limits = self.config.preparation
        by_registration = self.config.ego.method == "registration"
        self._odometry = None if by_registration else ego.Odometry(limits.min_range_m, limits.max_range_m)
        self._scan: Scan | None = None
        self._previous: Previous | None = None

    def step(self, scan: Scan) -> FlowResult | None:
        """Flow from the last scan to this one; None for the first."""
        guess = None
        if self._odometry is not None:
            guess = self._odometry.step(_finite_in_range(scan, self.config))
        source, self._scan = self._scan, scan
        if source is None:
            _require_points(scan, self.config)
            return None
        # Forgotten first: after a scan that cannot be used, the next pair must not inherit an older one's.
        previous, self._previous = self._previous, None
        result, target = _estimate(ScanPair(source, scan), self.config, previous, guess)
        self._previous = Previous(source.points, result, target)
        return result


def run(dataset: Dataset, frames: list[int], config: Config) -> Iterator[tuple[ScanPair, FlowResult]]:
    """Flow of every consecutive pair of `frames` of a data set, in order."""
    estimator = FlowEstimator(config)
    source = None
    for frame in frames:
        scan = dataset.scan(frame)
        result = estimator.step(scan)
        if result is not None:
            yield ScanPair(source, scan), result
        source = scan


def _estimate(
    pair: ScanPair, config: Config, previous: Previous | None, ego_guess: np.ndarray | None
) -> tuple[FlowResult, features.Features]:
    """The result of a pair and the features of its target."""
    for scan in (pair.source, pair.target):
        _require_points(scan, config)
    timed = Stopwatch()
    points = pair.source.points
    with timed("features"):
        source = previous.target if previous else features.extract(pair.source, config)
        target = features.extract(pair.target, config)
    with timed("ego-motion"):
        ego_motion = _ego_motion(pair, source, target, ego_guess, config)
    with timed("mesh"):
        surface_mesh = mesh.build(
            points, source.usable & ~source.ground, source.surface, config.mesh, config.normals.radius_m)
    with timed("matching"):
        start_motions = _start(points, previous, ego_motion, config)
        graph = frontend.build_problem(pair, source, target, surface_mesh, start_motions, config)
        matches = graph.problem.points[graph.problem.match_index], graph.problem.match_target
    with timed("objects"):
        on_objects = _OnObjects.none(points)
        if config.objects.enabled:
            on_objects = _find_objects(pair, source, target, graph, ego_motion, config)
            graph = frontend.focused(graph, on_objects.object_id, on_objects.motions, ego_motion)
    with timed("solver"):
        motions, solved, stats = gtsam_lm.solve(graph.problem, config.solver, config.graph.min_matches)
    with timed("dense answer"):
        in_graph = graph.variable >= 0
        is_solved = np.zeros(len(points), bool)
        is_solved[in_graph] = solved[graph.variable[in_graph]]
        on_object = on_objects.object_id >= 0
        dense = np.tile(ego_motion, (len(points), 1, 1))
        dense[on_object] = on_objects.motions[on_objects.object_id[on_object]]
        dense[in_graph] = motions[graph.variable[in_graph]]
        flow = pose.apply(dense, points) - points
        is_dynamic = on_object
        if not config.objects.enabled:
            residual_flow = flow - (pose.apply(ego_motion, points) - points)
            is_dynamic = dynamic.detect(
                points, residual_flow, is_solved, surface_mesh.edges, ego_motion,
                pair.target.points[target.usable], pair.dt_s, config.dynamic)
    valid = source.ground | on_objects.explained | is_solved
    return FlowResult(
        flow, dense, valid, in_graph, is_dynamic, ego_motion, stats, timed.seconds, *matches, source.ground,
        on_objects.object_id, on_objects.objects), target


@dataclass(frozen=True, slots=True, eq=False)
class _OnObjects:
    """Which points move with which object, and which the objects or the ego-motion explain."""

    object_id: np.ndarray
    motions: np.ndarray
    explained: np.ndarray
    objects: tuple[MovingObject, ...]

    @classmethod
    def none(cls, points: np.ndarray) -> "_OnObjects":
        n = len(points)
        return cls(np.full(n, -1, np.int32), np.empty((0, 4, 4)), np.zeros(n, bool), ())


def _find_objects(
    pair: ScanPair, source: features.Features, target: features.Features, graph: frontend.Graph,
    ego_motion: np.ndarray, config: Config,
) -> _OnObjects:
    """The moving objects among the source's non-ground points."""
    points = pair.source.points
    rows = np.flatnonzero(source.usable & ~source.ground)
    at = np.full(len(points), -1)
    at[rows] = np.arange(len(rows))
    matched = at[graph.rows[graph.problem.match_index]]
    view = objects.look(
        pose.apply(ego_motion, points[rows]), pair.target.points[target.usable],
        target.ground[target.usable], pose.apply(ego_motion, points[source.usable]),
        (matched, graph.problem.match_target), config.objects)
    bodies = objects.find(view, pair.dt_s, config.objects)

    object_id = np.full(len(points), -1, np.int32)
    explained = np.zeros(len(points), bool)
    explained[rows] = ~(view.evidence.unexplained | view.evidence.blind)
    for number, body in enumerate(bodies):
        object_id[rows[body.rows]] = number
        explained[rows[body.rows]] = True
    motions = [body.over_ground @ ego_motion for body in bodies]
    described = tuple(
        objects.describe(number, points[rows[body.rows]], motion, ego_motion, pair.dt_s)
        for number, (body, motion) in enumerate(zip(bodies, motions, strict=True)))
    return _OnObjects(object_id, np.array(motions).reshape(-1, 4, 4), explained, described)


def _require_points(scan: Scan, config: Config) -> None:
    limits = config.preparation
    if not preparation.usable(scan.points, limits).any():
        raise DataError(
            f"{scan.name}: none of {len(scan)} points lies between {limits.min_range_m:g} and "
            f"{limits.max_range_m:g} m from the sensor; is the scan empty, or not in metres?")


def _finite_in_range(scan: Scan, config: Config) -> np.ndarray:
    return scan.points[preparation.usable(scan.points, config.preparation)]


def _ego_motion(
    pair: ScanPair, source: features.Features, target: features.Features, guess: np.ndarray | None,
    config: Config,
) -> np.ndarray:
    """target_from_source (4, 4): KISS-ICP's, refined unless told otherwise, or by registration alone.

    Both registrations sum in parallel and in no fixed order; rounding their last digits away, a nanometre,
    makes equal runs give equal bytes.
    """
    found = guess
    if guess is None or config.ego.refine:
        found = ego.register(
            pair.source.points[source.usable], pair.target.points[target.usable], guess, config.ego)
    return pose.exp(np.round(pose.log(found), 9))


def _start(
    points: np.ndarray, previous: Previous | None, ego_motion: np.ndarray, config: Config
) -> np.ndarray:
    if previous is None or config.graph.start == "ego":
        return np.tile(ego_motion, (len(points), 1, 1))
    return start.carried(points, previous.points, previous.result, ego_motion)
