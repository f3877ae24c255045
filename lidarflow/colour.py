"""How motion over ground is drawn: its colours, their legend, and the objects that move.

Hue is the direction of motion in the ground plane, saturation and brightness are the speed, and what does not
move is dark grey.
"""

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

BACKGROUND = (11, 12, 16)
STATIC_GREY = 70
NEXT_SCAN = (0, 150, 190)
MOVED_SCAN = (255, 130, 30)
ARROW = (255, 255, 255)
FULL_SPEED_M_PER_S = 10.0
WHEEL_RADIUS = 0.31  # of the legend's size

_SLOW_SPEED_M_PER_S = 0.5
_SLOW_SATURATION, _FULL_SATURATION = 0.55, 1.0
_SLOW_VALUE = 0.85
_SHADE_BELOW_M, _SHADE_ABOVE_M = -2.0, 2.5
_CLUSTER_CELL_M = 0.7
_MIN_POINTS, _MOST_OBJECTS = 10, 40     # of a group that is shown, and groups


def motion_colours(residual_flow: np.ndarray, is_dynamic: np.ndarray, dt_s: float,
                   full_speed_m_per_s: float = FULL_SPEED_M_PER_S) -> np.ndarray:
    """Colours (N, 3) uint8 of points by their residual flow; static and unknown points are dark grey.

    residual_flow (N, 3) metres within `dt_s`; is_dynamic (N,) bool; full saturation at `full_speed_m_per_s`.
    """
    colours = np.full((len(residual_flow), 3), STATIC_GREY, np.uint8)
    moving = is_dynamic & np.isfinite(residual_flow).all(axis=1)
    x, y = residual_flow[moving, 0], residual_flow[moving, 1]
    share = (np.hypot(x, y) / dt_s - _SLOW_SPEED_M_PER_S) / (full_speed_m_per_s - _SLOW_SPEED_M_PER_S)
    share = np.clip(share, 0.0, 1.0)
    hue = np.arctan2(y, x) / (2.0 * np.pi) % 1.0
    saturation = _SLOW_SATURATION + share * (_FULL_SATURATION - _SLOW_SATURATION)
    colours[moving] = np.round(255.0 * hsv_to_rgb(hue, saturation, _SLOW_VALUE + share * (1.0 - _SLOW_VALUE)))
    return colours


def static_shade(points: np.ndarray) -> np.ndarray:
    """Greys (N, 3) uint8 of points (N, 3) in metres, brighter with height so that walls rise from ground."""
    height = np.nan_to_num(points[:, 2], nan=_SHADE_BELOW_M)
    share = np.clip((height - _SHADE_BELOW_M) / (_SHADE_ABOVE_M - _SHADE_BELOW_M), 0.0, 1.0)
    grey = STATIC_GREY * (0.75 + 1.05 * share)
    return np.repeat(np.round(grey).astype(np.uint8)[:, None], 3, axis=1)


def scene_colours(points: np.ndarray, residual_flow: np.ndarray, is_dynamic: np.ndarray,
                  dt_s: float) -> np.ndarray:
    """Colours (N, 3) uint8 of a scan: moving points by their residual flow in metres, the rest by height."""
    coloured = motion_colours(residual_flow, is_dynamic, dt_s)
    return np.where(is_dynamic[:, None], coloured, static_shade(points))


def moving_objects(
    points: np.ndarray, residual_flow: np.ndarray, is_dynamic: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Tops (K, 3) and mean residual flow (K, 3) of groups of moving points, in metres, largest group first.

    A top is the middle of a group in the ground plane at the height of its highest point.
    """
    moving = is_dynamic & np.isfinite(points).all(axis=1) & np.isfinite(residual_flow).all(axis=1)
    if not moving.any():
        return np.empty((0, 3)), np.empty((0, 3))
    points, residual_flow = points[moving], residual_flow[moving]
    cell = np.floor(points[:, :2] / _CLUSTER_CELL_M).astype(int)
    cell -= cell.min(axis=0)
    occupied = np.zeros(cell.max(axis=0) + 1, bool)
    occupied[cell[:, 0], cell[:, 1]] = True
    group = ndimage.label(occupied, structure=np.ones((3, 3)))[0][cell[:, 0], cell[:, 1]]
    size = np.bincount(group)
    order = np.argsort(-size, kind="stable")
    order = order[size[order] >= _MIN_POINTS][:_MOST_OBJECTS]
    top = ndimage.maximum(points[:, 2], group, order)

    def mean(column: np.ndarray) -> np.ndarray:
        return np.bincount(group, column)[order] / size[order]

    tops = np.stack([mean(points[:, 0]), mean(points[:, 1]), top], axis=1)
    return tops, np.stack([mean(column) for column in residual_flow.T], axis=1)


def wheel(size_px: int, full_speed_m_per_s: float = FULL_SPEED_M_PER_S) -> np.ndarray:
    """Legend (size_px, size_px, 3) uint8: a colour per direction and speed; x forward is up, y is left."""
    centre, radius = (size_px - 1) / 2.0, WHEEL_RADIUS * size_px
    row, column = np.mgrid[:size_px, :size_px]
    velocity = np.stack([centre - row, centre - column, np.zeros_like(row)], axis=-1).reshape(-1, 3)
    velocity = velocity / radius * full_speed_m_per_s
    inside = np.hypot(velocity[:, 0], velocity[:, 1]) <= full_speed_m_per_s
    pixels = np.full((size_px * size_px, 3), BACKGROUND, np.uint8)
    pixels[inside] = motion_colours(velocity[inside], np.ones(inside.sum(), bool), 1.0, full_speed_m_per_s)
    image = Image.fromarray(pixels.reshape(size_px, size_px, 3))
    _label_wheel(ImageDraw.Draw(image), centre, radius, full_speed_m_per_s)
    return np.asarray(image)


def font(height_px: float) -> ImageFont.FreeTypeFont:
    """Pillow's own font, the same on every machine."""
    return ImageFont.load_default(size=max(8.0, height_px))


def _label_wheel(draw: ImageDraw.ImageDraw, centre: float, radius: float, full_speed_m_per_s: float) -> None:
    """Speed rings at half and full speed, and the four directions around them."""
    text, small, gap = font(radius * 0.2), font(radius * 0.17), radius * 0.08
    for share in (0.5, 1.0):
        ring = share * radius
        draw.ellipse((centre - ring, centre - ring, centre + ring, centre + ring), outline=BACKGROUND)
        along = ring * np.sqrt(0.5)
        label = f"{share * full_speed_m_per_s:g} m/s"
        draw.text((centre + along, centre + along), label, (255, 255, 255), small,
                  anchor="mm" if share < 1 else "lt", stroke_width=2, stroke_fill=BACKGROUND)
    for label, x, y, anchor in (("forward", 0, -1, "mb"), ("back", 0, 1, "mt"),
                                ("left", -1, 0, "rm"), ("right", 1, 0, "lm")):
        reach = radius + gap
        draw.text((centre + x * reach, centre + y * reach), label, (220, 220, 220), text, anchor=anchor)


def hsv_to_rgb(hue: np.ndarray, saturation: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Red, green and blue (N, 3) in 0..1 of hue, saturation and value (N,) in 0..1."""
    sector = (np.array([5.0, 3.0, 1.0]) + hue[:, None] * 6.0) % 6.0
    ramp = np.clip(np.minimum(sector, 4.0 - sector), 0.0, 1.0)
    return value[:, None] * (1.0 - saturation[:, None] * ramp)
