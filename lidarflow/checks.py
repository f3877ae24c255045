"""What the frozen data types check at their door; ValueErrors that say what was expected and found."""

import numpy as np

from lidarflow import pose


def check(name: str, array: np.ndarray, shape: tuple, kind: str) -> None:
    """Raise ValueError unless `array` has `shape` (None = any length) and dtype kind in `kind`."""
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{name}: expected a numpy array, got {type(array).__name__}")
    wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
    fits = array.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{name}: expected shape {wanted}, got {array.shape}")
    if array.dtype.kind not in kind:
        raise ValueError(f"{name}: expected dtype kind {kind!r}, got {array.dtype}")


def check_motion(name: str, motion: np.ndarray) -> None:
    """Raise ValueError unless `motion` is a finite rigid motion (4, 4)."""
    check(name, motion, (4, 4), "f")
    if not pose.is_rigid(motion, tolerance=1e-4):
        raise ValueError(f"{name}: expected a rigid motion, got\n{motion}")
