"""Scores of RGB-D flow and odometry: what is left after warping, against the truth, and against poses."""

from dataclasses import dataclass, replace

import numpy as np

from lidarflow import pose
from lidarflow.rgbd import pyramid
from lidarflow.rgbd_config import ImagesConfig
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdPair, RgbdResult, RgbdTruth

OCCLUDED_M = 0.2
PER_S = 1.0


@dataclass(frozen=True, slots=True)
class Residuals:
    """What a warp leaves, as root mean squares over the same pixels; NaN without pixels.

    pixels       int     how many count
    photometric  float   intensity, 0..1
    geometric_m  float   depth, metres
    occluded     float   share of the pixels seen in both images that something nearer hides; left out
    """

    pixels: int
    photometric: float
    geometric_m: float
    occluded: float


def residuals(source: RgbdFrame, target: RgbdFrame, camera: Camera, flow: np.ndarray) -> Residuals:
    """RMS residuals after warping as in Jaimez et al. 2017, Table III; images of the camera's size.

    Every source pixel with depth has its point p, moved to p + flow (H, W, 3), metres, and projected into
    the target. There intensity and depth are interpolated bilinearly between four pixels, all of which must
    have depth: r_I = I2 − I1, r_Z = Z2 − (p + flow)_z. Pixels with r_Z < −0.2 m are hidden by something
    nearer and left out of both; all others count alike, however large their residuals.
    """
    moved = camera.points(source.depth).astype(float) + flow
    depth, intensity, seen = sampled(target, camera, moved)
    seen &= source.depth > 0
    r_z = (depth - moved[..., 2])[seen]
    r_i = (intensity - source.intensity)[seen]
    kept = r_z >= -OCCLUDED_M
    occluded = 1.0 - kept.mean() if len(kept) else float("nan")
    return Residuals(int(kept.sum()), _rms(r_i[kept]), _rms(r_z[kept]), float(occluded))


def sampled(
    target: RgbdFrame, camera: Camera, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth and intensity (H, W) of the target where it sees points (H, W, 3), and where that is (bool).

    Bilinear; points behind the camera, outside the image, or next to a pixel without depth are not seen.
    """
    ahead = points[..., 2] > 0
    z = np.where(ahead, points[..., 2], 1.0)
    u = camera.fx * points[..., 0] / z + camera.cx
    v = camera.fy * points[..., 1] / z + camera.cy
    inside = ahead & (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    left = np.minimum(u.astype(int), camera.width - 2)
    top = np.minimum(v.astype(int), camera.height - 2)
    right_share, bottom_share = u - left, v - top
    depth, intensity = np.zeros(z.shape), np.zeros(z.shape)
    for row, column, share in ((top, left, (1 - bottom_share) * (1 - right_share)),
                               (top, left + 1, (1 - bottom_share) * right_share),
                               (top + 1, left, bottom_share * (1 - right_share)),
                               (top + 1, left + 1, bottom_share * right_share)):
        inside &= target.depth[row, column] > 0
        depth += share * target.depth[row, column]
        intensity += share * target.intensity[row, column]
    return depth, intensity, inside


@dataclass(frozen=True, slots=True)
class WarpScores:
    """Residuals of a pair before any motion, after the odometry, and after every pixel's own flow."""

    before: Residuals
    by_odometry: Residuals
    after: Residuals


def warp_scores(pair: RgbdPair, result: RgbdResult) -> WarpScores:
    """Residuals at the working size of `result`, of intensities as it compared them: in one exposure."""
    images = replace(ImagesConfig(), width=result.camera.width)
    source, target = (pyramid.at_working_size(frame, pair.camera, images)[0]
                      for frame in (pair.source, pair.target))
    shown = result.exposure.undone(source.intensity, target.intensity)
    source, target = (replace(frame, intensity=intensity)
                      for frame, intensity in zip((source, target), shown, strict=True))
    odometry_flow = result.odometry_flow()
    return WarpScores(*(residuals(source, target, result.camera, flow)
                        for flow in (np.zeros_like(odometry_flow), odometry_flow, result.flow)))


@dataclass(frozen=True, slots=True)
class RgbdScores:
    """One pair against its truth, over pixels with depth whose truth is known; NaN where there are none.

    epe_m, epe_static_m, epe_moving_m   mean end-point error of the total flow
    odometry_error_m, _deg              of the camera motion
    wrong                               share of pixels whose segmentation is wrong (Table I)
    missed, false                       share of the moving pixels held static, and the other way round
    iou                                 intersection over union of the moving pixels
    """

    epe_m: float
    epe_static_m: float
    epe_moving_m: float
    odometry_error_m: float
    odometry_error_deg: float
    wrong: float
    missed: float
    false: float
    iou: float


def score(result: RgbdResult, truth: RgbdTruth) -> RgbdScores:
    """Errors of `result`; a truth of larger images is taken at the pixels in the middle of the result's."""
    height, width = result.valid.shape
    rows = ((np.arange(height) + 0.5) * truth.valid.shape[0] / height).astype(int)[:, None]
    columns = ((np.arange(width) + 0.5) * truth.valid.shape[1] / width).astype(int)
    known = result.valid & truth.valid[rows, columns]
    moving, found = truth.is_dynamic[rows, columns][known], result.is_dynamic[known]
    error_m = np.linalg.norm(result.flow[known] - truth.flow[rows, columns][known], axis=1)
    return RgbdScores(
        epe_m=_mean(error_m),
        epe_static_m=_mean(error_m[~moving]),
        epe_moving_m=_mean(error_m[moving]),
        odometry_error_m=float(pose.translation_distance(truth.odometry, result.odometry)),
        odometry_error_deg=float(np.degrees(pose.rotation_distance(truth.odometry, result.odometry))),
        wrong=_mean(found != moving),
        missed=_mean(~found[moving]),
        false=_mean(found[~moving]),
        iou=_ratio((found & moving).sum(), (found | moving).sum()),
    )


@dataclass(frozen=True, slots=True)
class Drift:
    """Relative pose error, root mean square over pairs of frames; NaN where there are none.

    frames                       how many steps from frame to frame count
    per_frame_m, _deg            from each frame to the next
    per_second_m, _deg           over one second, in metres and degrees per second (Table II)
    """

    frames: int
    per_frame_m: float
    per_frame_deg: float
    per_second_m: float
    per_second_deg: float


def drift(estimated: np.ndarray, true: np.ndarray, times_ns: np.ndarray, stretch: np.ndarray | None = None
          ) -> Drift:
    """Relative pose error of poses (N, 4, 4), world_from_camera, against true ones; NaN poses do not count.

    Poses of different stretches (N,), if given, are not compared: what lies between them was left out.

    E_ij = (Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j) with P estimated and Q true (Sturm et al. 2012); j is the next frame, or
    the one a second later, by at most half the usual step between frames.
    """
    times_s = np.asarray(times_ns) * 1e-9
    stretch = np.zeros(len(times_s)) if stretch is None else stretch
    first = np.flatnonzero(stretch[:-1] == stretch[1:])
    a_frame = _pose_errors(estimated, true, first, first + 1)
    later = np.abs(times_s[:, None] - (times_s + PER_S)).argmin(axis=0) if len(times_s) else first
    half_step_s = 0.5 * np.median(np.diff(times_s)) if len(times_s) > 1 else 0.0
    hit = np.abs(times_s[later] - times_s - PER_S) <= half_step_s if len(times_s) else np.empty(0, bool)
    hit &= stretch[later] == stretch if len(times_s) else hit
    a_second = _pose_errors(estimated, true, np.flatnonzero(hit), later[hit])
    return Drift(len(a_frame[0]), *(_rms(errors) for errors in (*a_frame, *a_second)))


def _pose_errors(estimated: np.ndarray, true: np.ndarray, i: np.ndarray, j: np.ndarray) -> tuple:
    """Translation [m] and rotation [deg] of E_ij for pairs of known poses."""
    known = np.isfinite(true[i]).all(axis=(1, 2)) & np.isfinite(true[j]).all(axis=(1, 2))
    i, j = i[known], j[known]
    if not len(i):
        return np.empty(0), np.empty(0)
    done, should = pose.inverse(estimated[i]) @ estimated[j], pose.inverse(true[i]) @ true[j]
    return pose.translation_distance(should, done), np.degrees(pose.rotation_distance(should, done))


@dataclass(frozen=True, slots=True)
class DepthStatistics:
    """How much of an image has depth, and how far away it is: share of pixels, mean and median in metres."""

    valid: float
    mean_m: float
    median_m: float


def depth_statistics(depth: np.ndarray) -> DepthStatistics:
    """Statistics of a depth image (H, W) in metres, 0 = none."""
    known = depth[depth > 0]
    if not len(known):
        return DepthStatistics(0.0, float("nan"), float("nan"))
    return DepthStatistics(float((depth > 0).mean()), float(known.mean(dtype=float)), float(np.median(known)))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=float)))) if len(values) else float("nan")


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _ratio(part: int, whole: int) -> float:
    return float(part / whole) if whole else float("nan")
