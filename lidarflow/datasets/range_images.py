"""Folders of 16-bit range images with their geometry in img.cfg (F. Moosmann's Velodyne recordings)."""

from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from lidarflow.datasets import clouds, tables
from lidarflow.datasets.base import ScanFiles, frame_number
from lidarflow.datasets.folder import INDEXED_POSE_FILES, folder_name
from lidarflow.datasets.kitti_correction import is_wanted
from lidarflow.errors import DataError

PIXELS_PER_METRE = 500.0


class RangeImages(ScanFiles):
    """One numbered PNG per scan: range = pixel / 500 m, 0 = no return.

    A scan has a row per pixel, image row by image row; pixels without a return are NaN. Times come
    from imu.cfg, poses from derived_ego_icp.txt, where there are such files.
    """

    loader = "range_images"

    def __init__(self, folder: Path, sequence: str | None = None, kitti_correction: str = "auto"):
        folder = Path(folder) / sequence if sequence else Path(folder)
        files = list_images(folder)
        if not files:
            raise DataError(f"{folder}: no numbered .png files; expected range images beside img.cfg")
        self._directions = read_directions(folder / "img.cfg")
        times_ns, notes = _read_times(folder / "imu.cfg", files)
        self._poses = None
        for name in INDEXED_POSE_FILES:
            if self._poses is None and (folder / name).is_file():
                self._poses, pose_notes = tables.indexed_motions_of_scans(folder / name, files)
                notes = [*notes, *pose_notes]
        super().__init__(f"range_images {folder_name(folder)}", files, times_ns,
                         is_wanted(kitti_correction, False),
                         ["a pixel is 1/500 m, pixels without a return are NaN rows", *notes])

    def world_from_sensor(self) -> np.ndarray | None:
        """Given poses (N, 4, 4), where a file beside the images holds them."""
        return self._poses

    def _read(self, file: Path) -> np.ndarray:
        height, width = self._directions.shape[:2]
        try:
            # Out of memory: from a file, Pillow sets aside as much as a damaged chunk says that it holds.
            with Image.open(BytesIO(file.read_bytes()), formats=("PNG",)) as image:
                # Before the pixels are unpacked: a header may announce more than fits into memory.
                if image.size != (width, height) or not image.mode.startswith("I"):
                    raise DataError(f"{file}: an image {image.size[::-1]} of mode {image.mode}; "
                                    f"img.cfg says 16-bit {(height, width)}")
                pixels = np.asarray(image)
        except (OSError, SyntaxError, ValueError, MemoryError, Image.DecompressionBombError) as error:
            raise DataError(f"{file}: not a readable PNG image ({clouds.one_line(error)})") from None
        range_m = np.where(pixels > 0, pixels / PIXELS_PER_METRE, np.nan)
        if not np.isfinite(range_m).any():
            raise DataError(f"{file}: empty scan (no pixel has a return); leave this file out")
        return (range_m[..., None] * self._directions).reshape(-1, 3)


def list_images(folder: Path) -> list[Path]:
    """The PNG files of a folder whose names end in a number, in natural order."""
    images = [file for file in clouds.visible_files(folder) if file.suffix.lower() == ".png"]
    return clouds.natural_sorted(file for file in images if frame_number(file) is not None)


def read_directions(file: Path) -> np.ndarray:
    """Unit vectors (H, W, 3) of the pixels, x forward, y left, z up.

    The line of numbers is width; height; first and last azimuth; then first and last pitch, or the
    pitch of every row; degrees, azimuth to the left and pitch down positive.
    """
    lines = tables.read_lines(file)
    try:
        numbers = [float(word) for word in lines[-1].split(";") if word.strip()]
        width, height, left_deg, right_deg, *pitch_deg = numbers
        width, height = int(width), int(height)
        if not np.isfinite(numbers).all():
            raise ValueError
    except (IndexError, ValueError, OverflowError):
        raise DataError(f"{file}: expected a line 'width; height; angles in degrees ...'") from None
    if not (0 < width <= 1 << 16 and 0 < height <= 1 << 12 and len(pitch_deg) in (2, height)):
        raise DataError(f"{file}: says {width} x {height} pixels with {len(pitch_deg)} pitch angles; "
                        "expected 2 angles or one per row")
    azimuth = np.radians(left_deg + (np.arange(width) + 0.5) * (right_deg - left_deg) / width)
    if len(pitch_deg) != height:
        first_deg, last_deg = pitch_deg
        pitch_deg = first_deg + (np.arange(height) + 0.5) * (last_deg - first_deg) / height
    down = np.radians(pitch_deg)[:, None]
    x, y = np.cos(down) * np.cos(azimuth), np.cos(down) * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(-np.sin(down), x.shape)], axis=-1)


def _read_times(file: Path, files: list[Path]) -> tuple[list[int] | None, list[str]]:
    """Times in ns out of lines that begin with a date; None where there is no such file."""
    if not file.is_file():
        return None, []
    stamps = [line.split(";")[0].strip() for line in tables.read_lines(file) if line[:1].isdigit()]
    return tables.times_of_scans(file, [tables.date_to_ns(stamp, file) for stamp in stamps], files)
