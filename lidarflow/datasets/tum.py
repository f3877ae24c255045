"""What the TUM RGB-D benchmark writes beside its images: lists of files, and poses, by time in seconds."""

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from lidarflow import pose
from lidarflow.datasets import tables
from lidarflow.errors import DataError

ASSOCIATION_NS = 20_000_000
MAX_POSE_GAP_NS = 100_000_000


def read_list(path: Path) -> tuple[np.ndarray, list[str]]:
    """Times (N,) int64 in ns, increasing, and names of a file with 'seconds filename' lines; DataError."""
    rows = [line.split() for line in tables.read_lines(path)]
    times = []
    for row in rows:
        time_ns = _to_ns(row[0])
        if time_ns is None or len(row) != 2:
            raise DataError(f"{path}: expected lines 'seconds filename', got '{' '.join(row)[:60]}'")
        times.append(time_ns)
    order = np.argsort(np.array(times, np.int64), kind="stable")
    return np.array(times, np.int64)[order], [rows[index][1] for index in order]


def associate(first_ns: np.ndarray, second_ns: np.ndarray) -> np.ndarray:
    """Rows (K, 2) of two increasing lists of times that belong together, in order of time.

    One to one, the nearest in time first, never more than ASSOCIATION_NS apart.
    """
    begin = np.searchsorted(second_ns, first_ns - ASSOCIATION_NS, "left")
    end = np.searchsorted(second_ns, first_ns + ASSOCIATION_NS, "right")
    candidates = np.array([(i, j) for i, (low, high) in enumerate(zip(begin, end, strict=True))
                           for j in range(low, high)], int).reshape(-1, 2)
    apart_ns = np.abs(first_ns[candidates[:, 0]] - second_ns[candidates[:, 1]])
    taken_first, taken_second, found = set(), set(), []
    for i, j in candidates[np.argsort(apart_ns, kind="stable")].tolist():
        if i not in taken_first and j not in taken_second:
            taken_first.add(i)
            taken_second.add(j)
            found.append((i, j))
    return np.array(sorted(found), int).reshape(-1, 2)


def least_apart_ns(first_ns: np.ndarray, second_ns: np.ndarray) -> int:
    """How near two increasing lists of times, neither empty, come to each other."""
    after = np.searchsorted(second_ns, first_ns).clip(1, len(second_ns) - 1) if len(second_ns) > 1 else 0
    before = np.maximum(after - 1, 0)
    apart_ns = np.minimum(np.abs(second_ns[after] - first_ns), np.abs(second_ns[before] - first_ns))
    return int(apart_ns.min())


def read_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) int64 in ns, increasing, and poses (N, 4, 4) of 'seconds tx ty tz qx qy qz qw' lines."""
    table = tables.read_numbers(path, 8)
    if len(table) and np.linalg.norm(table[:, 4:], axis=1).min() < 0.5:
        raise DataError(f"{path}: holds a quaternion that is not of unit length; expected qx qy qz qw")
    # Seconds since 1970 in float64 would be a hundred nanoseconds off.
    times = [_to_ns(line.split()[0]) for line in tables.read_lines(path)]
    if None in times:
        raise DataError(f"{path}: holds a time that is none; expected seconds, not negative")
    order = np.argsort(np.array(times, np.int64), kind="stable")
    return np.array(times, np.int64)[order], pose.from_translation_quaternion(table[order, 1:])


def poses_at(times_ns: np.ndarray, known_ns: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) at `times_ns` (N,), between the known ones (M, 4, 4) before and after.

    NaN where there is none within MAX_POSE_GAP_NS on either side.
    """
    found = np.full((len(times_ns), 4, 4), np.nan)
    after = np.searchsorted(known_ns, times_ns, "left")
    for index, (time_ns, right) in enumerate(zip(times_ns, after, strict=True)):
        if right < len(known_ns) and known_ns[right] == time_ns:
            found[index] = poses[right]
        elif 0 < right < len(known_ns):
            gap_ns = known_ns[right] - known_ns[right - 1]
            if gap_ns <= MAX_POSE_GAP_NS:
                share = (time_ns - known_ns[right - 1]) / gap_ns
                found[index] = pose.interpolate(poses[right - 1], poses[right], share)
    return found


def _to_ns(seconds: str) -> int | None:
    """Nanoseconds of a number of seconds, exactly; None where it is negative, too large or no number."""
    try:
        time_ns = int(Decimal(seconds) * 10**9)
    except (InvalidOperation, ValueError, OverflowError):
        return None
    return time_ns if 0 <= time_ns < 2**62 else None
