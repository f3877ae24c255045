"""Points of a ROS message sensor_msgs/PointCloud2, however its package represents messages."""

from typing import Any

import numpy as np

from lidarflow.errors import DataError

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}     # sensor_msgs/PointField


def read(message: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) float64 in metres, rows without a finite point left out, and no times (0,).

    Raises DataError for a message without x, y and z, and one whose data are not as long as it says.
    """
    fields = {field.name: field for field in message.fields}
    if any(axis not in fields or fields[axis].datatype not in _TYPES for axis in "xyz"):
        raise DataError(f"a PointCloud2 has the fields {', '.join(fields) or 'none'}; expected x, y and z")
    order = ">" if message.is_bigendian else "<"
    row = np.dtype({
        "names": list("xyz"), "formats": [order + _TYPES[fields[axis].datatype] for axis in "xyz"],
        "offsets": [fields[axis].offset for axis in "xyz"], "itemsize": message.point_step})
    stored = np.frombuffer(message.data, np.uint8)
    line_bytes = message.width * message.point_step
    if len(stored) != message.height * message.row_step or message.row_step < line_bytes:
        raise DataError(f"a PointCloud2 has {len(stored)} bytes for {message.height} rows of {message.width} "
                        "points; the recording is damaged")
    lines = stored.reshape(message.height, message.row_step)[:, :line_bytes]
    rows = np.frombuffer(lines.tobytes(), row)
    points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return points[np.isfinite(points).all(axis=1)], np.empty(0)
