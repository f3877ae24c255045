"""Objects over time: which of a pair's objects is which of the last pair's, and where it should be now."""

from dataclasses import dataclass, replace

import numpy as np

from lidarflow import pose
from lidarflow.kernels import neighbours, tree
from lidarflow.rows import spread

_SAME_PLACE_M = 0.5      # points this near to where a track should be lie on it
_MIN_SHARE = 0.3         # of an object's points must
_MAX_POINTS = 400
_MAX_MISSED = 3          # pairs that a track goes on for without being found


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """An object that was found before.

    id           int             kept for as long as the object is followed
    points       (K, 3) float64  where its points should be, metres, in the frame of the latest scan
    over_ground  (4, 4) float64  the motion after ego-motion that it was last found with, in the same frame
    took_s       float           seconds that this motion took
    missed       int             pairs since it was last found
    """

    id: int
    points: np.ndarray
    over_ground: np.ndarray
    took_s: float
    missed: int = 0

    def goes_on(self, ego_motion: np.ndarray, dt_s: float) -> np.ndarray:
        """Its motion over ground (4, 4) in the next `dt_s`, target frame, if it goes on as before."""
        return pose.lasting(self._seen_after(ego_motion), self.took_s, dt_s)

    def moved(self, ego_motion: np.ndarray, dt_s: float) -> "Track":
        """The track after a pair of `dt_s`, if it goes on as before."""
        over_ground = self.goes_on(ego_motion, dt_s)
        # The motion stays as it was found: scaled to a short pair and back it would not be as exact.
        return replace(
            self, points=pose.apply(over_ground @ ego_motion, self.points),
            over_ground=self._seen_after(ego_motion), missed=self.missed + 1)

    def _seen_after(self, ego_motion: np.ndarray) -> np.ndarray:
        """Its motion (4, 4) as the sensor sees it one ego-motion later."""
        return ego_motion @ self.over_ground @ pose.inverse(ego_motion)


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """All that is followed, and the first id that is still free."""

    followed: tuple[Track, ...] = ()
    next_id: int = 0


def identify(tracks: Tracks, clouds: list[np.ndarray]) -> list[int]:
    """An id for each object of a pair, given as its points (K, 3) in metres, source frame.

    An object takes the id of the track whose expected points most of its own lie on; each id is given once,
    the best overlap first. What lies on no track is new.
    """
    overlaps = []
    places = [tree.build(track.points) for track in tracks.followed]
    for number, points in enumerate(clouds):
        sample = tree.build(spread(points, _MAX_POINTS))
        for track, place in zip(tracks.followed, places, strict=True):
            share = len(neighbours.near_rows(sample, place, _SAME_PLACE_M)) / len(sample.rows)
            if share >= _MIN_SHARE:
                overlaps.append((-share, number, track.id))
    ids: dict[int, int] = {}
    for _, number, known in sorted(overlaps):
        if number not in ids and known not in ids.values():
            ids[number] = known
    new = iter(range(tracks.next_id, tracks.next_id + len(clouds)))
    return [ids[number] if number in ids else next(new) for number in range(len(clouds))]


def advance(
    tracks: Tracks, ids: list[int], clouds: list[np.ndarray], over_ground: list[np.ndarray],
    ego_motion: np.ndarray, dt_s: float,
) -> Tracks:
    """The tracks after a pair of `dt_s`.

    Its objects have `ids`, points (K, 3), metres, source frame, and motions (4, 4) after ego-motion.
    """
    found = [
        Track(number, pose.apply(motion @ ego_motion, spread(points, _MAX_POINTS)), motion, dt_s)
        for number, points, motion in zip(ids, clouds, over_ground, strict=True)]
    missed = [track.moved(ego_motion, dt_s) for track in tracks.followed
              if track.id not in ids and track.missed < _MAX_MISSED]
    return Tracks((*found, *missed), max([tracks.next_id, *(number + 1 for number in ids)]))
