"""The data of the RGB-D side: frozen, and checked at the door.

Images are arrays (H, W), row v down, column u to the right, and a pixel's centre has integer coordinates.
A camera looks along z, x to the right, y down. Lengths are metres, times integer nanoseconds.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lidarflow import pose
from lidarflow.checks import as_time_ns, check, check_given, check_motion, is_whole
from lidarflow.errors import InputError

_INTENSITY = "floats from 0 = black to 1 = white, such as grey / 255"
_DEPTH = "metres along z as floats, such as pixels / 5000, and 0 where there is no reading"
_COLOR = "RGB (H, W, 3) as uint8"
_MADE_BY = {"Camera": "Camera(width, height, fx, fy, cx, cy)",
            "RgbdFrame": "RgbdFrame.from_color(color, depth)",
            "RgbdPair": "RgbdPair(source, target, camera)"}
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)     # ITU-R BT.601


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole: u = fx x/z + cx, v = fy y/z + cy.

    width, height   int     pixels
    fx, fy          float   focal lengths in pixels
    cx, cy          float   principal point in pixels; the upper left pixel's centre is (0, 0)
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self):
        for name in ("width", "height"):
            pixels = getattr(self, name)
            if not is_whole(pixels) or pixels < 1:
                raise InputError(f"Camera: {name} is {pixels!r}; expected a positive whole number")
            object.__setattr__(self, name, int(pixels))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, _finite(f"Camera: {name}", getattr(self, name)))
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(f"Camera: expected positive focal lengths, got {self.fx}, {self.fy}")

    @classmethod
    def from_field_of_view(cls, width: int, height: int, horizontal_deg: float = 62.5) -> "Camera":
        """A camera with square pixels and its centre at ((W−1)/2, (H−1)/2); 62.5° is a PrimeSense's."""
        if not 0 < _finite("Camera: horizontal_deg", horizontal_deg) < 180:
            raise InputError(f"Camera: {horizontal_deg} degrees wide; expected more than 0 and less than 180")
        focal = width / (2.0 * math.tan(math.radians(horizontal_deg) / 2.0))
        return cls(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)

    def scaled(self, width: int, height: int) -> "Camera":
        """The same camera with images of another size: pixel edges stay, so u' + ½ = (u + ½) W'/W."""
        x, y = width / self.width, height / self.height
        return Camera(width, height, self.fx * x, self.fy * y,
                      (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5)

    def points(self, depth: np.ndarray) -> np.ndarray:
        """Points (H, W, 3) float32 in metres of a depth image (H, W) of this size; depth 0 gives 0, 0, 0."""
        check("depth", depth, (self.height, self.width), "f")
        rays = np.empty((self.height, self.width, 3), np.float32)
        rays[..., 0] = (np.arange(self.width) - self.cx) / self.fx
        rays[..., 1] = ((np.arange(self.height) - self.cy) / self.fy)[:, None]
        rays[..., 2] = 1.0
        return rays * depth[..., None].astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class RgbdFrame:
    """One registered image of intensity and depth.

    intensity  (H, W) float32           0 = black, 1 = white
    depth      (H, W) float32           metres along z, 0 = no reading, as what is masked becomes
    time_ns    int
    name       str                      what messages and files call it
    color      (H, W, 3) uint8 or None  RGB, for pictures only
    """

    intensity: np.ndarray
    depth: np.ndarray
    time_ns: int = 0
    name: str = "frame"
    color: np.ndarray | None = None

    def __post_init__(self):
        object.__setattr__(self, "time_ns", as_time_ns(self.name, self.time_ns))
        intensity = _image(f"{self.name}: intensity", self.intensity, (None, None), _INTENSITY)
        if intensity.max(initial=0) > 1:
            raise InputError(f"{self.name}: intensity: up to {intensity.max():g}; pass {_INTENSITY}")
        is_masked = isinstance(self.depth, np.ma.MaskedArray)
        depth = self.depth.filled(0) if is_masked else self.depth
        object.__setattr__(self, "intensity", intensity)
        object.__setattr__(self, "depth", _image(f"{self.name}: depth", depth, intensity.shape, _DEPTH))
        if self.color is not None:
            _check_color(f"{self.name}: color", self.color, intensity.shape)

    @classmethod
    def from_color(cls, color: np.ndarray, depth: np.ndarray, time_ns: int = 0,
                   name: str = "frame") -> "RgbdFrame":
        """A frame of an RGB image (H, W, 3) uint8, whose luma is its intensity, and depth (H, W) [m]."""
        _check_color(f"{name}: color", color, (None, None))
        intensity = np.clip(color.astype(np.float32) / 255.0 @ _LUMA, 0.0, 1.0)
        return cls(intensity, depth, time_ns, name, color)

    @property
    def shape(self) -> tuple[int, int]:
        return self.intensity.shape


@dataclass(frozen=True, slots=True, eq=False)
class RgbdPair:
    """Two consecutive frames of one camera, whose size is theirs; the flow carries `source` onto `target`."""

    source: RgbdFrame
    target: RgbdFrame
    camera: Camera

    def __post_init__(self):
        check_is("camera", self.camera, Camera)
        for name in ("source", "target"):
            frame = getattr(self, name)
            check_is(name, frame, RgbdFrame)
            height, width = frame.shape
            if (height, width) != (self.camera.height, self.camera.width):
                raise InputError(
                    f"{frame.name}: expected {self.camera.width}x{self.camera.height} pixels as the camera "
                    f"has, got {width}x{height}")


@dataclass(frozen=True, slots=True)
class Exposure:
    """How the exposure changed within a pair: target = gain · source + offset; 1 and 0 where it did not."""

    gain: float = 1.0
    offset: float = 0.0

    def undone(self, source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Intensities (H, W) float32 of both images in the source's exposure, themselves where none changed.

        Both are cut off at what either exposure can show.
        """
        if self == Exposure():
            return source, target
        low, high = max(0.0, -self.offset / self.gain), min(1.0, (1.0 - self.offset) / self.gain)
        as_source = source, (target - self.offset) / self.gain
        return tuple(np.clip(intensity, low, high).astype(np.float32) for intensity in as_source)


@dataclass(frozen=True, slots=True, eq=False)
class RgbdResult:
    """The answer for one pair, images (H, W) of the working size, rows and columns as in the source frame.

    flow             (H, W, 3) float32   metres, total: p + flow is what the target's camera sees of p, in its
                                         frame; camera motion included, 0 where not valid
    points           (H, W, 3) float32   metres, source camera frame
    valid            (H, W) bool         the source has depth there
    label            (H, W) int32        geometric cluster of each pixel, −1 = none
    b                (K,) float64        0 = the cluster is static, 1 = it moves by itself, 2 = without doubt
    cluster_motions  (K, 4, 4) float64   target_from_source of what is not static in each cluster
    odometry         (4, 4) float64      target_from_source of the static world
    is_dynamic       (H, W) bool         pixels of clusters that move
    camera           Camera              of the working size
    centres          (K, 3) float32      metres, the clusters' centres, source camera frame
    seconds          dict                wall time of each stage
    exposure         Exposure            the change that was undone before the images were compared
    """

    flow: np.ndarray
    points: np.ndarray
    valid: np.ndarray
    label: np.ndarray
    b: np.ndarray
    cluster_motions: np.ndarray
    odometry: np.ndarray
    is_dynamic: np.ndarray
    camera: Camera
    centres: np.ndarray
    seconds: dict[str, float] = field(default_factory=dict)
    exposure: Exposure = Exposure()

    def __post_init__(self):
        check("RgbdResult.valid", self.valid, (self.camera.height, self.camera.width), "b")
        shape = self.valid.shape
        check("RgbdResult.flow", self.flow, (*shape, 3), "f")
        check("RgbdResult.points", self.points, (*shape, 3), "f")
        check("RgbdResult.label", self.label, shape, "i")
        check("RgbdResult.is_dynamic", self.is_dynamic, shape, "b")
        check("RgbdResult.b", self.b, (None,), "f")
        check("RgbdResult.cluster_motions", self.cluster_motions, (len(self.b), 4, 4), "f")
        check("RgbdResult.centres", self.centres, (len(self.b), 3), "f")
        check_motion("RgbdResult.odometry", self.odometry)
        if self.label.size and not -1 <= self.label.min() <= self.label.max() < max(len(self.b), 1):
            raise ValueError(f"RgbdResult.label: expected -1 .. {len(self.b) - 1}")

    @property
    def b_image(self) -> np.ndarray:
        """b of every pixel's cluster (H, W) float32; NaN where there is none."""
        values = np.append(self.b, np.nan).astype(np.float32)
        return values[self.label]

    def odometry_flow(self) -> np.ndarray:
        """Flow (H, W, 3) float32 in metres that camera motion alone gives the points; 0 where not valid."""
        moved = pose.apply(self.odometry, self.points.astype(np.float64)) - self.points
        return np.where(self.valid[..., None], moved, 0.0).astype(np.float32)

    def residual_flow(self) -> np.ndarray:
        """What points do by themselves (H, W, 3) float32 in metres, in the axes of the target camera."""
        return self.flow - self.odometry_flow()


@dataclass(frozen=True, slots=True, eq=False)
class RgbdTruth:
    """What really happened between a frame and the next, images (H, W) of the source frame's size.

    flow        (H, W, 3) float32   metres, total: p + flow is what the target's camera sees of p
    odometry    (4, 4) float64      target_from_source of the static world
    valid       (H, W) bool         pixels that are known and count in scores
    is_dynamic  (H, W) bool         what is seen there moves by itself
    """

    flow: np.ndarray
    odometry: np.ndarray
    valid: np.ndarray
    is_dynamic: np.ndarray

    def __post_init__(self):
        check("RgbdTruth.valid", self.valid, (None, None), "b")
        check("RgbdTruth.flow", self.flow, (*self.valid.shape, 3), "f")
        check("RgbdTruth.is_dynamic", self.is_dynamic, self.valid.shape, "b")
        check_motion("RgbdTruth.odometry", self.odometry)


def check_is(name: str, value: Any, kind: type) -> None:
    """Raise InputError unless a value is a Camera, an RgbdFrame or an RgbdPair, whichever is the `kind`."""
    if not isinstance(value, kind):
        raise InputError(f"{name}: of type {type(value).__name__}; expected {_MADE_BY[kind.__name__]}")


def _finite(name: str, number: Any) -> float:
    is_number = is_whole(number) or isinstance(number, float | np.floating)
    if not is_number or not math.isfinite(number):
        raise InputError(f"{name} is {number!r}; expected a finite number")
    return float(number)


def _image(name: str, values: Any, shape: tuple, expected: str) -> np.ndarray:
    """An image (H, W) float32, finite and not negative, of what is handed over; else InputError."""
    check_given(name, values, shape, "f", expected)
    with np.errstate(over="ignore", invalid="ignore"):
        image = np.ascontiguousarray(values, np.float32)
    if not np.isfinite(image).all() or (image < 0).any():
        raise InputError(f"{name}: must be finite and not negative; pass {expected}")
    return image


def _check_color(name: str, color: Any, shape: tuple) -> None:
    check_given(name, color, (*shape, 3), "u", _COLOR)
    if color.dtype != np.uint8:
        raise InputError(f"{name}: of {color.dtype}; pass {_COLOR}")
