"""The vertical-angle correction of KITTI scans."""

import numpy as np

from lidarflow.errors import ConfigError


def correct_vertical_angle(points: np.ndarray) -> np.ndarray:
    """A copy of `points` (N, 3), metres, raised by the 0.205 degrees that KITTI's calibration lacks.

    The arithmetic is KISS-ICP's. Points on the vertical axis have no direction to be raised in and
    points that are not finite no elevation: both come back as they are.
    """
    from kiss_icp.pybind import kiss_icp_pybind

    corrected = points.copy()
    movable = np.isfinite(points).all(axis=1) & (np.hypot(points[:, 0], points[:, 1]) > 0)
    if movable.any():
        rows = kiss_icp_pybind._Vector3dVector(np.ascontiguousarray(points[movable], dtype=np.float64))
        corrected[movable] = np.asarray(kiss_icp_pybind._correct_kitti_scan(rows))
    return corrected


def is_wanted(setting: str, is_kitti: bool) -> bool:
    """Whether the setting "auto", "on" or "off" asks for the correction of data that is KITTI's or not."""
    wanted = {"auto": is_kitti, "on": True, "off": False}
    if setting not in wanted:
        raise ConfigError(f"kitti_correction: expected one of {', '.join(wanted)}, got {setting!r}")
    return wanted[setting]
