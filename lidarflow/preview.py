"""A bird's-eye picture of what moves where: x forward is up, y left is left."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lidarflow import colour, pose
from lidarflow.types import FlowResult, Scan, ScanPair

_TEXT = (220, 220, 220)
_QUIET = (150, 150, 150)
_SENSOR_M = 0.8
_SCALE_BAR_M = 10.0


def bird_eye(points: np.ndarray, colours: np.ndarray, is_dynamic: np.ndarray, residual_flow: np.ndarray,
             half_width_m: float = 40.0, size_px: int = 1200, dt_s: float = 0.1,
             caption: str = "", arrows: tuple[np.ndarray, np.ndarray] | None = None,
             legend: Image.Image | None = None) -> Image.Image:
    """Picture of a scan from above, moving points on top, an arrow as long as each object moves in a second.

    points, residual_flow (N, 3) metres, sensor frame; colours (N, 3) uint8; is_dynamic (N,) bool; arrows are
    starts (K, 3) in metres and velocities (K, 3) in m/s, one for each group of moving points if not given;
    the legend goes into the upper right corner, the colour wheel of motion if not given.
    """
    scale = size_px / (2.0 * half_width_m)
    pixels = np.full((size_px, size_px, 3), colour.BACKGROUND, np.uint8)
    _scatter(pixels, points[~is_dynamic], colours[~is_dynamic], scale, dot_px=max(1, size_px // 1000))
    if arrows is None:
        arrows = _arrows_of_groups(points, residual_flow, is_dynamic, dt_s)
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    _draw_sensor(draw, scale, size_px)
    _draw_scale_bar(draw, scale, size_px)
    if legend is None:
        legend = Image.fromarray(colour.wheel(size_px // 4))
    image.paste(legend, (size_px - legend.width, 0))
    margin = size_px // 50
    draw.text((margin, margin), caption, _TEXT, colour.font(size_px / 50))
    if len(arrows[0]):
        draw.text((margin, 2.5 * margin), "arrows: the way in 1 s", _QUIET, colour.font(size_px / 60))

    # What moves comes last: neither legend nor text nor scale may hide it.
    pixels = np.array(image)
    _scatter(pixels, points[is_dynamic], colours[is_dynamic], scale, dot_px=max(2, size_px // 240))
    image = Image.fromarray(pixels)
    _draw_arrows(ImageDraw.Draw(image), *arrows, scale, size_px)
    return image


def write_preview(path: Path, pair: ScanPair, result: FlowResult) -> None:
    """Write the bird's-eye picture of a pair's source scan as PNG, whatever the name of `path` ends in."""
    motion_picture(pair.source, result, pair.dt_s).save(path, format="PNG")


def motion_picture(source: Scan, result: FlowResult, dt_s: float, size_px: int = 1200) -> Image.Image:
    """Bird's-eye picture of a scan, coloured by the motion over ground found within `dt_s` seconds."""
    points = source.points
    residual_flow = result.residual_flow(points)
    colours = colour.scene_colours(points, residual_flow, result.is_dynamic, dt_s)
    caption = f"{source.name}: {int(result.is_dynamic.sum())} of {len(points)} points move over ground"
    arrows = (_arrows_of_objects(result) if result.objects
              else _arrows_of_groups(points, residual_flow, result.is_dynamic, dt_s))
    return bird_eye(points, colours, result.is_dynamic, residual_flow, dt_s=dt_s, size_px=size_px,
                    half_width_m=half_width(points, arrows), caption=caption, arrows=arrows)


def _arrows_of_objects(result: FlowResult) -> tuple[np.ndarray, np.ndarray]:
    """Middles (K, 3) in metres and velocities (K, 3) in m/s of the objects, source frame."""
    velocity = np.stack([found.velocity for found in result.objects])
    middles = np.stack([found.box_centre for found in result.objects])
    return middles, pose.turn(pose.inverse(result.ego_motion), velocity)


def _arrows_of_groups(points: np.ndarray, residual_flow: np.ndarray, is_dynamic: np.ndarray, dt_s: float
                      ) -> tuple[np.ndarray, np.ndarray]:
    """Tops (K, 3) in metres and velocities (K, 3) in m/s of groups of moving points, source frame."""
    tops, moved = colour.moving_objects(points, residual_flow, is_dynamic)
    return tops, moved / dt_s


def half_width(points: np.ndarray, arrows: tuple[np.ndarray, np.ndarray] | None = None) -> float:
    """Half of the picture's width in metres: most of the scan, at most 40 m, or more to hold all arrows."""
    reach_m = np.hypot(points[:, 0], points[:, 1])
    reach_m = reach_m[np.isfinite(reach_m)]
    width_m = float(np.clip(1.3 * np.quantile(reach_m, 0.95), 4.0, 40.0)) if len(reach_m) else 40.0
    if arrows is None or not len(arrows[0]):
        return width_m
    ends = np.concatenate([arrows[0], arrows[0] + arrows[1]])[:, :2]
    return max(width_m, 1.1 * float(np.abs(ends).max()))


def _to_pixel(points: np.ndarray, scale: float, size_px: int) -> np.ndarray:
    """Column and row (..., 2) float of points (..., 3) in metres; `scale` in pixels per metre."""
    return size_px / 2.0 - points[..., [1, 0]] * scale


def _scatter(pixels: np.ndarray, points: np.ndarray, colours: np.ndarray, scale: float, dot_px: int) -> None:
    """Draw square dots into `pixels` (H, H, 3); of several in one place the brightest stays."""
    size_px = len(pixels)
    finite = np.isfinite(points).all(axis=1)
    points, colours = points[finite], colours[finite]
    corner = np.floor(_to_pixel(points, scale, size_px) - (dot_px - 1) / 2.0).astype(int)
    order = np.argsort(colours.sum(axis=1, dtype=int), kind="stable")
    corner, colours = corner[order], colours[order]
    for row_shift in range(dot_px):
        for column_shift in range(dot_px):
            column, row = corner[:, 0] + column_shift, corner[:, 1] + row_shift
            inside = (column >= 0) & (column < size_px) & (row >= 0) & (row < size_px)
            pixels[row[inside], column[inside]] = colours[inside]


def _draw_sensor(draw: ImageDraw.ImageDraw, scale: float, size_px: int) -> None:
    """A triangle at the sensor that points forward."""
    outline = np.array([(1.5, 0, 0), (-1, 1, 0), (-0.5, 0, 0), (-1, -1, 0)]) * _SENSOR_M
    draw.polygon([tuple(p) for p in _to_pixel(outline, scale, size_px)], fill=_TEXT)


def _draw_arrows(draw: ImageDraw.ImageDraw, tops: np.ndarray, velocity: np.ndarray, scale: float,
                 size_px: int) -> None:
    """The way each object at `tops` (K, 3) goes in one second at its velocity (K, 3) in m/s."""
    starts, tips = _to_pixel(tops, scale, size_px), _to_pixel(tops + velocity, scale, size_px)
    inside = ((starts >= 0) & (starts < size_px)).all(axis=1)
    starts, tips = starts[inside], tips[inside]
    speed_m_per_s = np.linalg.norm(velocity[inside], axis=1)
    for start, tip in zip(starts, tips, strict=True):
        _draw_arrow(draw, start, tip, size_px)
    taken = [tuple(box) for box in np.hstack([np.minimum(starts, tips), np.maximum(starts, tips)])]
    for tip, speed in zip(tips, speed_m_per_s, strict=True):
        _label_arrow(draw, tip, float(speed), taken, size_px)


def _draw_arrow(draw: ImageDraw.ImageDraw, start: np.ndarray, tip: np.ndarray, size_px: int) -> None:
    """An arrow between two pixels (2,)."""
    length_px = np.linalg.norm(tip - start)
    if length_px < 1:
        return
    along = (tip - start) / length_px
    # A head longer than half of the way would hide what goes slowly.
    across, head = np.array([-along[1], along[0]]), min(size_px / 90.0, 0.5 * length_px)
    neck = tip - along * head
    draw.line([tuple(start), tuple(neck)], fill=colour.ARROW, width=max(2, size_px // 400))
    draw.polygon([tuple(tip), tuple(neck + across * head * 0.5), tuple(neck - across * head * 0.5)],
                 fill=colour.ARROW)


def _label_arrow(draw: ImageDraw.ImageDraw, tip: np.ndarray, speed_m_per_s: float, taken: list,
                 size_px: int) -> None:
    """The speed beside the arrow's tip, unless it would cover one of the boxes `taken`, which it joins."""
    text, font, gap = f"{speed_m_per_s:.1f} m/s", colour.font(size_px / 70), size_px / 90.0
    for x, y, anchor in ((-1, 0, "rm"), (1, 0, "lm"), (0, -1, "mb"), (0, 1, "mt")):
        place = (tip[0] + x * gap, tip[1] + y * gap)
        box = draw.textbbox(place, text, font, anchor)
        within = min(box[:2]) >= 0 and max(box[2:]) <= size_px
        if within and not any(_overlap(box, other) for other in taken):
            taken.append(box)
            draw.text(place, text, colour.ARROW, font, anchor, stroke_width=2, stroke_fill=colour.BACKGROUND)
            return


def _overlap(a: tuple, b: tuple) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _draw_scale_bar(draw: ImageDraw.ImageDraw, scale: float, size_px: int) -> None:
    """A bar in the lower left corner that says how long it is."""
    left, bottom = size_px // 50, size_px - size_px // 50
    right, tick = left + _SCALE_BAR_M * scale, size_px // 150
    draw.line([(left, bottom), (right, bottom)], fill=_QUIET, width=max(2, size_px // 600))
    for end in (left, right):
        draw.line([(end, bottom - tick), (end, bottom + tick)], fill=_QUIET, width=max(2, size_px // 600))
    draw.text(((left + right) / 2, bottom - tick), f"{_SCALE_BAR_M:g} m", _QUIET, colour.font(size_px / 60),
              anchor="mb")
