"""Rigid motion from matches of which many are wrong, by random sample consensus (Fischler, Bolles 1981).

Our own because Open3D's depends on how its threads are scheduled, and does not refine the best sample.
"""

import numpy as np

from lidarflow import pose, robust

_REACH_M = 0.3        # a match this far off still agrees: keypoints are 0.15 m apart
_CONFIDENCE = 0.9999
_BATCH = 100
_MOST_SAMPLES = 10_000
_MIN_CONSENSUS = 10   # fewer matches that agree may do so by chance
_REFINEMENTS = 20


def rigid_motion(
    source: np.ndarray, target: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray | None, np.ndarray, int]:
    """Motion (4, 4) that most matches (K, 3) → (K, 3) in metres agree with, which (K,) do, samples drawn.

    Samples of three are scored by the truncated squares of all matches (MSAC, Torr and Zisserman 2000); the
    best is fitted to its inliers until these no longer change. None where too few agree.
    """
    best, least, drawn, needed = None, np.inf, 0, _MOST_SAMPLES
    while len(source) >= 3 and drawn < min(needed, _MOST_SAMPLES):
        drawn += _BATCH
        for motion in _samples(source, target, rng):
            loss, agrees = robust.truncated(_off_sq(motion, source, target), _REACH_M)
            if loss.sum() < least:
                best, least, needed = motion, loss.sum(), _samples_needed(agrees.mean())
    inlier = np.zeros(len(source), bool)
    if best is None:
        return None, inlier, drawn
    for _ in range(_REFINEMENTS):
        before, inlier = inlier, _off_sq(best, source, target) <= _REACH_M**2
        if inlier.sum() < _MIN_CONSENSUS:
            return None, np.zeros(len(source), bool), drawn
        if (inlier == before).all():
            break
        best = pose.aligned(source[inlier], target[inlier])
    return best, inlier, drawn


def _samples(source: np.ndarray, target: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Motions (S, 4, 4) of the random triples that are congruent in both scans."""
    rows = rng.integers(len(source), size=(_BATCH, 3))
    motions = pose.aligned(source[rows], target[rows])
    off = pose.apply(motions[:, None], source[rows]) - target[rows]
    return motions[(np.linalg.norm(off, axis=-1) <= _REACH_M).all(axis=1)]


def _off_sq(motion: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    return ((pose.apply(motion, source) - target) ** 2).sum(axis=1)


def _samples_needed(inlier_share: float) -> float:
    """Samples after which one of three inliers is missing with a chance of 1 − confidence."""
    all_three = inlier_share**3
    if all_three >= 1.0:
        return 0.0
    return np.log(1.0 - _CONFIDENCE) / np.log1p(-all_three) if all_three > 0 else np.inf
