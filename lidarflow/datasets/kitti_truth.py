"""True flow of KITTI drives from their labelled boxes and the poses of the LiDAR."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarflow import pose
from lidarflow.datasets.base import ScanFiles, frame_number
from lidarflow.datasets.boxes import DYNAMIC_M, box_around, height_in_box, truth_of_boxes
from lidarflow.datasets.kitti_labels import Labels
from lidarflow.types import Truth

# Only what the camera in front sees is labelled: beyond these bounds an object may go without a box.
HALF_VIEW_RAD = np.radians(40.0)
LABELLED_RANGE_M = (3.0, 50.0)
BOX_MARGIN_M = (0.1, 0.1, 0.1)
FLOOR_M = 0.15              # so far over the floor of a box, points may be of the road under it
# Boxes of parked cars are drawn anew in every scan and jitter by centimetres; over several scans they do not.
FRAMES_AROUND = 3


def labelled_truth(
    data: ScanFiles, index: int, labels: Labels, world_from_sensor: np.ndarray,
    image_from_sensor: np.ndarray | None = None,
) -> Truth | None:
    """Truth of the scan at `index` and its successor; None where that is not the next frame.

    world_from_sensor  (N, 4, 4)  poses of the data set's scans
    image_from_sensor  (3, 4)     projection into the image of labels.unlabelled, where it is known

    Points of a box that moves over ground follow it, all others the sensor. Valid are points where objects
    are labelled, up to the road under a box and what has been left unlabelled.
    """
    if not 0 <= index < len(data) - 1:
        return None
    frame, following = frame_number(data.files[index]), frame_number(data.files[index + 1])
    if frame is None or following != frame + 1:
        return None
    drawn_in = data.stored_points(index)     # boxes were drawn around the points of the file
    source, target = labels.boxes.get(frame, []), labels.boxes.get(following, [])
    row = box_around(drawn_in, source, BOX_MARGIN_M)
    truth = truth_of_boxes(
        data.scan(index).points, row, source, target,
        pose.inverse(world_from_sensor[index + 1]) @ world_from_sensor[index],
        f"boxes ({labels.name})", _still_tracks(data.files, index, labels, world_from_sensor))
    labelled = _in_labelled_view(drawn_in) & (height_in_box(drawn_in, source, row) >= FLOOR_M)
    if image_from_sensor is not None and frame in labels.unlabelled:
        labelled &= ~_in_rectangles(drawn_in, image_from_sensor, labels.unlabelled[frame]) | (row >= 0)
    return replace(truth, valid=truth.valid & labelled)


def with_classes(truth: Truth, labels: Labels) -> Truth:
    """`truth` with the classes that the labels give to its tracks; points of other tracks stay background."""
    kinds = {box.track: box.category for boxes in labels.boxes.values() for box in boxes}
    category = np.zeros(len(truth.object_id), np.int8)
    for track, kind in kinds.items():
        category[truth.object_id == track] = kind
    return replace(truth, category=category)


def _still_tracks(files: list[Path], index: int, labels: Labels, world_from_sensor: np.ndarray) -> set[int]:
    """Tracks whose boxes, seen over several frames, keep their place in the world."""
    places = {}
    for near in range(max(0, index - FRAMES_AROUND), min(len(files), index + 2 + FRAMES_AROUND)):
        frame = frame_number(files[near])
        for box in labels.boxes.get(frame, []):
            place = pose.apply(world_from_sensor[near], box.sensor_from_box[:3, 3])
            places.setdefault(box.track, []).append((frame, place))
    still = set()
    for track, seen in places.items():
        (first, start), (last, end) = seen[0], seen[-1]
        if last > first and np.linalg.norm(end - start) < DYNAMIC_M * (last - first):
            still.add(track)
    return still


def _in_labelled_view(points: np.ndarray) -> np.ndarray:
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    range_m = np.linalg.norm(points, axis=1)
    return ((np.abs(azimuth) < HALF_VIEW_RAD) & (range_m > LABELLED_RANGE_M[0])
            & (range_m < LABELLED_RANGE_M[1]))


def _in_rectangles(points: np.ndarray, image_from_sensor: np.ndarray, rectangles: np.ndarray) -> np.ndarray:
    """Points (N, 3) before the camera whose pixels lie in one of the rectangles (K, 4)."""
    projected = points @ image_from_sensor[:, :3].T + image_from_sensor[:, 3]
    ahead = projected[:, 2] > 0
    pixel = np.full((len(points), 2), np.nan)
    pixel[ahead] = projected[ahead, :2] / projected[ahead, 2:]
    inside = np.zeros(len(points), bool)
    for left, top, right, bottom in rectangles:
        inside |= ((pixel >= (left, top)) & (pixel <= (right, bottom))).all(axis=1)
    return inside
