"""Colour and depth images, and the camera that took them, from files."""

import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from lidarflow import settings
from lidarflow.datasets.clouds import one_line
from lidarflow.errors import DataError
from lidarflow.rgbd_types import Camera, RgbdFrame

DEFAULT_DEPTH_SCALE = 5000.0
_COLOUR_MODES = ("RGB", "RGBA", "RGBX", "P", "L", "LA", "YCbCr", "CMYK")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_MAX_PIXELS = 1 << 26
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP")     # others run other programs, or are rarely read
_MOST_PIXELS_PER_BYTE = 8 * 1032     # one bit each, and packed by deflate as far as that goes


def read_frame(color: Path, depth: Path, depth_scale: float = DEFAULT_DEPTH_SCALE, time_ns: int = 0,
               name: str | None = None) -> RgbdFrame:
    """A registered frame from a colour image (PNG, JPEG) and a 16-bit depth PNG, metres = pixel / scale.

    Intensity is the colour's luma. Raises DataError for files that cannot be read, that are not what they
    should be (8-bit depth, colour and depth swapped, no depth anywhere), or that differ in size.
    """
    colours, metres = read_color(color), read_depth(depth, depth_scale)
    if colours.shape[:2] != metres.shape:
        raise DataError(f"{depth}: {_size(metres)} pixels, but {color} has {_size(colours)}; "
                        "expected depth registered to the colour image, of the same size")
    return RgbdFrame.from_color(colours, metres, time_ns, name or Path(color).stem)


def read_color(path: Path) -> np.ndarray:
    """RGB (H, W, 3) uint8 of an 8-bit colour or grey image; DataError for anything else."""
    with _opened(path) as image:
        if image.mode.startswith(("I", "F")):
            raise DataError(f"{path}: a 16-bit image of one channel; expected a colour image "
                            "(are colour and depth swapped?)")
        if image.mode not in _COLOUR_MODES:
            raise DataError(f"{path}: an image of mode {image.mode}; expected 8-bit colour")
        return _pixels(path, image, "RGB")


def read_depth(path: Path, depth_scale: float = DEFAULT_DEPTH_SCALE) -> np.ndarray:
    """Depth (H, W) float32 in metres, pixel / depth_scale, 0 = none, of a 16-bit image; else DataError."""
    if not (np.isfinite(depth_scale) and depth_scale > 0):
        raise DataError(f"--depth-scale {depth_scale:g}: expected a positive number, metres = pixel / scale")
    with _opened(path) as image:
        if image.mode in _COLOUR_MODES or image.mode == "1":
            swapped = " (are colour and depth swapped?)" if image.mode in ("RGB", "RGBA", "YCbCr") else ""
            raise DataError(f"{path}: an 8-bit image of mode {image.mode}; expected 16-bit depth{swapped}")
        if not image.mode.startswith("I"):
            raise DataError(f"{path}: an image of mode {image.mode}; expected 16-bit depth")
        pixels = _pixels(path, image)
    if not (pixels > 0).any():
        raise DataError(f"{path}: no pixel has depth (all are 0); leave this image out")
    return (np.maximum(pixels, 0) / depth_scale).astype(np.float32)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file in pixels; DataError where it is none."""
    with _opened(path) as image:
        return image.size


def read_camera(path: Path) -> Camera:
    """The camera of a TOML file with width, height, fx, fy, cx, cy in pixels; DataError or ConfigError."""
    path = Path(path)
    found = settings.read_toml(path, "camera")
    expected = ("width", "height", *_INTRINSICS)
    unknown, missing = sorted(found.keys() - set(expected)), [key for key in expected if key not in found]
    if unknown or missing:
        problem = f"lacks {', '.join(missing)}" if missing else f"has unknown {', '.join(unknown)}"
        raise DataError(f"{path}: {problem}; expected {', '.join(expected)} in pixels")
    for key, value in found.items():
        whole = key in ("width", "height")
        if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
            raise DataError(f"{path}: {key} is {value!r}; expected {'a whole' if whole else 'a'} number")
    return camera_of(found["width"], found["height"], tuple(found[key] for key in _INTRINSICS), str(path))


def camera_of(width: int, height: int, intrinsics: tuple[float, float, float, float], origin: str) -> Camera:
    """A camera with intrinsics (fx, fy, cx, cy) in pixels; DataError, which names `origin`, if impossible."""
    try:
        return Camera(width, height, *(float(value) for value in intrinsics))
    except ValueError as error:
        raise DataError(f"{origin}: {one_line(error)}") from None


def check_camera(camera: Camera, width: int, height: int, image: Path, origin: str) -> None:
    """Raise DataError unless the camera's images have the size of `image`."""
    if (camera.width, camera.height) != (width, height):
        raise DataError(f"{origin}: a camera of {camera.width}x{camera.height} pixels, but {image} has "
                        f"{width}x{height}; expected the intrinsics for that size")


def _opened(path: Path) -> Image.Image:
    """The image with its header read; use as a context manager. DataError where that fails."""
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}; expected an image")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            # Out of memory: from a file, Pillow sets aside as much as a damaged chunk says that it holds.
            image = Image.open(BytesIO(path.read_bytes()), formats=_FORMATS)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: not a readable image ({one_line(error)})") from None
    pixels = image.width * image.height
    if pixels > _MAX_PIXELS:
        image.close()
        raise DataError(f"{path}: says {image.width}x{image.height} pixels; more than an RGB-D camera has")
    if pixels > _MOST_PIXELS_PER_BYTE * path.stat().st_size:
        image.close()
        raise DataError(f"{path}: says {image.width}x{image.height} pixels, which its {path.stat().st_size} "
                        "bytes cannot hold; damaged, get it again")
    return image


def _pixels(path: Path, image: Image.Image, mode: str | None = None) -> np.ndarray:
    try:
        return np.asarray(image if mode is None else image.convert(mode))
    except (OSError, SyntaxError, ValueError, MemoryError) as error:
        raise DataError(f"{path}: damaged image ({one_line(error)}); get it again") from None


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
