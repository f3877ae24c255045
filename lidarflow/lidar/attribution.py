"""What every point of a pair moves with: the static world, or one of the moving objects."""

from concurrent.futures import Future
from dataclasses import dataclass, replace

import numpy as np

from lidarflow import pose
from lidarflow.aside import Aside, there
from lidarflow.config import Config
from lidarflow.kernels import tree
from lidarflow.lidar import objects, seeds, tracking, uncertainty
from lidarflow.lidar import view as view_of_pair
from lidarflow.lidar.body import Body
from lidarflow.lidar.features import Features
from lidarflow.lidar.hypotheses import Expected
from lidarflow.lidar.matching import Matches
from lidarflow.lidar.seeds import Seeds
from lidarflow.lidar.tracking import Tracks
from lidarflow.lidar.view import View
from lidarflow.types import MovingObject, ScanPair

WORLD = -1


@dataclass(frozen=True, slots=True, eq=False)
class Attribution:
    """What the points of a source scan move with, rows aligned with it.

    owner      (N,) int64       index of the point's object, WORLD = none
    motions    (G, 4, 4)        of the objects, target_from_source
    ids        (G,) int32       of the objects, kept over time
    explained  (N,) bool        an object's motion or the ego-motion explains the point
    std_m      (N,) float64     standard deviation of where that motion puts the point, metres; may still be
                                under way
    objects    tuple            the objects, described
    tracks     Tracks           for the next pair
    """

    owner: np.ndarray
    motions: np.ndarray
    ids: np.ndarray
    explained: np.ndarray
    begun_std_m: "Future[np.ndarray]"
    objects: tuple[MovingObject, ...]
    tracks: Tracks

    @property
    def std_m(self) -> np.ndarray:
        return self.begun_std_m.result()

    @classmethod
    def none(cls, count: int) -> "Attribution":
        """All `count` points with the world, nothing explained, nothing known of any error."""
        return cls(np.full(count, WORLD), np.empty((0, 4, 4)), np.empty(0, np.int32), np.zeros(count, bool),
                   there(np.full(count, np.nan)), (), Tracks())


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Where in a pair to look for objects.

    rows      (U,) int64   of the source, those that the view has
    view      View         before anything is matched
    expected  Expected     what earlier pairs lead to expect
    seeds     Seeds
    """

    rows: np.ndarray
    view: View
    expected: Expected
    seeds: Seeds


def search(
    source: Features, target: Features, ego_motion: np.ndarray, tracks: Tracks, dt_s: float, config: Config
) -> Search:
    """What two scans, `dt_s` apart, tell of moving objects; `tracks` are of the pair before, source frame."""
    view = view_of_pair.look(source.cloud.moved(ego_motion), target.cloud, config.objects)
    expected = _expected(tracks, ego_motion, dt_s)
    found = seeds.find(view, expected.points, config.objects)
    rows = np.flatnonzero(source.standing)
    return Search(rows, view, expected, found)


def attribute(
    pair: ScanPair, sought: Search, matches: Matches, ego_motion: np.ndarray, tracks: Tracks, config: Config,
    beside: Aside,
) -> Attribution:
    """Find the moving objects of a pair; `tracks` are of the pair before, in the frame of the source.

    Candidates are judged `beside` the caller too, and standard deviations there alone.
    """
    points, rows = pair.source.points, sought.rows

    def of_view(asked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found, places = matches.of(rows[asked])
        return np.searchsorted(rows, found), places

    view = replace(sought.view, matches=of_view)
    bodies = objects.find(view, sought.seeds, pair.dt_s, config.objects, sought.expected, beside.each)

    owner, explained = np.full(len(points), WORLD), np.zeros(len(points), bool)
    explained[rows] = ~(view.evidence.unexplained | view.evidence.blind)
    for index, body in enumerate(bodies):
        owner[rows[body.rows]] = index
        explained[rows[body.rows]] = True
    std_m = beside.begin(_std, points, rows, owner, bodies, view, ego_motion, config)
    clouds = [points[rows[body.rows]] for body in bodies]
    over_ground = [body.over_ground for body in bodies]
    motions = [motion @ ego_motion for motion in over_ground]
    ids = tracking.identify(tracks, clouds)
    described = tuple(
        objects.describe(number, cloud, motion, ego_motion, pair.dt_s)
        for number, cloud, motion in zip(ids, clouds, motions, strict=True))
    if bodies or not pair.repeats:
        tracks = tracking.advance(tracks, ids, clouds, over_ground, ego_motion, pair.dt_s)
    # Else all that was followed is where it was, whatever the times say: led on, it would not be found again.
    return Attribution(
        owner, np.array(motions).reshape(-1, 4, 4), np.array(ids, np.int32), explained, std_m, described,
        tracks)


def _expected(tracks: Tracks, ego_motion: np.ndarray, dt_s: float) -> Expected:
    """What the tracks lead to expect `dt_s` later, in the frame of the view: that of the target."""
    clouds = [pose.apply(ego_motion, track.points) for track in tracks.followed]
    shifts = [(pose.apply(track.goes_on(ego_motion, dt_s), points) - points).mean(axis=0)
              for track, points in zip(tracks.followed, clouds, strict=True)]
    number = np.repeat(np.arange(len(clouds)), [len(points) for points in clouds])
    points = np.concatenate([np.empty((0, 3)), *clouds])
    return Expected(tree.build(points), number, np.array(shifts).reshape(-1, 3))


def _std(
    points: np.ndarray, rows: np.ndarray, owner: np.ndarray, bodies: list[Body], view: View,
    ego_motion: np.ndarray, config: Config,
) -> np.ndarray:
    """Standard deviation (N,) in metres of where its motion puts each point; the world's, or its object's."""
    std_m = uncertainty.of_world(view, np.flatnonzero(owner[rows] == WORLD), pose.apply(ego_motion, points))
    for body in bodies:
        mine = rows[body.rows]
        moved = pose.apply(body.over_ground @ ego_motion, points.take(mine, axis=0))
        # An object's motion is found after ego-motion, but fitted to the target itself: its error is its own.
        std_m[mine] = uncertainty.of_body(view, body, moved, config.objects.along_ground)
    return std_m
