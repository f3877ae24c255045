"""Small generated worlds with known truth: factor graphs on regular grids, and scans of simple shapes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarflow import pose
from lidarflow.types import FlowProblem, Scan, ScanPair

SPACING_M = 0.3
GATE_M = 2.5
_WRONG_BY_M = 0.6   # a wrong match lies at least this far from the right place


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A FlowProblem and its answer.

    problem  FlowProblem
    motions  (M, 4, 4) float64   true motion of every variable
    wrong    (K,) bool           the matches that are wrong
    """

    problem: FlowProblem
    motions: np.ndarray
    wrong: np.ndarray

    def error_m(self, motions: np.ndarray) -> np.ndarray:
        """Distances (M,) in metres between where `motions` and the truth put the points."""
        points = self.problem.points
        return np.linalg.norm(pose.apply(motions, points) - pose.apply(self.motions, points), axis=1)


def grid_edges(columns: int, rows: int) -> np.ndarray:
    """Edges (E, 2) int32, i < j, of a triangulated grid whose point (column, row) is column * rows + row."""
    index = np.arange(columns * rows, dtype=np.int32).reshape(columns, rows)
    steps = ((index[:-1], index[1:]), (index[:, :-1], index[:, 1:]), (index[:-1, :-1], index[1:, 1:]))
    return np.concatenate([np.column_stack([a.ravel(), b.ravel()]) for a, b in steps])


def room_grid(centre: Sequence[float], columns: int = 16, rows: int = 8) -> np.ndarray:
    """Points (columns * rows, 3) in metres of a wall that is folded twice, like three sides of a room."""
    third = columns / 3 * SPACING_M
    along = np.arange(columns) * SPACING_M
    x = np.clip(along - third, 0.0, third)
    y = np.clip(along, 0.0, third) - np.clip(along - 2 * third, 0.0, None)
    z = np.arange(rows) * SPACING_M
    wall = np.stack(np.broadcast_arrays(x[:, None], y[:, None], z), axis=-1).reshape(-1, 3)
    return wall - wall.mean(axis=0) + np.asarray(centre, float)


def body(centre: Sequence[float], motion: np.ndarray, rng: np.random.Generator, wrong_matches: float = 0.0,
         noise_m: float = 0.0, columns: int = 16, rows: int = 8) -> World:
    """One rigid component, every point matched, starting at the identity.

    wrong_matches  share of the matches that lead anywhere in the gate
    noise_m        standard deviation of the other matches, per axis
    """
    points = room_grid(centre, columns, rows)
    count = len(points)
    targets = pose.apply(motion, points) + rng.normal(scale=noise_m, size=(count, 3))
    wrong = np.zeros(count, bool)
    wrong[rng.permutation(count)[:round(wrong_matches * count)]] = True
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    targets[wrong] += (direction * rng.uniform(_WRONG_BY_M, GATE_M, (count, 1)))[wrong]
    problem = FlowProblem(
        points, pose.identity(count), np.arange(count, dtype=np.int32), targets, grid_edges(columns, rows),
        np.zeros(count, np.int32))
    return World(problem, np.tile(motion, (count, 1, 1)), wrong)


def moved_room(shift_m: float, turn_deg: float, rng: np.random.Generator, wrong_matches: float = 0.0,
               noise_m: float = 0.0) -> World:
    """A room 8 m ahead that a turning sensor sees shifted."""
    motion = pose.from_yaw(np.radians(turn_deg), np.array([shift_m, 0.3 * shift_m, 0.05]))
    return body((8.0, 2.0, 0.5), motion, rng, wrong_matches, noise_m)


def two_bodies(rng: np.random.Generator, wrong_matches: float = 0.0, noise_m: float = 0.0) -> list[World]:
    """A room and a small thing beside it that move differently, each a world of its own."""
    thing = pose.from_yaw(np.radians(-6.0), np.array([-1.1, 0.4, 0.0]))
    room = pose.from_yaw(np.radians(2.0), np.array([0.5, 0.1, 0.0]))
    return [body((9.0, 2.0, 0.5), room, rng, wrong_matches, noise_m),
            body((6.0, -4.0, 0.0), thing, rng, wrong_matches, noise_m, columns=9, rows=5)]


def joined(worlds: Sequence[World]) -> World:
    """One problem whose components are those of `worlds`, in order."""
    problems = [world.problem for world in worlds]
    first = np.cumsum([0] + [len(p.points) for p in problems])[:-1]
    labels = np.cumsum([0] + [int(p.component.max()) + 1 for p in problems])[:-1]
    problem = FlowProblem(
        np.concatenate([p.points for p in problems]),
        np.concatenate([p.initial for p in problems]),
        np.concatenate([p.match_index + n for p, n in zip(problems, first, strict=True)]).astype(np.int32),
        np.concatenate([p.match_target for p in problems]),
        np.concatenate([p.edges + n for p, n in zip(problems, first, strict=True)]).astype(np.int32),
        np.concatenate([p.component + n for p, n in zip(problems, labels, strict=True)]).astype(np.int32))
    return World(problem, np.concatenate([w.motions for w in worlds]),
                 np.concatenate([w.wrong for w in worlds]))


def permuted(world: World, rng: np.random.Generator) -> tuple[World, np.ndarray]:
    """The same world with points, matches, edges and component labels in another order.

    Also returns the old row (M,) of every new row.
    """
    p = world.problem
    old = rng.permutation(len(p.points))
    new = np.argsort(old)
    match_order, edge_order = rng.permutation(len(p.match_index)), rng.permutation(len(p.edges))
    relabel = rng.permutation(int(p.component.max()) + 1)
    problem = FlowProblem(
        p.points[old], p.initial[old], new[p.match_index][match_order].astype(np.int32),
        p.match_target[match_order], np.sort(new[p.edges][edge_order], axis=1).astype(np.int32),
        relabel[p.component][old].astype(np.int32))
    return World(problem, world.motions[old], world.wrong[match_order]), old


def jittered(world: World, rng: np.random.Generator, shift_m: float = 0.3, turn_deg: float = 3.0) -> World:
    """The same world with every start value moved and turned about its point, each differently."""
    p = world.problem
    twist = np.column_stack([rng.normal(scale=np.radians(turn_deg), size=(len(p.points), 3)),
                             rng.normal(scale=shift_m, size=(len(p.points), 3))])
    at_point = pose.from_translation(p.points)
    start = p.initial @ at_point @ pose.exp(twist) @ pose.inverse(at_point)
    return World(replace(p, initial=start), world.motions, world.wrong)


def swapped_world(world: World) -> World:
    """Target becomes source: the points where the truth puts them, the matches' errors seen backwards."""
    p = world.problem
    back = pose.inverse(world.motions)
    moved = pose.apply(world.motions, p.points)
    error = (p.match_target - moved[p.match_index])
    rotation = back[p.match_index, :3, :3]
    targets = p.points[p.match_index] - np.einsum("nij,nj->ni", rotation, error)
    problem = replace(p, points=moved, initial=pose.inverse(p.initial), match_target=targets)
    return World(problem, back, world.wrong)


def without_matches(world: World, keep: int = 0) -> World:
    """The same world with only the first `keep` matches."""
    p = world.problem
    problem = replace(p, match_index=p.match_index[:keep], match_target=p.match_target[:keep])
    return World(problem, world.motions, world.wrong[:keep])


def all_wrong(world: World, rng: np.random.Generator, by_m: float = 30.0) -> World:
    """The same world with every match `by_m` away, each in a direction of its own."""
    p = world.problem
    direction = rng.normal(size=p.match_target.shape)
    targets = p.match_target + by_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return World(replace(p, match_target=targets), world.motions, np.ones(len(targets), bool))


def empty_problem() -> FlowProblem:
    """No points, no edges, no matches."""
    return FlowProblem(
        np.empty((0, 3)), np.empty((0, 4, 4)), np.empty(0, np.int32), np.empty((0, 3)),
        np.empty((0, 2), np.int32), np.empty(0, np.int32))


# --- scans ---

def swap(pair: ScanPair) -> ScanPair:
    """The pair backwards, the times kept forwards."""
    source, target = pair.source, pair.target
    return ScanPair(Scan(target.points, source.time_ns, target.name),
                    Scan(source.points, target.time_ns, source.name))


def plane_pair(rng: np.random.Generator, count: int = 4000) -> ScanPair:
    """A flat floor 1.7 m below the sensor and nothing else, twice."""
    clouds = [np.column_stack([rng.uniform(-20, 20, (count, 2)), rng.normal(-1.7, 0.01, count)])
              for _ in range(2)]
    return ScanPair(Scan(clouds[0], 0, "floor 0"), Scan(clouds[1], 100_000_000, "floor 1"))


def with_nan_rows(scan: Scan, rows: np.ndarray) -> Scan:
    """The scan with NaN rows put in before the given `rows` (ascending) of the old one."""
    return Scan(np.insert(scan.points, rows, np.nan, axis=0), scan.time_ns, scan.name)
