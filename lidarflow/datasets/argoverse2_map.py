"""What an Argoverse 2 log's map knows of the ground."""

import json
from pathlib import Path

import numpy as np

from lidarflow.datasets.clouds import load_array, one_line
from lidarflow.errors import DataError

GROUND_M = 0.3     # the official labels call ground what is less far above it, or under it


def is_ground(folder: Path, points: np.ndarray) -> np.ndarray | None:
    """Ground (N,) among points (N, 3), metres in the city's frame; None where `folder` has no height map.

    The map is a raster of heights, *_ground_height_surface____*.npy, and the similarity that leads from the
    city's x, y to its columns and rows, *___img_Sim2_city.json. Points off the map, or where it has no
    height, are none.
    """
    rasters = sorted(folder.glob("*_ground_height_surface____*.npy"))
    similarities = sorted(folder.glob("*___img_Sim2_city.json"))
    if len(rasters) != 1 or len(similarities) != 1:
        return None
    height_m = _read_raster(rasters[0])
    rotation, translation, scale = _read_similarity(similarities[0])
    pixel = np.full((len(points), 2), -1.0)
    known = np.isfinite(points).all(axis=1)
    pixel[known] = scale * (points[known, :2] @ rotation.T + translation)
    # Coordinates are cut towards zero, as the official map does it.
    column, row = np.trunc(pixel).astype(np.int64).T
    inside = known & (column >= 0) & (row >= 0) & (column < height_m.shape[1]) & (row < height_m.shape[0])
    ground = np.zeros(len(points), bool)
    above_m = points[inside, 2] - height_m[row[inside], column[inside]]
    ground[inside] = above_m <= GROUND_M
    return ground


def _read_raster(file: Path) -> np.ndarray:
    height_m = load_array(file)
    if height_m.ndim != 2 or height_m.dtype.kind != "f":
        raise DataError(f"{file}: {height_m.shape} of {height_m.dtype}; expected heights in rows and columns")
    return height_m.astype(np.float64)


def _read_similarity(file: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation (2, 2), translation (2,) and scale: pixel = scale (rotation p + translation)."""
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        rotation = np.array(values["R"], float).reshape(2, 2)
        return rotation, np.array(values["t"], float).reshape(2), float(values["s"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(f"{file}: expected R, t and s of a similarity ({one_line(error)})") from None
