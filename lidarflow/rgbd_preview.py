"""A picture of one RGB-D result beside its input."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lidarflow import colour, rgbd_colour
from lidarflow.rgbd_types import RgbdFrame, RgbdResult

_PANEL_WIDTH_PX = 520
_CAPTION_PX = 30
_GAP_PX = 6
_TEXT = (225, 225, 225)
_LEGEND_SHARE = 0.24     # of a panel's height


def picture(source: RgbdFrame, result: RgbdResult) -> Image.Image:
    """Colour, depth and clusters above; segmentation, total flow and own motion below."""
    valid, depth = result.valid, result.points[..., 2]
    height, width = valid.shape
    intensity = _resized(Image.fromarray(np.round(255 * source.intensity).astype(np.uint8)), width, height)
    intensity = np.asarray(intensity) / 255.0
    photo = source.color if source.color is not None else np.repeat(
        np.round(255 * source.intensity).astype(np.uint8)[..., None], 3, axis=2)
    own_motion = result.residual_flow()
    near_m, far_m = rgbd_colour.depth_range(depth)
    full_m = [rgbd_colour.full_strength_m(flow, valid) for flow in (result.flow, own_motion)]
    moving = result.is_dynamic[valid].mean() if valid.any() else 0.0
    panels = [
        (f"{source.name}: colour", photo, None),
        (f"depth, {near_m:.1f} (bright) to {far_m:.1f} m",
         rgbd_colour.depth_colours(depth, near_m, far_m), None),
        (f"{len(result.b)} clusters", rgbd_colour.label_colours(result.label), None),
        (f"static (blue) or moving (red, {100 * moving:.0f} %)",
         rgbd_colour.segmentation_colours(result.b_image, intensity), None),
        ("total flow; white = to or from the camera",
         rgbd_colour.motion_colours(result.flow, valid, full_m[0], intensity), full_m[0]),
        ("own motion: the flow without the camera's",
         rgbd_colour.motion_colours(own_motion, valid, full_m[1], intensity), full_m[1]),
    ]
    return _sheet(panels, columns=3, panel_px=(_PANEL_WIDTH_PX, round(_PANEL_WIDTH_PX * height / width)))


def write_preview(path: Path, source: RgbdFrame, result: RgbdResult) -> None:
    """Write the picture of a result as PNG, whatever the name of `path` ends in."""
    picture(source, result).save(path, format="PNG")


def _sheet(panels: list[tuple[str, np.ndarray, float | None]], columns: int,
           panel_px: tuple[int, int]) -> Image.Image:
    """Captioned images (…, 3) uint8 in rows; those with a length in metres have the wheel of colours."""
    width, height = panel_px
    rows = -(-len(panels) // columns)
    size = (columns * (width + _GAP_PX) + _GAP_PX, rows * (height + _CAPTION_PX + _GAP_PX) + _GAP_PX)
    sheet = Image.new("RGB", size, colour.BACKGROUND)
    draw, font = ImageDraw.Draw(sheet), colour.font(0.62 * _CAPTION_PX)
    for index, (caption, image, full_m) in enumerate(panels):
        left = _GAP_PX + index % columns * (width + _GAP_PX)
        top = _GAP_PX + index // columns * (height + _CAPTION_PX + _GAP_PX)
        draw.text((left + 4, top + _CAPTION_PX / 2), caption, _TEXT, font, anchor="lm")
        sheet.paste(_resized(Image.fromarray(image), width, height), (left, top + _CAPTION_PX))
        if full_m is not None:
            legend_px = round(_LEGEND_SHARE * height)
            legend = Image.fromarray(rgbd_colour.wheel(legend_px, full_m))
            sheet.paste(legend, (left + width - legend_px, top + _CAPTION_PX + height - legend_px))
    return sheet


def _resized(image: Image.Image, width: int, height: int) -> Image.Image:
    """Smaller by area, larger by whole pixels, so that none is invented."""
    smaller = width < image.width
    return image.resize((width, height), Image.Resampling.BOX if smaller else Image.Resampling.NEAREST)
