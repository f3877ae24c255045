"""Two scans in, flow out: the method from start to end."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from lidarflow import first_use, pose
from lidarflow.aside import Aside
from lidarflow.config import Config, given
from lidarflow.datasets import Dataset
from lidarflow.lidar import (
    attribution,
    dynamic,
    ego,
    features,
    frontend,
    limbs,
    mesh,
    odometry,
    preparation,
    refinement,
    start,
    upright,
)
from lidarflow.lidar import uncertainty as uncertainties
from lidarflow.lidar.attribution import WORLD, Attribution, Search
from lidarflow.lidar.matching import Matches
from lidarflow.lidar.mesh import Mesh
from lidarflow.lidar.tracking import Tracks
from lidarflow.rows import lengths
from lidarflow.solve import solve
from lidarflow.stopwatch import Stopwatch
from lidarflow.types import FlowResult, Scan, ScanPair, as_pair, as_scan


@dataclass(frozen=True, slots=True, eq=False)
class Previous:
    """What one pair leaves for the next: source points, result, seconds, its target's features and mesh.

    Features and mesh are None where the result was known already, the mesh also where nothing is refined
    (`refine.rounds`); they are made when they are needed.
    """

    points: np.ndarray
    result: FlowResult
    took_s: float
    target: features.Features | None = None
    target_mesh: "Future[Mesh] | None" = None


class Estimator(Protocol):
    """A method that is shown the scans of a sequence one by one.

    tracks  the objects that are followed, and the first number that is still free
    """

    tracks: Tracks

    def step(self, scan: Scan) -> FlowResult | None:
        """Flow from the last scan to this one; None for the first. DataError for a scan of no use."""

    def follow(self, scan: Scan, known: FlowResult | None, tracks: Tracks) -> None:
        """As `step` where its answer and the tracks after it are known: the next step is the same.

        Where nothing is known (None), at least the odometry has seen the scan.
        """

    def reset(self) -> None:
        """Begin anew with the next scan: everything is forgotten, but no object's number is given again."""


def estimate_flow(
    pair: ScanPair | tuple[Scan | np.ndarray, Scan | np.ndarray], config: Config | None = None
) -> FlowResult:
    """Dense rigid flow from one scan to the next, both Scans or points (N, 3) in metres.

    Scans without times are taken 0.1 s apart. Raises DataError for scans that cannot be used.
    """
    scans, config = as_pair(pair), given(config, Config)
    first_use.announce()
    with Aside() as beside:
        result, _ = explain(prepare(scans, config, beside), config, beside)
    return result


class FlowEstimator:
    """Flow along a sequence: motions, features and ego-motion are carried from pair to pair."""

    def __init__(self, config: Config | None = None):
        self.config = given(config, Config)
        self.tracks = Tracks()
        self.reset()

    def reset(self) -> None:
        """Begin anew with the next scan; numbers of objects go on."""
        self._odometry = odometry.begun(self.config)
        self._scan: Scan | None = None
        self._previous: Previous | None = None
        self.tracks = Tracks(next_id=self.tracks.next_id)

    def step(self, scan: Scan | np.ndarray) -> FlowResult | None:
        """Flow from the last scan to this one, a Scan or points (N, 3) in metres; None for the first.

        Scans without times are taken 0.1 s apart. Raises DataError for a scan that cannot be used; the next
        one starts anew, as the first. An array of another shape is no scan, and changes nothing.
        """
        scan = as_scan(scan)
        first_use.announce()
        try:
            return self._step(scan)
        except BaseException:     # the scan is nobody's source, and no pair may inherit half of another
            self.reset()
            raise

    def _step(self, scan: Scan) -> FlowResult | None:
        source, self._scan = self._scan, scan
        if source is None:
            preparation.require_points(scan, self.config.preparation)
            self._odometry.step(scan.points, 0.0)
            return None
        previous = self._previous
        tracks = self.tracks if previous else Tracks(next_id=self.tracks.next_id)
        pair = ScanPair(source, scan)
        with Aside() as beside:
            prepared = prepare(
                pair, self.config, beside, previous, lambda: self._odometry.step(scan.points, pair.dt_s),
                tracks)
            result, self.tracks = explain(prepared, self.config, beside)
        self._odometry.found(result.ego_motion, pair.dt_s)
        self._previous = Previous(source.points, result, pair.dt_s, prepared.target, prepared.target_mesh)
        return result

    def follow(self, scan: Scan, known: FlowResult | None, tracks: Tracks) -> None:
        """Take `known` for the flow from the last scan to this one; only odometry sees the scan again."""
        last, self._previous = self._scan, None
        odometry.follow(self._odometry, last, scan, known)
        if last is not None and known is not None:
            self._previous = Previous(last.points, known, ScanPair(last, scan).dt_s)
        self._scan, self.tracks = scan, tracks


def run(
    dataset: Dataset, frames: list[int], estimator: Estimator
) -> Iterator[tuple[ScanPair, FlowResult]]:
    """Flow of every consecutive pair of `frames` of a data set, in order, by a fresh estimator."""
    source: Scan | None = None
    for frame in frames:
        scan = dataset.scan(frame)
        result = estimator.step(scan)
        if source is not None and result is not None:
            yield ScanPair(source, scan), result
        source = scan


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """A pair up to the question what moves: features, ego-motion, meshes, and the graph.

    `tracks` are what earlier pairs lead to expect; `search`, where to look for objects, is None when they are
    not looked for. The graph then has its matches, else none yet, and `matches` finds them. What is
    refined needs the mesh of the target and the scene of limbs; when objects are looked for, what may have
    limbs is refined as part of the world meanwhile. These may still be under way, or None.
    """

    pair: ScanPair
    source: features.Features
    target: features.Features
    ego_motion: np.ndarray
    mesh: Mesh
    target_mesh: "Future[Mesh] | None"
    scene: "Future[limbs.Scene] | None"
    world_limbs: "Future[limbs.Part] | None"
    tracks: Tracks
    search: Search | None
    graph: frontend.Graph
    matches: Matches
    seconds: dict[str, float]


def prepare(
    pair: ScanPair, config: Config, beside: Aside, previous: Previous | None = None,
    ego_guess: Callable[[], np.ndarray | None] | None = None, tracks: Tracks | None = None,
) -> Prepared:
    """All of a pair that comes before objects and solver; raises DataError for scans that cannot be used.

    `previous` is what the pair before left, `tracks` its objects; `ego_guess`, called once, gives a start
    value (4, 4) for the ego-motion. Stages run `beside` one another; each is timed by how long it is waited
    for.
    """
    timed, points = Stopwatch(), pair.source.points
    guess = beside.begin(ego_guess) if ego_guess else None
    for scan in (pair.target,) if previous else (pair.source, pair.target):
        preparation.require_points(scan, config.preparation)
    with timed("features"):
        target = features.extract(pair.target, config, beside)
        before = previous.target if previous else None
        source = before if before is not None else features.extract(pair.source, config, beside)
    mesh_before = previous.target_mesh if previous else None
    begun_mesh = mesh_before or beside.begin(_mesh, pair.source, source, config)
    begun_graph = beside.begin(_graph, points, begun_mesh, config)
    target_mesh = beside.begin(_mesh, pair.target, target, config) if config.refine.rounds else None
    with timed("ego-motion"):
        ego_motion = ego.find(source.thinned, target.thinned, guess.result() if guess else None, config.ego)
    scene = world_limbs = None
    if target_mesh:
        scene = beside.begin(_scene, pair.target, target, begun_graph, target_mesh, config)
    tracks, search = tracks or Tracks(), None
    if config.objects.enabled and scene:
        world_limbs = beside.begin(_world_limbs, scene, ego_motion)
    if config.objects.enabled:
        with timed("features"):
            target.begun_cloud.result()
        with timed("evidence"):
            search = attribution.search(source, target, ego_motion, tracks, pair.dt_s, config)
    with timed("features"):
        keypoints = source.keypoints, target.keypoints
    with timed("mesh"):
        source_mesh = begun_mesh.result()
    with timed("graph"):
        graph = begun_graph.result()
        start_at = partial(_start, previous=previous, ego_motion=ego_motion, dt_s=pair.dt_s, config=config)
        matches = frontend.matches(graph, *keypoints, start_at, pair.dt_s, config.matching)
    if search is None:
        with timed("matching"):
            graph = frontend.matched(
                frontend.started(graph, start_at), points, *matches.of(np.flatnonzero(graph.variable >= 0)))
    return Prepared(
        pair, source, target, ego_motion, source_mesh, target_mesh, scene, world_limbs, tracks, search, graph,
        matches, timed.seconds)


def _mesh(scan: Scan, seen: features.Features, config: Config) -> Mesh:
    return mesh.build(scan.points, seen.standing, seen.surface, config.mesh, config.normals.radius_m)


def _graph(points: np.ndarray, mesh: "Future[Mesh]", config: Config) -> frontend.Graph:
    return frontend.build(points, mesh.result(), config.graph.thinning_m)


def _scene(
    target: Scan, seen: features.Features, graph: "Future[frontend.Graph]", mesh: "Future[Mesh]",
    config: Config,
) -> limbs.Scene:
    return limbs.Scene(
        graph.result(), refinement.wanted(graph.result().problem, config.refine), target.points,
        np.flatnonzero(seen.standing), seen.cloud.upright.tree, mesh.result(),
        partial(solve, min_matches=config.graph.min_matches), config)


def _by_world(points: np.ndarray, ego_motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Motions (N, 4, 4) of points (N, 3) that move with the world, and where they go (N, 3)."""
    motions = np.empty((len(points), 4, 4))
    motions[:] = ego_motion
    return motions, pose.apply(ego_motion, points)


def _world_limbs(scene: "Future[limbs.Scene]", ego_motion: np.ndarray) -> limbs.Part:
    return limbs.of_world(scene.result(), ego_motion)


def explain(prepared: Prepared, config: Config, beside: Aside) -> tuple[FlowResult, Tracks]:
    """The result of a prepared pair, and the tracks of its objects; candidates are judged `beside` too."""
    pair, source, graph, ego_motion = prepared.pair, prepared.source, prepared.graph, prepared.ego_motion
    timed = Stopwatch(dict(prepared.seconds))
    points = pair.source.points
    by_world = beside.begin(_by_world, points, ego_motion)
    doubt = beside.begin(upright.doubt, points, source.thinned.planes.normals)
    with timed("objects"):
        found = Attribution.none(len(points))
        if prepared.search:
            found = attribution.attribute(
                pair, prepared.search, prepared.matches, ego_motion, prepared.tracks, config, beside)
            graph = frontend.focused(graph, found.owner, found.motions, ego_motion)
            # Around objects, matches would say what ego-motion says already.
            moving = np.flatnonzero(found.owner != WORLD)
            graph = frontend.matched(graph, points, *prepared.matches.of(moving))
        by_group = np.concatenate([found.motions, ego_motion[None]])   # WORLD is the last
    with timed("solver"):
        motions, solved, stats = solve(graph.problem, config.solver, config.graph.min_matches)
        whole = limbs.Part(graph, motions, solved)
    with timed("refinement"):
        parts = whole, *_refined(prepared, whole, found, config)
    with timed("dense answer"):
        dense, moved = _dense(points, by_world.result(), by_group, found.owner, parts)
        flow = moved - points
        std_m = _std(points, found, whole, parts, flow, by_group, config)
        in_graph = np.zeros(len(points), bool)
        for part in parts:
            in_graph |= np.append(part.solved, False).take(part.graph.variable)
        is_solved = in_graph & np.isfinite(std_m)     # what let all its matches go rests on none of them
        is_dynamic = found.owner != WORLD
        if not prepared.search:
            residual_flow = moved - pose.apply(ego_motion, points)
            is_dynamic = dynamic.detect(
                points, residual_flow, is_solved, prepared.mesh.edges, ego_motion,
                pair.target.points[prepared.target.usable], pair.dt_s, config.dynamic)
        matches = graph.problem.points[graph.problem.match_index], graph.problem.match_target
        valid = source.ground | found.explained | is_solved
        object_id = np.append(found.ids, np.int32(-1)).take(found.owner)
        std_m[~valid] = np.nan
    result = FlowResult(
        flow, dense, valid, in_graph, is_dynamic, ego_motion, stats, timed.seconds, *matches, source.ground,
        object_id, found.objects, std_m, doubt.result())
    return result, found.tracks


def _dense(
    points: np.ndarray, by_world: tuple[np.ndarray, np.ndarray], by_group: np.ndarray, owner: np.ndarray,
    parts: tuple[limbs.Part, ...],
) -> tuple[np.ndarray, np.ndarray]:
    """Motions (N, 4, 4) of points (N, 3), and where they go (N, 3).

    Both are those `by_world`, which are given away, filled in where a point moves otherwise: it has the
    motion of its group, by_group (G, 4, 4), unless it is in a part of the graph, whose variables have their
    own; the last part counts.
    """
    motions, moved = by_world
    has_own = owner != WORLD
    rows = np.flatnonzero(has_own)
    motions[rows] = by_group.take(owner[rows], axis=0)
    for part in parts:
        rows = part.source_rows
        motions[rows] = part.motions.take(part.graph.variable[rows], axis=0)
        has_own[rows] = True
    rows = np.flatnonzero(has_own)
    moved[rows] = pose.apply(motions.take(rows, axis=0), points.take(rows, axis=0))
    return motions, moved


def _refined(
    prepared: Prepared, solved: limbs.Part, found: Attribution, config: Config
) -> tuple[limbs.Part, ...]:
    """The parts of the graph that may have limbs, on the next scan's surface, from what was `solved`."""
    if prepared.scene is None:
        return ()
    scene = prepared.scene.result()
    is_rigid = np.array([o.box_size.max() > config.refine.max_size_m for o in found.objects], bool)
    touched = np.ones(len(scene.wanted), bool)
    apart: tuple[limbs.Part, ...] = ()
    if prepared.world_limbs is not None:
        touched = frontend.touched(scene.graph, found.owner)
        apart = limbs.apart_from(prepared.world_limbs.result(), scene.graph, touched),
    return *apart, limbs.of_objects(
        scene, touched, solved, found.owner, found.motions, is_rigid, prepared.ego_motion)


def _std(
    points: np.ndarray, found: Attribution, whole: limbs.Part, parts: tuple[limbs.Part, ...],
    flow: np.ndarray, by_group: np.ndarray, config: Config,
) -> np.ndarray:
    """Standard deviation (N,) of the flow in metres.

    A point of a group errs with the group's motion, and where it has been moved away from the group, as only
    points of a graph are, by that much more. Without groups, the matches around it tell.
    """
    std_m = found.std_m.copy()
    if config.objects.enabled:
        own = np.flatnonzero(np.logical_or.reduce([part.graph.variable >= 0 for part in parts]))
        at = points.take(own, axis=0)
        by_own_group = pose.apply(by_group.take(found.owner[own], axis=0), at)
        apart_m = lengths(by_own_group - at - flow.take(own, axis=0))
        std_m[own] = np.hypot(std_m[own], apart_m)
        return std_m
    if whole.solved.any():
        by_matches = uncertainties.of_matches(whole.graph.problem, whole.motions, config.solver.truncation_m)
        rows = whole.source_rows
        std_m[rows] = np.where(whole.solved, by_matches, np.nan)[whole.graph.variable[rows]]
    return std_m


def _start(
    points: np.ndarray, previous: Previous | None, ego_motion: np.ndarray, dt_s: float, config: Config
) -> np.ndarray:
    if previous is None or config.graph.start == "ego":
        return np.broadcast_to(ego_motion, (len(points), 4, 4))
    return start.carried(points, previous.points, previous.result, previous.took_s, ego_motion, dt_s)
