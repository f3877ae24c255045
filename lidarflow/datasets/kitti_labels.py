"""KITTI's labelled boxes, in any of three files: tracking labels, raw tracklets, or a table of boxes."""

import csv
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from lidarflow import pose
from lidarflow.datasets import tables
from lidarflow.datasets.boxes import Box
from lidarflow.datasets.categories import category_of
from lidarflow.datasets.clouds import one_line
from lidarflow.errors import DataError

TABLE_COLUMNS = ("frame", "track_id", "type", "x", "y", "z", "length", "width", "height", "yaw")
_UNLABELLED = "DontCare"
# Length, width and up of a box in the camera's axes: right, forward and against down.
_CAMERA_FROM_BOX = pose.from_rotation_translation([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """What is labelled in a drive, by frame number; a frame without an entry has no object.

    name        the file's name
    boxes       in the LiDAR's frame at the time of the scan
    unlabelled  rectangles (K, 4) left, top, right, bottom in image 2, pixels, whose objects have no box
    """

    name: str
    boxes: dict[int, list[Box]]
    unlabelled: dict[int, np.ndarray] = field(default_factory=dict)


def read_tracking(path: Path, rectified_from_lidar: np.ndarray) -> Labels:
    """Labels of the tracking benchmark, label_02/SSSS.txt, whose boxes are in the rectified camera's frame.

    Columns are frame, track, type, truncated, occluded, alpha, left, top, right, bottom, h, w, l, x, y, z,
    rotation about the camera's y; x, y, z is the middle of the floor.
    """
    lidar_from_rectified = pose.inverse(rectified_from_lidar)
    boxes, unlabelled = defaultdict(list), defaultdict(list)
    for line in tables.read_lines(path):
        words = line.split()
        if len(words) < 17:
            raise DataError(f"{path}: expected 17 columns per line, got '{line.strip()[:60]}'")
        frame, track = (int(number) for number in tables.numbers_of_text(path, " ".join(words[:2]), 2))
        left, top, right, bottom, height, width, length, x, y, z, turn = tables.numbers_of_text(
            path, " ".join(words[6:17]), 11)
        if words[2] == _UNLABELLED:
            unlabelled[frame].append((left, top, right, bottom))
            continue
        turned = pose.exp(np.array([0.0, turn, 0, 0, 0, 0])) @ _CAMERA_FROM_BOX
        on_floor = lidar_from_rectified @ pose.from_translation([x, y, z]) @ turned
        boxes[frame].append(Box(
            track, category_of(words[2]), _risen(on_floor, height), np.array([length, width, height])))
    return Labels(path.name, dict(boxes), {frame: np.array(rows) for frame, rows in unlabelled.items()})


def read_tracklets(path: Path) -> Labels:
    """Labels of the raw recordings, tracklet_labels.xml; tz is the height of a box's floor."""
    def read() -> Iterable[tuple[int, Box]]:
        for track, item in enumerate(ElementTree.parse(path).getroot().iterfind("tracklets/item")):
            kind = category_of(item.findtext("objectType", ""))
            size = np.array([float(item.findtext(name)) for name in ("l", "w", "h")])
            first = int(item.findtext("first_frame"))
            for offset, place in enumerate(item.iterfind("poses/item")):
                x, y, z, yaw = (float(place.findtext(name)) for name in ("tx", "ty", "tz", "rz"))
                yield first + offset, Box(track, kind, _risen(pose.from_yaw(yaw, (x, y, z)), size[2]), size)

    return _checked(path, read, "tracklets as KITTI's raw recordings have them")


def read_table(path: Path) -> Labels:
    """A .csv file with a row per box: TABLE_COLUMNS, middle and size in metres, yaw in radians."""
    def read() -> Iterable[tuple[int, Box]]:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                x, y, z, length, width, height, yaw = (float(row[name]) for name in TABLE_COLUMNS[3:])
                yield int(row["frame"]), Box(int(row["track_id"]), category_of(row["type"]),
                                             pose.from_yaw(yaw, (x, y, z)), np.array([length, width, height]))

    return _checked(path, read, f"a table with the columns {', '.join(TABLE_COLUMNS)}")


def _risen(motion: np.ndarray, height_m: float) -> np.ndarray:
    """A box's pose in its middle from its pose on its floor."""
    return motion @ pose.from_translation([0.0, 0.0, height_m / 2])


def _checked(path: Path, read: Callable[[], Iterable[tuple[int, Box]]], expected: str) -> Labels:
    """The labels that `read` finds; DataError where the file holds something else."""
    boxes = defaultdict(list)
    try:
        for frame, box in read():
            if not (np.isfinite(box.sensor_from_box).all() and np.isfinite(box.size).all()):
                raise ValueError(f"frame {frame}: numbers that are not finite")
            boxes[frame].append(box)
    except (OSError, ValueError, KeyError, TypeError, ElementTree.ParseError) as error:
        raise DataError(f"{path}: expected {expected} ({one_line(error)})") from None
    return Labels(path.name, dict(boxes))
