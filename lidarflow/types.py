"""The data that flows through the pipeline: frozen, and checked at the door.

Arrays keep the length and order of the input cloud; masks say what is valid. Lengths are metres, angles
radians, times integer nanoseconds.
"""

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np

from lidarflow import pose
from lidarflow.checks import as_points, as_time_ns, check, check_motion
from lidarflow.errors import InputError
from lidarflow.rows import without_gaps

_FILLED_IN: Any = None     # the default of an array that __post_init__ makes in the length of the others


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One LiDAR sweep in its own sensor frame.

    points   (N, 3) float64   metres, given as any numbers; rows that are not finite, or masked, become NaN
                              rows, which stay NaN in every result
    time_ns  int              start of the sweep
    name     str              what messages and files call it, e.g. "000042"
    """

    points: np.ndarray
    time_ns: int = 0
    name: str = "scan"

    def __post_init__(self):
        object.__setattr__(self, "points", as_points(self.name, self.points))
        object.__setattr__(self, "time_ns", as_time_ns(self.name, self.time_ns))

    def __len__(self) -> int:
        return len(self.points)


def as_scan(scan: Scan | np.ndarray, name: str = "scan") -> Scan:
    """A Scan as it is; points (N, 3) of any numbers, metres in the sensor frame, as a Scan without a time.

    Raises InputError, which calls the points `name`, for anything else.
    """
    if isinstance(scan, Scan):
        return scan
    made = Scan(scan, name=name)
    # Whose points they are may write the next scan into them.
    return replace(made, points=made.points.copy()) if np.may_share_memory(made.points, scan) else made


@dataclass(frozen=True, slots=True, eq=False)
class ScanPair:
    """Two consecutive scans, or points (N, 3) that become scans; the flow carries `source` onto `target`."""

    source: Scan
    target: Scan

    def __post_init__(self):
        object.__setattr__(self, "source", as_scan(self.source, "source"))
        object.__setattr__(self, "target", as_scan(self.target, "target"))

    @property
    def dt_s(self) -> float:
        """Seconds from source to target; 0.1 (a 10 Hz sensor) where the times do not say."""
        dt = (self.target.time_ns - self.source.time_ns) * 1e-9
        return dt if dt > 0 else 0.1

    @property
    def repeats(self) -> bool:
        """Whether the target is the source once more, as recorders write it where a sweep was lost."""
        return np.array_equal(self.source.points, self.target.points, equal_nan=True)


def as_pair(pair: Any) -> ScanPair:
    """A ScanPair as it is, or one of a source and a target; InputError for anything but two scans."""
    if isinstance(pair, ScanPair):
        return pair
    expected = "expected two scans, as in estimate_flow((source, target))"
    if isinstance(pair, np.ndarray) and pair.ndim != 3:
        raise InputError(f"pair: one array {pair.shape}; {expected}")
    try:
        scans = tuple(pair)
    except TypeError:
        raise InputError(f"pair: of type {type(pair).__name__}; {expected}") from None
    if len(scans) != 2:
        raise InputError(f"pair: {len(scans)} in a {type(pair).__name__}; {expected}")
    return ScanPair(*scans)


class Category(IntEnum):
    """What a labelled point is on, in the classes of the bucketed metric (Khatri et al. 2024).

    OTHER is labelled too, but is none of these: animals, signs, barriers.
    """

    BACKGROUND = 0
    CAR = 1
    OTHER_VEHICLES = 2
    PEDESTRIAN = 3
    WHEELED_VRU = 4
    OTHER = 5


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What really happened between a scan and the next, rows aligned with the source scan.

    flow        (N, 3) float   metres, total: p moves to p + flow in the target's sensor frame
    ego_motion  (4, 4) float   target_from_source
    valid       (N,) bool      rows that are known and count in scores; their flow is finite
    is_dynamic  (N,) bool      the point moves over ground
    object_id   (N,) int       id of the object the point is on, -1 = background
    category    (N,) int       a Category each; None = not known
    is_ground   (N,) bool      the point is on the ground; none when not given
    origin      str            what it was made of, e.g. "flow" or "boxes"
    """

    flow: np.ndarray
    ego_motion: np.ndarray
    valid: np.ndarray
    is_dynamic: np.ndarray
    object_id: np.ndarray
    category: np.ndarray | None = None
    is_ground: np.ndarray = _FILLED_IN
    origin: str = "flow"

    def __post_init__(self):
        check("Truth.flow", self.flow, (None, 3), "f")
        n = len(self.flow)
        if self.is_ground is None:
            object.__setattr__(self, "is_ground", np.zeros(n, bool))
        if self.category is not None:
            check("Truth.category", self.category, (n,), "iu")
            if not np.isin(self.category, list(Category)).all():
                raise ValueError(f"Truth.category: expected numbers of {', '.join(c.name for c in Category)}")
        check("Truth.is_ground", self.is_ground, (n,), "b")
        check("Truth.valid", self.valid, (n,), "b")
        self._check_flow()
        check("Truth.is_dynamic", self.is_dynamic, (n,), "b")
        check("Truth.object_id", self.object_id, (n,), "i")
        check_motion("Truth.ego_motion", self.ego_motion)

    def _check_flow(self) -> None:
        """Raise ValueError where the flow of a valid row is not finite."""
        unknown = np.flatnonzero(self.valid & ~np.isfinite(self.flow).all(axis=1))
        if len(unknown):
            raise ValueError(f"Truth.flow: not finite in {len(unknown)} valid rows, the first is row "
                             f"{unknown[0]}; expected valid to be False there")

    @property
    def is_foreground(self) -> np.ndarray:
        """Points (N,) on labelled objects, standing or moving."""
        return self.object_id >= 0 if self.category is None else self.category != Category.BACKGROUND

    def residual_flow(self, points: np.ndarray) -> np.ndarray:
        """Flow (N, 3) in metres that `points` (N, 3), the source scan's, do by themselves."""
        return self.flow - (pose.apply(self.ego_motion, points) - points)


@dataclass(frozen=True, slots=True, eq=False)
class FlowProblem:
    """The factor graph of one pair, free of any solver (Dewan et al. 2016, eq. 4).

    points         (M, 3) float64      where the variables sit: the graph's points, metres, source frame
    initial        (M, 4, 4) float64   start values of τ, target_from_source
    match_index    (K,) int32          the variable a match belongs to; at most one match each
    match_target   (K, 3) float64      the matched position p', metres, target frame
    edges          (E, 2) int32        mesh neighbours, i < j, unique, both in one component
    component      (M,) int32          mesh component of each variable, 0 .. C-1
    group          (M,) int32          group whose motion ties a variable, -1 = free; empty = all free
    group_motions  (G, 4, 4) float64   motion of each group (the ego-motion, an object's), target_from_source
    """

    points: np.ndarray
    initial: np.ndarray
    match_index: np.ndarray
    match_target: np.ndarray
    edges: np.ndarray
    component: np.ndarray
    group: np.ndarray = field(default_factory=lambda: np.empty(0, np.int32))
    group_motions: np.ndarray = field(default_factory=lambda: np.empty((0, 4, 4)))

    def __post_init__(self):
        check("FlowProblem.points", self.points, (None, 3), "f")
        m = len(self.points)
        check("FlowProblem.initial", self.initial, (m, 4, 4), "f")
        check("FlowProblem.match_index", self.match_index, (None,), "i")
        check("FlowProblem.match_target", self.match_target, (len(self.match_index), 3), "f")
        check("FlowProblem.edges", self.edges, (None, 2), "i")
        check("FlowProblem.component", self.component, (m,), "i")
        check("FlowProblem.group", self.group, (m if len(self.group) else 0,), "i")
        check("FlowProblem.group_motions", self.group_motions, (None, 4, 4), "f")
        if self.group.size and self.group.max() >= len(self.group_motions):
            raise ValueError(f"FlowProblem.group: there are {len(self.group_motions)} group motions")
        for name, index in (("match_index", self.match_index), ("edges", self.edges)):
            if index.size and (index.min() < 0 or index.max() >= m):
                raise ValueError(f"FlowProblem.{name}: indices must lie in 0..{m - 1}")
        first, second = self.edges.T
        if not (first < second).all():
            raise ValueError("FlowProblem.edges: expected i < j in every row")
        if self.component.min(initial=0) < 0:
            raise ValueError("FlowProblem.component: expected numbers from 0 on")
        if (self.component.take(first) != self.component.take(second)).any():
            raise ValueError("FlowProblem.edges: expected both ends of an edge in one component")
        if np.bincount(self.match_index).max(initial=0) > 1:
            raise ValueError("FlowProblem.match_index: a variable has more than one match")

    def part(self, rows: np.ndarray, initial: np.ndarray) -> "FlowProblem":
        """The problem of some variables, ascending rows (R,) of whole components, from starts (R, 4, 4)."""
        kept = np.zeros(len(self.points), bool)
        kept[rows] = True
        position = (np.cumsum(kept) - 1).astype(np.int32)
        matched = kept[self.match_index]
        return replace(
            self, points=self.points.take(rows, axis=0), initial=initial,
            match_index=position[self.match_index[matched]], match_target=self.match_target[matched],
            edges=position.take(self.edges.compress(kept.take(self.edges[:, 0]), axis=0)),
            component=without_gaps(self.component[rows]),
            group=self.group[rows] if len(self.group) else self.group)


@dataclass(frozen=True, slots=True)
class SolveStats:
    """What the optimiser did; the same for every solver.

    Errors are energies: half the sum of squared (or truncated) residuals. `plain` is the step without the
    robust kernel, `robust` the step with it. `stopped` counts components by reason of stopping. What a solver
    does not tell is NaN, or 0 where it is counted.
    """

    solver: str
    variables: int
    matches: int
    edges: int
    components: int
    solved_components: int
    plain_iterations: int
    robust_iterations: int
    plain_initial_error: float
    plain_final_error: float
    robust_initial_error: float
    robust_final_error: float
    inliers: int
    stopped: dict[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class MovingObject:
    """Neighbouring points with one rigid motion of their own.

    id               int             its number in FlowResult.object_id
    motion           (4, 4) float64  target_from_source, total
    velocity         (3,) float64    m/s over ground, in the axes of the target's frame
    box_centre       (3,) float64    metres, source frame
    box_size         (3,) float64    length along the motion, width, height, metres
    box_yaw          float           direction of the length, radians about z
    points           int             how many points of the source are on it
    """

    id: int
    motion: np.ndarray
    velocity: np.ndarray
    box_centre: np.ndarray
    box_size: np.ndarray
    box_yaw: float
    points: int

    def __post_init__(self):
        check_motion("MovingObject.motion", self.motion)
        for name in ("velocity", "box_centre", "box_size"):
            check(f"MovingObject.{name}", getattr(self, name), (3,), "f")


@dataclass(frozen=True, slots=True, eq=False)
class FlowResult:
    """The answer for one pair, rows aligned with the source scan.

    flow         (N, 3) float64      metres, total: τ p − p, ego-motion included; NaN where p is NaN
    motions      (N, 4, 4) float64   τ of every point, target_from_source
    valid        (N,) bool           the motion rests on evidence, not on a start value
    in_graph     (N,) bool           the motion was solved for, not taken from the point's object or the world
    is_dynamic   (N,) bool           moves over ground by itself
    ego_motion   (4, 4) float64      target_from_source of the static world
    stats        SolveStats
    seconds      dict                wall time of each stage
    match_source (K, 3) float64      matched points, metres, source frame
    match_target (K, 3) float64      where their matches are, metres, target frame
    is_ground    (N,) bool           ground of the static world; none when not given
    object_id    (N,) int32          the moving object the point is on, -1 = none (the default)
    objects      tuple               the moving objects; in a sequence their ids are kept over time
    std_m        (N,) float64        standard deviation of the flow, metres, over all axes; NaN = unknown
    doubt        str                 why the source is hardly what the method expects, "" where it may be
    """

    flow: np.ndarray
    motions: np.ndarray
    valid: np.ndarray
    in_graph: np.ndarray
    is_dynamic: np.ndarray
    ego_motion: np.ndarray
    stats: SolveStats
    seconds: dict[str, float] = field(default_factory=dict)
    match_source: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    match_target: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    is_ground: np.ndarray = _FILLED_IN
    object_id: np.ndarray = _FILLED_IN
    objects: tuple[MovingObject, ...] = ()
    std_m: np.ndarray = _FILLED_IN
    doubt: str = ""

    def __post_init__(self):
        check("FlowResult.flow", self.flow, (None, 3), "f")
        n = len(self.flow)
        if self.is_ground is None:
            object.__setattr__(self, "is_ground", np.zeros(n, bool))
        if self.object_id is None:
            object.__setattr__(self, "object_id", np.full(n, -1, np.int32))
        if self.std_m is None:
            object.__setattr__(self, "std_m", np.full(n, np.nan))
        check("FlowResult.std_m", self.std_m, (n,), "f")
        check("FlowResult.motions", self.motions, (n, 4, 4), "f")
        for name in ("valid", "in_graph", "is_ground", "is_dynamic"):
            check(f"FlowResult.{name}", getattr(self, name), (n,), "b")
        check("FlowResult.object_id", self.object_id, (n,), "i")
        check("FlowResult.match_source", self.match_source, (None, 3), "f")
        check("FlowResult.match_target", self.match_target, (len(self.match_source), 3), "f")
        check_motion("FlowResult.ego_motion", self.ego_motion)

    def ego_flow(self, points: np.ndarray) -> np.ndarray:
        """Flow (N, 3) in metres that the sensor's own motion gives `points` (N, 3)."""
        return pose.apply(self.ego_motion, points) - points

    def residual_flow(self, points: np.ndarray) -> np.ndarray:
        """Flow (N, 3) in metres that `points` (N, 3), the source scan's, do by themselves."""
        return self.flow - self.ego_flow(points)
