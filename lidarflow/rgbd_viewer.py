"""Recordings of RGB-D results for the rerun viewer.

Entities: world/camera holds the points of the source frame, coloured by their own motion, its colours and the
camera itself; images/… what the pictures show; world/trajectory the way of the camera; residuals what warping
leaves. The world is the first camera's frame: x right, y down, z forward.
"""

from pathlib import Path

import numpy as np

from lidarflow import colour, pose, rgbd_colour, rgbd_io
from lidarflow.rerun_streams import FRAME, all_until_now, open_stream, rr, rrb, set_times
from lidarflow.rgbd_metrics import WarpScores
from lidarflow.rgbd_types import RgbdPair, RgbdResult
from lidarflow.rows import sparse

WORLD, CAMERA, TRAJECTORY = "world", "world/camera", "world/trajectory"
POINTS, ARROWS = f"{CAMERA}/points", f"{CAMERA}/own_motion_x5"
PHOTO = f"{CAMERA}/image"
DEPTH, CLUSTERS, SEGMENTATION, FLOW = "images/depth", "images/clusters", "images/segmentation", "images/flow"
RESIDUALS = "residuals"
FULL_SPEED_M_PER_S = 1.2
MAX_ARROWS = 250

_STAGES = {"before": (150, 150, 150), "odometry": (90, 130, 255), "flow": (255, 130, 30)}
_POINT_PX, _ARROW_PX, _ARROW_SCALE = 1.6, 0.8, 5.0
_IMAGE_PLANE_M = 0.25


def open_recording(path: Path | None, spawn: bool = False) -> rr.RecordingStream:
    """A stream of RGB-D pairs that writes to the file `path`, to a viewer it starts (`spawn`), or to both."""
    stream = open_stream(path, "lidarflow rgbd", spawn, blueprint())
    stream.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
    for stage, rgb in _STAGES.items():
        for series in (rr.SeriesLines(colors=rgb, names=stage, widths=2.0),
                       rr.SeriesPoints(colors=rgb, names=stage, marker_sizes=4.0)):
            stream.log(f"{RESIDUALS}/{stage}", series, static=True)
    return stream


def log_pair(stream: rr.RecordingStream, index: int, pair: RgbdPair, result: RgbdResult, scores: WarpScores,
             world_from_source: np.ndarray) -> None:
    """Log one pair as frame `index`; world_from_source (4, 4) is where the source frame was taken."""
    set_times(stream, index, pair)
    dt_s = (pair.target.time_ns - pair.source.time_ns) * 1e-9
    full_m = FULL_SPEED_M_PER_S * dt_s if dt_s > 0 else None
    color = rgbd_io.color_at(pair.source, result.camera.width, result.camera.height)
    log_result(stream, color, result, world_from_source, full_m)
    for stage, residuals in zip(_STAGES, (scores.before, scores.by_odometry, scores.after), strict=True):
        stream.log(f"{RESIDUALS}/{stage}", rr.Scalars(residuals.geometric_m))


def log_file(stream: rr.RecordingStream, found: rgbd_io.RgbdFlowFile) -> None:
    """Log a flow file as frame 0, with the look of `log_pair`."""
    stream.send_blueprint(blueprint(with_residuals=False))
    stream.set_time(FRAME, sequence=0)
    log_result(stream, found.color, found.result, pose.identity())


def log_result(stream: rr.RecordingStream, color: np.ndarray, result: RgbdResult,
               world_from_source: np.ndarray, full_m: float | None = None) -> None:
    """Log images, points and cameras of one result; motion of `full_m` metres is drawn at full strength.

    color (H, W, 3) uint8 at the result's size; `full_m` fits the longest motion where it is not given.
    """
    own_motion, valid = result.residual_flow(), result.valid
    if full_m is None:
        full_m = rgbd_colour.full_strength_m(own_motion, valid)
    intensity = color.astype(np.float32).mean(axis=2) / 255.0
    moving = rgbd_colour.motion_colours(own_motion, valid, full_m, intensity)
    _log_camera(stream, color, result, world_from_source)
    stream.log(POINTS, rr.Points3D(result.points[valid], colors=moving[valid],
                                   radii=rr.Radius.ui_points(_POINT_PX)))
    shown = sparse(np.flatnonzero(valid & result.is_dynamic), MAX_ARROWS)
    stream.log(ARROWS, rr.Arrows3D(
        origins=result.points.reshape(-1, 3)[shown], vectors=_ARROW_SCALE * own_motion.reshape(-1, 3)[shown],
        colors=[colour.ARROW], radii=rr.Radius.ui_points(_ARROW_PX)))
    total_m = rgbd_colour.full_strength_m(result.flow, valid)
    for entity, image in (
            (CLUSTERS, rgbd_colour.label_colours(result.label)),
            (SEGMENTATION, rgbd_colour.segmentation_colours(result.b_image, intensity)),
            (FLOW, rgbd_colour.motion_colours(result.flow, valid, total_m, intensity))):
        stream.log(entity, rr.Image(image))
    near_m, far_m = rgbd_colour.depth_range(result.points[..., 2])
    stream.log(DEPTH, rr.DepthImage(result.points[..., 2], meter=1.0, depth_range=[near_m, far_m],
                                    colormap=rr.components.Colormap.Turbo))


def blueprint(with_residuals: bool = True) -> rrb.Blueprint:
    """The layout a recording opens with: points large, images beside them, residuals below."""
    background = list(colour.BACKGROUND)
    scene = rrb.Spatial3DView(
        name="Points by their own motion", origin=WORLD, background=background, line_grid=False,
        eye_controls=rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=(-0.9, -0.9, -1.4),
                                       look_target=(0.0, 0.1, 2.0), eye_up=(0.0, -1.0, 0.0)),
        overrides={TRAJECTORY: all_until_now()})
    images = [rrb.Spatial2DView(name=name, origin=origin, background=background) for name, origin in (
        ("Colour", PHOTO), ("Depth", DEPTH), ("Clusters", CLUSTERS),
        ("Static (blue) or moving (red)", SEGMENTATION), ("Total flow", FLOW))]
    curve = rrb.TimeSeriesView(name="Geometric residual [m]", origin=RESIDUALS)
    side = rrb.Grid(*images, *([curve] if with_residuals else []), grid_columns=2)
    return rrb.Blueprint(
        rrb.Horizontal(scene, side, column_shares=[1, 1]),
        rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=FRAME, fps=10.0))


def _log_camera(stream: rr.RecordingStream, color: np.ndarray, result: RgbdResult,
                world_from_source: np.ndarray) -> None:
    """Where the source camera is, what it sees, and the stretch of its way to the next."""
    camera = result.camera
    stream.log(CAMERA, rr.Transform3D(translation=world_from_source[:3, 3], mat3x3=world_from_source[:3, :3]))
    stream.log(PHOTO, rr.Pinhole(
        resolution=[camera.width, camera.height], focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx, camera.cy], camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=_IMAGE_PLANE_M))
    stream.log(PHOTO, rr.Image(color))
    world_from_target = world_from_source @ pose.inverse(result.odometry)
    stretch = np.stack([world_from_source[:3, 3], world_from_target[:3, 3]])
    stream.log(TRAJECTORY, rr.LineStrips3D([stretch], colors=[colour.ARROW], radii=rr.Radius.ui_points(2.0)))
