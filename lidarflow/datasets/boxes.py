"""True flow from labelled boxes that are tracked from scan to scan."""

from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.types import Category, Truth

DYNAMIC_M = 0.05     # residual flow from one scan to the next from which on a point moves


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A labelled box around an object in one scan.

    track            int              the number that the object keeps from scan to scan
    category         Category         what it is
    sensor_from_box  (4, 4) float64   box: origin in its middle, x along its length, z up
    size             (3,) float64     length, width, height, metres
    """

    track: int
    category: Category
    sensor_from_box: np.ndarray
    size: np.ndarray


def box_around(points: np.ndarray, boxes: Sequence[Box], margin_m: Sequence[float]) -> np.ndarray:
    """Which of the boxes is around each of the points (N, 3): row (N,), -1 = none, the last of several.

    margin_m  how far outside along length, width and height a point may be
    """
    row = np.full(len(points), -1)
    for number, box in enumerate(boxes):
        local = pose.apply(pose.inverse(box.sensor_from_box), points)
        row[(np.abs(local) <= box.size / 2 + np.asarray(margin_m)).all(axis=1)] = number
    return row


def height_in_box(points: np.ndarray, boxes: Sequence[Box], row: np.ndarray) -> np.ndarray:
    """Height (N,) in metres of points (N, 3) over the floor of their box; infinite where row (N,) is -1."""
    height_m = np.full(len(points), np.inf)
    for number, box in enumerate(boxes):
        inside = row == number
        local = pose.apply(pose.inverse(box.sensor_from_box), points[inside])
        height_m[inside] = local[:, 2] + box.size[2] / 2
    return height_m


def truth_of_boxes(
    points: np.ndarray, row: np.ndarray, source: Sequence[Box], target: Sequence[Box],
    ego_motion: np.ndarray, origin: str, still: Set[int] = frozenset(),
) -> Truth:
    """Every point of a box moves rigidly with it to the box of the same track, all others with the sensor.

    points      (N, 3)   metres, source frame
    row         (N,)     the source box that a point is in, -1 = none
    ego_motion  (4, 4)   target_from_source
    still       tracks that are known to stand still: their points move with the sensor

    A point is valid unless it is not finite, or its box has no successor.
    """
    ego_flow = pose.apply(ego_motion, points) - points
    flow, valid = ego_flow.copy(), np.isfinite(points).all(axis=1)
    successors = {box.track: box for box in target}
    for number, box in enumerate(source):
        inside = row == number
        if box.track in still:
            continue
        if box.track not in successors:
            valid[inside] = False
            continue
        motion = successors[box.track].sensor_from_box @ pose.inverse(box.sensor_from_box)
        flow[inside] = pose.apply(motion, points[inside]) - points[inside]
    # The last entry, which -1 picks, is the background.
    track = np.array([*(box.track for box in source), -1], np.int64)
    category = np.array([*(box.category for box in source), Category.BACKGROUND], np.int8)
    return Truth(
        flow=flow,
        ego_motion=ego_motion,
        valid=valid,
        is_dynamic=valid & (np.linalg.norm(flow - ego_flow, axis=1) >= DYNAMIC_M),
        object_id=track[row],
        category=category[row],
        origin=origin,
    )
