"""What is asked of the rows of tall arrays, by columns: numpy takes several times as long along short rows.

Where it counts, rows are gathered with `take` and `compress`, in a quarter of the time of an index.
"""

import numpy as np


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Euclidean lengths (N,) of vectors (N, 3)."""
    x, y, z = vectors.T
    return np.sqrt(x * x + y * y + z * z)


def are_finite(vectors: np.ndarray) -> np.ndarray:
    """Whether (N,) vectors (N, 3) are finite, all three of their numbers."""
    x, y, z = vectors.T
    return np.isfinite(x) & np.isfinite(y) & np.isfinite(z)


def whole_or_nan(vectors: np.ndarray) -> np.ndarray:
    """Vectors (N, 3) where those that are not finite are NaN as a whole: themselves, or a copy if need be."""
    if np.isfinite(vectors).all():
        return vectors
    gaps = np.flatnonzero(~are_finite(vectors))
    if np.isnan(vectors.take(gaps, axis=0)).all():
        return vectors
    vectors = vectors.copy()
    vectors[gaps] = np.nan
    return vectors


def spread(rows: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of the rows (N, …), evenly over their order."""
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).astype(int)]


def sparse(rows: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of the rows (N, …), in steps of one size.

    They may be half as many: of pixels or arrows side by side, uneven steps would show as a pattern.
    """
    return rows[:: max(-(-len(rows) // most), 1)]


def every_few(count: int, least: int) -> slice:
    """Which of `count` rows to take so that at least `least`, and fewer than twice as many, are left, if any.

    In steps of one size, as a slice: what is found of these rows can be written back among all.
    """
    return slice(None, None, max(count // least, 1))


def mean(vectors: np.ndarray) -> np.ndarray:
    """The mean (3,) of vectors (N, 3), at least one."""
    return np.einsum("ij->j", vectors) / len(vectors)


def median(values: np.ndarray) -> float:
    """As np.median of values (N,), at least one, none of them NaN: to look for those takes it longer."""
    half = len(values) // 2
    parted = np.partition(values, half)
    return float(parted[half] if len(values) % 2 else 0.5 * (parted[:half].max() + parted[half]))


def without_gaps(numbers: np.ndarray) -> np.ndarray:
    """Numbers (N,) int32, from 0 on, as (N,) int32 in the same order but without those that none has."""
    is_there = np.zeros(numbers.max(initial=-1) + 1, bool)
    is_there[numbers] = True
    return (np.cumsum(is_there, dtype=np.int32) - np.int32(1)).take(numbers)
