"""The errors that Dewan et al. 2016 print: means over points, then mean ± standard deviation over frames."""

from collections.abc import Iterable

import numpy as np

from lidarflow import pose


def pose_errors(points: np.ndarray, motions: np.ndarray, true_motion: np.ndarray) -> tuple[float, float]:
    """The paper's t_e [m] and r_e [rad]: mean over points (N, 3) of the error of their motions (N, 4, 4).

    `true_motion` (4, 4) is what every one of the points did (Dewan et al. 2016, section V-A: a static
    scene, where it is the ego-motion). The translation is compared where the variable sits, at its point:
    at the sensor's origin, a turn of the point in place would count by its distance from the sensor.
    """
    if len(motions) == 0:
        return float("nan"), float("nan")
    truth = np.broadcast_to(true_motion, motions.shape)
    off_m = np.linalg.norm(pose.apply(motions, points) - pose.apply(truth, points), axis=1)
    return float(off_m.mean()), float(pose.rotation_distance(truth, motions).mean())


def over_frames(values: Iterable[float]) -> tuple[float, float]:
    """Mean and standard deviation of one value per frame; values that are not finite are left out.

    The deviation is that of the frames themselves (divided by their number); both are NaN without frames.
    """
    values = np.array([value for value in values if np.isfinite(value)])
    return (float(values.mean()), float(values.std())) if len(values) else (float("nan"), float("nan"))


def figures_over_frames(rows: Iterable[dict[str, float]]) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation of every figure, by name, that some frame has; one row a frame."""
    rows = list(rows)
    names = dict.fromkeys(name for row in rows for name in row)
    found = {name: over_frames(row[name] for row in rows if name in row) for name in names}
    return {name: (mean, std) for name, (mean, std) in found.items() if np.isfinite(mean)}
