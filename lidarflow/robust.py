"""Robust kernels as pairs: the loss of a squared residual and the weight it implies.

Every kernel takes squared residuals `r2` (any shape, non-negative) and a `scale` in the unit of the
residual, and returns `(loss, weight)` with weight = d loss / d r2; near zero, loss = r2 and weight = 1.
Compiled kernels have their own lines for the weights, which the tests compare with these.
"""

import numpy as np


def truncated(r2: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic up to `scale`, constant beyond (twice Dewan et al. 2016, eq. 13, c² = scale²)."""
    r2 = np.asarray(r2, float)
    scale_sq = scale * scale
    return np.minimum(r2, scale_sq), (r2 <= scale_sq).astype(float)


def cauchy(r2: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Logarithmic growth, c² log(1 + (r/c)²) (twice Jaimez et al. 2017, eq. 6)."""
    ratio = np.asarray(r2, float) / (scale * scale)
    return scale * scale * np.log1p(ratio), 1.0 / (1.0 + ratio)


def geman_mcclure(r2: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Redescending, bounded by `scale²` (Geman and McClure 1985)."""
    ratio = np.asarray(r2, float) / (scale * scale)
    return scale * scale * ratio / (1.0 + ratio), 1.0 / (1.0 + ratio) ** 2
