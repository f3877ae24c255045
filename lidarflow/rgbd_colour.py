"""How images of an RGB-D result are coloured, in pictures and recordings alike.

Motion: hue is the direction in the image, saturation how much of it is across the line of sight (white =
towards the camera or away), strength the length. Segmentation: blue is static, red moves. Black: no depth.
"""

import numpy as np
from PIL import Image, ImageDraw

from lidarflow import colour

STATIC, MOVING = (45, 95, 235), (235, 45, 40)
_NEAR_TO_FAR = np.array([(255, 245, 190), (252, 165, 80), (205, 65, 90), (115, 30, 125), (35, 20, 75)], float)
_GOLDEN_RATIO = 0.618034
_DARKEST = 0.5             # how much of a colour is left on a black surface
_STILL_GREY = 0.75         # how bright still surfaces are drawn under motion
_LEAST_FULL_M = 0.01       # shorter flow is never drawn at full strength


def depth_range(depth: np.ndarray) -> tuple[float, float]:
    """The depths in metres that nearly all of an image (H, W) lies between."""
    known = depth[depth > 0]
    near_m, far_m = np.quantile(known, (0.02, 0.98)) if len(known) else (0.0, 1.0)
    return float(near_m), float(far_m)


def depth_colours(depth: np.ndarray, near_m: float, far_m: float) -> np.ndarray:
    """RGB (H, W, 3) uint8 of depth (H, W) in metres, bright = `near_m` or nearer, dark = far; 0 is black."""
    place = np.clip((depth - near_m) / max(far_m - near_m, 1e-6), 0.0, 1.0) * (len(_NEAR_TO_FAR) - 1)
    known = np.arange(len(_NEAR_TO_FAR))
    channels = [np.interp(place, known, channel) for channel in _NEAR_TO_FAR.T]
    return _rounded(np.stack(channels, axis=-1) * (depth > 0)[..., None])


def label_colours(label: np.ndarray) -> np.ndarray:
    """RGB (H, W, 3) uint8 of clusters (H, W), neighbouring numbers far apart in hue; −1 is black."""
    number = np.arange(max(label.max() + 1, 1))
    saturation, value = 0.45 + 0.3 * (number % 2), 0.75 + 0.25 * (number % 3 > 0)
    palette = colour.hsv_to_rgb(number * _GOLDEN_RATIO % 1.0, saturation, value)
    return _rounded(255.0 * np.vstack([palette, np.zeros(3)])[label])


def segmentation_colours(b_image: np.ndarray, intensity: np.ndarray | None = None) -> np.ndarray:
    """RGB (H, W, 3) uint8 of b (H, W), blue at 0, red at 1, NaN black; shaded by intensity (H, W) in 0..1."""
    share = np.clip(np.nan_to_num(b_image), 0.0, 1.0)[..., None]
    colours = (1.0 - share) * STATIC + share * MOVING
    colours = colours * np.isfinite(b_image)[..., None]
    return _rounded(colours if intensity is None else colours * _shade(intensity))


def motion_colours(flow: np.ndarray, valid: np.ndarray, full_m: float,
                   intensity: np.ndarray | None = None) -> np.ndarray:
    """RGB (H, W, 3) uint8 of flow (H, W, 3) in metres, camera axes; full strength at `full_m`.

    What is not valid (H, W) is black; what does not move shows the intensity (H, W) in 0..1, or grey.
    """
    x, y, _ = np.moveaxis(flow.astype(float), -1, 0)
    length_m, across_m = np.linalg.norm(flow.astype(float), axis=-1), np.hypot(x, y)
    hue = np.arctan2(-y, x) / (2.0 * np.pi) % 1.0
    saturation = across_m / np.maximum(length_m, 1e-9)
    vivid = 255.0 * colour.hsv_to_rgb(hue.ravel(), saturation.ravel(), np.ones(hue.size)).reshape(flow.shape)
    strength = np.clip(length_m / full_m, 0.0, 1.0)[..., None]
    still = 0.5 if intensity is None else intensity[..., None]
    shade = 1.0 if intensity is None else _shade(intensity)
    mixed = strength * vivid * shade + (1.0 - strength) * 255.0 * _STILL_GREY * still
    return _rounded(mixed * valid[..., None])


def full_strength_m(flow: np.ndarray, valid: np.ndarray) -> float:
    """The length that is drawn at full strength: nearly the longest of flow (H, W, 3), rounded up to 5 mm."""
    if not valid.any():
        return _LEAST_FULL_M
    long_m = float(np.quantile(np.linalg.norm(flow[valid], axis=-1), 0.99))
    return max(_LEAST_FULL_M, float(np.ceil(long_m / 0.005) * 0.005))


def wheel(size_px: int, full_m: float) -> np.ndarray:
    """Legend (size_px, size_px, 3) uint8 of `motion_colours`: the direction in the image, out to `full_m`."""
    middle, radius = (size_px - 1) / 2.0, 0.34 * size_px
    row, column = np.mgrid[:size_px, :size_px]
    x, y = (column - middle) / radius * full_m, (row - middle) / radius * full_m
    inside = np.hypot(x, y) <= full_m
    pixels = motion_colours(np.stack([x, y, np.zeros_like(x)], axis=-1), inside, full_m)
    pixels[~inside] = colour.BACKGROUND
    image = Image.fromarray(pixels)
    ImageDraw.Draw(image).text((middle, size_px - 1), f"{1000 * full_m:.0f} mm", (230, 230, 230),
                               colour.font(size_px / 8), anchor="mb")
    return np.asarray(image)


def _shade(intensity: np.ndarray) -> np.ndarray:
    """How much of a colour a surface of an intensity (H, W) shows, (H, W, 1)."""
    return (_DARKEST + (1.0 - _DARKEST) * intensity)[..., None]


def _rounded(colours: np.ndarray) -> np.ndarray:
    return np.round(colours).astype(np.uint8)
