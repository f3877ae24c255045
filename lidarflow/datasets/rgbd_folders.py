"""Sequences of RGB-D images: TUM folders, folders of numbered images, and the camera that took them."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidarflow.datasets import clouds, tables, tum
from lidarflow.datasets.base import frame_number, in_words_of_the_file
from lidarflow.datasets.folder import folder_name
from lidarflow.datasets.one_by_one import OneByOne
from lidarflow.datasets.rgbd_images import (
    DEFAULT_DEPTH_SCALE,
    camera_of,
    check_camera,
    image_size,
    read_camera,
    read_frame,
)
from lidarflow.errors import DataError
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdTruth

CAMERA_FILE = "camera.toml"
FREIBURG = {"1": (517.3, 516.5, 318.6, 255.3), "2": (520.9, 521.0, 325.1, 249.7),
            "3": (535.4, 539.2, 320.1, 247.6)}
_FREIBURG_SIZE = (640, 480)
_FREIBURG_NAME = re.compile(r"(?<![a-z])(?:freiburg|fr)([123])(?!\d)")
_PERIOD_NS = 33_333_333
# Folder of the colour images and the depth scale that goes with it: Open3D's, Redwood's, TUM's.
_COLOR_FOLDERS = {"color": 1000.0, "image": 1000.0, "rgb": DEFAULT_DEPTH_SCALE}
_DEPTH_FOLDER = "depth"
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, slots=True)
class CameraChoice:
    """What the user says of the camera: a TOML file, or fx, fy, cx, cy in pixels, or nothing."""

    file: Path | None = None
    intrinsics: tuple[float, float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class _Listing:
    """Images that belong together, in order of time; `pose_file` may be missing."""

    layout: str
    color: list[Path]
    depth: list[Path]
    times_ns: list[int]
    names: list[str]
    depth_scale: float
    pose_file: Path
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RgbdSource:
    """What RGB-D frames are made of: a folder, the camera, and depth in metres = pixel / depth_scale."""

    folder: Path
    camera: Camera
    depth_scale: float


class RgbdFolder(OneByOne[RgbdFrame]):
    """A sequence of RGB-D frames from the files of a folder; `for frame in folder` reads one after the other.

    name    what messages call it
    layout  "tum" or "images"
    notes   what was assumed while opening it
    camera  Camera
    source  RgbdSource
    """

    item = "frame"

    def __init__(self, folder: Path, listing: _Listing, camera: Camera, origin: str):
        clouds.check_names(listing.color)
        self.name = f"{listing.layout} {folder_name(folder)}"
        self.layout, self.camera = listing.layout, camera
        self.source = RgbdSource(folder.resolve(), camera, float(listing.depth_scale))
        self._folder, self._files = folder, listing
        self._poses, pose_notes = _poses(listing)
        self.notes = (f"camera: {origin}", f"depth in metres is pixel/{listing.depth_scale:g}",
                      *listing.notes, *pose_notes)

    def __len__(self) -> int:
        return len(self._files.color)

    def frame(self, index: int) -> RgbdFrame:
        """The frame at `index`; DataError where there is none or its files are damaged."""
        files, index = self._files, self.check_index(index)
        frame = read_frame(files.color[index], files.depth[index], files.depth_scale, files.times_ns[index],
                           files.names[index])
        height, width = frame.shape
        check_camera(self.camera, width, height, files.color[index], "the camera of the images")
        return frame

    def _item(self, index: int) -> RgbdFrame:
        return self.frame(index)

    def truth(self, index: int) -> RgbdTruth | None:
        """What happened from the frame at `index` to the next, where truth/<frame>.npz tells it."""
        file = self._folder / "truth" / f"{self._files.names[index]}.npz"
        if index + 1 >= len(self) or not file.is_file():
            return None
        arrays = clouds.load_arrays(file, ("flow", "odometry", "valid", "is_dynamic"))
        try:
            truth = RgbdTruth(**arrays)
        except ValueError as error:
            raise DataError(f"{file}: {in_words_of_the_file(error)}") from None
        height, width = truth.valid.shape
        check_camera(self.camera, width, height, file, "the camera of the images")
        return truth

    def world_from_camera(self) -> np.ndarray | None:
        """Given poses (N, 4, 4) at the times of the colour images, NaN where unknown; None without a file."""
        return self._poses


def open_rgbd(folder: Path, choice: CameraChoice | None = None,
              depth_scale: float | None = None) -> RgbdFolder:
    """The RGB-D sequence in `folder`: rgb.txt and depth.txt (TUM), color/ and depth/, or color0.png …

    Depth in metres is pixel / depth_scale: 5000 unless given, 1000 for color/ and depth/ as Open3D has them.
    Raises DataError for a folder that is missing or holds no such images.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder}: {'is a file' if folder.exists() else 'no such folder'}; "
                        "expected a folder of RGB-D images")
    listing = _listing(folder)
    if depth_scale is not None:
        listing = replace(listing, depth_scale=depth_scale)
    return RgbdFolder(folder, listing, *choose_camera(listing.color[0], choice or CameraChoice(), folder))


def choose_camera(image: Path, choice: CameraChoice, folder: Path | None = None) -> tuple[Camera, str]:
    """The camera that took `image`, and where it is from.

    What the user says; else camera.toml in `folder`; else the intrinsics of freiburg1, 2 or 3 where the
    folder is called so; else the nominal PrimeSense. DataError where the camera has another image size.
    """
    width, height = image_size(image)
    if choice.file is not None and choice.intrinsics is not None:
        raise DataError("--camera and --intrinsics: both are given; expected one of them")
    if choice.intrinsics is not None:
        return camera_of(width, height, choice.intrinsics, "--intrinsics"), "as given"
    file = choice.file
    if file is None and folder is not None and (folder / CAMERA_FILE).is_file():
        file = folder / CAMERA_FILE
    if file is not None:
        camera = read_camera(file)
        check_camera(camera, width, height, image, str(file))
        return camera, str(file)
    number = _FREIBURG_NAME.search("" if folder is None else folder_name(folder))
    if number is not None and (width, height) == _FREIBURG_SIZE:
        guessed = f"that of freiburg{number[1]}, guessed from the folder's name"
        return Camera(width, height, *FREIBURG[number[1]]), guessed
    return Camera.from_field_of_view(width, height), "nominal PrimeSense, 62.5 degrees wide"


def _listing(folder: Path) -> _Listing:
    lists = [(folder / name).is_file() for name in ("rgb.txt", "depth.txt")]
    if any(lists):
        if not all(lists):
            raise DataError(f"{folder}: has only one of rgb.txt and depth.txt; expected both (TUM RGB-D)")
        return _tum(folder)
    for name in _COLOR_FOLDERS:
        if (folder / name).is_dir() and (folder / _DEPTH_FOLDER).is_dir():
            return _image_folders(folder, name)
    return _numbered_images(folder)


def _tum(folder: Path) -> _Listing:
    """Images of rgb.txt and depth.txt that are there and at most 20 ms apart."""
    listed = {name: tum.read_list(folder / f"{name}.txt") for name in ("rgb", "depth")}
    there, notes = {}, []
    for name, (times_ns, files) in listed.items():
        exists = np.array([(folder / file).is_file() for file in files], bool)
        if not exists.any():
            found = "lists no image" if not files else f"none of the {len(files)} images it lists is there"
            raise DataError(f"{folder / name}.txt: {found}; expected images beside it")
        if not exists.all():
            notes.append(f"{(~exists).sum()} of {len(files)} images in {name}.txt are missing")
        there[name] = times_ns[exists], [folder / files[row] for row in np.flatnonzero(exists)]
    (rgb_ns, rgb), (depth_ns, depth) = there["rgb"], there["depth"]
    found = tum.associate(rgb_ns, depth_ns)
    if not len(found):
        nearest_s = tum.least_apart_ns(rgb_ns, depth_ns) * 1e-9
        raise DataError(f"{folder}: no colour and depth image are within 20 ms of each other ({len(rgb)} "
                        f"and {len(depth)} images, the nearest {nearest_s:.3f} s apart); are they of one "
                        "recording?")
    if len(found) < len(rgb):
        notes.append(f"{len(rgb) - len(found)} of {len(rgb)} colour images have no depth within 20 ms")
    color = [rgb[row] for row, _ in found]
    return _Listing("tum", color, [depth[row] for _, row in found], [int(rgb_ns[row]) for row, _ in found],
                    [file.stem for file in color], DEFAULT_DEPTH_SCALE, folder / "groundtruth.txt",
                    tuple(notes))


def _image_folders(folder: Path, color_folder: str) -> _Listing:
    """Images in color/ and depth/, paired in the order of their names."""
    color, depth = (_images(folder / name) for name in (color_folder, _DEPTH_FOLDER))
    if len(color) != len(depth) or not color:
        raise DataError(f"{folder}: {len(color)} images in {color_folder} and {len(depth)} in "
                        f"{_DEPTH_FOLDER}; expected one depth image for each colour image")
    stems = [{file.stem for file in files} for files in (color, depth)]
    lonely = sorted(stems[0] - stems[1])
    if lonely and stems[0] & stems[1]:
        raise DataError(f"{folder}: no depth image for {color_folder}/{lonely[0]}, though others have one of "
                        "their name; expected one depth image for each colour image")
    return _untimed(color, depth, _COLOR_FOLDERS[color_folder], folder / "trajectory.log")


def _numbered_images(folder: Path) -> _Listing:
    """Images color0.png, color1.png … and depth0.png, depth1.png … in one folder."""
    by_kind = {kind: _by_number(folder, kind) for kind in ("color", _DEPTH_FOLDER)}
    numbers = [sorted(files) for files in by_kind.values()]
    if numbers[0] != numbers[1] or not numbers[0]:
        raise DataError(f"{folder}: {len(numbers[0])} images named color<number> and {len(numbers[1])} named "
                        "depth<number>; expected rgb.txt and depth.txt (TUM), folders color and depth, or "
                        "color0.png depth0.png color1.png depth1.png …")
    color, depth = ([by_kind[kind][number] for number in numbers[0]] for kind in by_kind)
    return _untimed(color, depth, DEFAULT_DEPTH_SCALE, folder / "trajectory.log")


def _by_number(folder: Path, kind: str) -> dict[int | None, Path]:
    """The images named kind<number>, by their numbers; DataError where two have one number."""
    found: dict[int | None, Path] = {}
    for file in _images(folder):
        if re.fullmatch(rf"{kind}[-_]?\d+", file.stem, re.IGNORECASE):
            other = found.setdefault(frame_number(file), file)
            if other != file:
                raise DataError(f"{folder}: {other.name} and {file.name} have one number; expected one image "
                                f"named {kind}<number> for each")
    return found


def _untimed(color: list[Path], depth: list[Path], depth_scale: float, pose_file: Path) -> _Listing:
    times_ns = [index * _PERIOD_NS for index in range(len(color))]
    return _Listing("images", color, depth, times_ns, [file.stem for file in color], depth_scale, pose_file,
                    ("30 frames a second assumed",))


def _images(folder: Path) -> list[Path]:
    files = clouds.visible_files(folder)
    return clouds.natural_sorted(file for file in files if file.suffix.lower() in _IMAGE_SUFFIXES)


def _poses(listing: _Listing) -> tuple[np.ndarray | None, list[str]]:
    """Poses (N, 4, 4) at the times of a listing where a file holds them, and a note where they do not fit."""
    file, count = listing.pose_file, len(listing.color)
    if not file.is_file():
        return None, []
    if file.suffix != ".log":
        return tum.poses_at(np.array(listing.times_ns), *tum.read_poses(file)), []
    # Open3D's trajectories: a line of three numbers, then a 4x4 matrix, for every frame.
    lines = tables.read_lines(file)
    if len(lines) != 5 * count:
        return None, [f"{file.name} has {len(lines)} lines, not 5 for each of {count} frames, and is ignored"]
    blocks = [" ".join(lines[5 * k + 1: 5 * k + 4]) for k in range(count)]
    return np.stack([tables.motion_of_text(file, block) for block in blocks]), []
