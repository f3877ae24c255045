"""Bird's-eye pictures of a pair as PNG bytes: what moves, and where the flow is wrong."""

import io
import itertools

import numpy as np
from PIL import Image, ImageDraw

from lidarflow import colour, metrics, preview
from lidarflow.types import FlowResult, Scan, Truth

SIZE_PX = 760
# Steps at the thresholds of the strict and the relaxed accuracy and of the outliers. Brightness grows with
# the error: of several points in one place the brightest, so the worst, is drawn.
ERROR_EDGES_M = (0.02, 0.05, 0.1, 0.3)
ERROR_COLOURS = np.array([(50, 62, 96), (46, 98, 158), (60, 168, 110), (246, 172, 40), (255, 92, 132)],
                         np.uint8)
UNKNOWN = np.array((32, 32, 34), np.uint8)
_NAMED_COLOURS = 128
_TEXT = (220, 220, 220)


def motion_png(source: Scan, result: FlowResult, dt_s: float) -> bytes:
    """What moves over ground and where to, as in preview.png."""
    return png(preview.motion_picture(source, result, dt_s, SIZE_PX))


def error_png(source: Scan, result: FlowResult, truth: Truth) -> bytes:
    """End-point error of every point, truly moving points large; dark grey where it is not known."""
    points = source.points
    known = truth.valid & np.isfinite(result.flow).all(axis=1) & np.isfinite(points).all(axis=1)
    error_m = metrics.end_point_error(result.flow[known], truth.flow[known])
    colours = np.tile(UNKNOWN, (len(points), 1))
    colours[known] = error_colours(error_m)
    nowhere = np.empty((0, 3))
    mean = f"mean error {error_m.mean():.3f} m" if len(error_m) else "no point with truth"
    picture = preview.bird_eye(
        points, colours, known & truth.is_dynamic, np.zeros_like(points), size_px=SIZE_PX,
        half_width_m=preview.half_width(points), caption=f"{source.name}: {mean} of {len(error_m)} points",
        arrows=(nowhere, nowhere), legend=_error_legend(error_m))
    return png(picture)


def error_colours(error_m: np.ndarray) -> np.ndarray:
    """Colours (N, 3) uint8 of end-point errors (N,) in metres."""
    return ERROR_COLOURS[np.searchsorted(ERROR_EDGES_M, error_m, side="right")]


def png(image: Image.Image) -> bytes:
    """The picture with few colours, so that pages stay small; equal pictures give equal bytes."""
    few = image.quantize(_NAMED_COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    held = io.BytesIO()
    few.save(held, format="PNG", optimize=True)
    return held.getvalue()


def _error_legend(error_m: np.ndarray) -> Image.Image:
    """The colours, what they stand for, and the share of the points that have them."""
    line_px = SIZE_PX // 36
    image = Image.new("RGB", (int(11.5 * line_px), 7 * line_px), colour.BACKGROUND)
    draw, font = ImageDraw.Draw(image), colour.font(line_px * 0.72)
    names = [f"below {ERROR_EDGES_M[0]:g} m",
             *(f"{low:g} to {high:g} m" for low, high in itertools.pairwise(ERROR_EDGES_M)),
             f"{ERROR_EDGES_M[-1]:g} m and more"]
    counts = np.bincount(np.searchsorted(ERROR_EDGES_M, error_m, side="right"), minlength=len(names))
    for k, (name, tone, count) in enumerate(zip(names, ERROR_COLOURS.tolist(), counts, strict=True)):
        top = (k + 1) * line_px
        draw.rectangle((0, top + 2, line_px - 4, top + line_px - 2), fill=tuple(tone))
        draw.text((line_px * 1.2, top + line_px / 2), name, _TEXT, font, anchor="lm")
        share = f"{100 * count / max(1, len(error_m)):.1f} %"
        draw.text((line_px * 11, top + line_px / 2), share, _TEXT, font, anchor="rm")
    return image
