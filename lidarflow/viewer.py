"""Recordings of scans and their flow for the rerun viewer.

Entities: world/source holds the scan coloured by its motion over ground, world/target the next scan with the
moved scan laid over it, world/trajectory the way of the sensor, crispness the alignment before and after.
"""

from pathlib import Path

import numpy as np

from lidarflow import colour, pose
from lidarflow.rerun_streams import FRAME, all_until_now, open_stream, rr, rrb, set_times
from lidarflow.rows import sparse
from lidarflow.types import FlowResult, ScanPair

SOURCE, TARGET, TRAJECTORY = "world/source", "world/target", "world/trajectory"
STATIC, MOVING = f"{SOURCE}/static", f"{SOURCE}/moving"
OBJECTS, OBJECT_ARROWS = f"{SOURCE}/objects", f"{SOURCE}/objects_in_1s"
RESIDUAL_ARROWS = f"{SOURCE}/residual_flow"
TOTAL_ARROWS, MATCHES = f"{SOURCE}/total_flow", f"{SOURCE}/matches"
SENSOR = f"{SOURCE}/sensor"
NEXT, MOVED = f"{TARGET}/next_scan", f"{TARGET}/moved_scan"
CRISPNESS, WHEEL = "crispness", "wheel"

MAX_RESIDUAL_ARROWS = 3000
MAX_TOTAL_ARROWS = 20000
_STATIC_PX, _MOVING_PX, _OVERLAY_PX = 1.2, 2.6, 1.0
_BOX_PX, _OBJECT_ARROW_PX = 1.0, 2.0
_ARROW_ABOVE_M = 0.4
_WHEEL_PX = 420
_SENSOR_OUTLINE = np.array([(1.2, 0, 0), (-0.8, 0.8, 0), (-0.4, 0, 0), (-0.8, -0.8, 0), (1.2, 0, 0)])


def open_recording(path: Path | None, spawn: bool = False) -> rr.RecordingStream:
    """A stream of scans that writes to the file `path`, to a viewer it starts (`spawn`), or to both."""
    stream = open_stream(path, "lidarflow", spawn, blueprint())
    _log_static(stream)
    return stream


def log_pair(stream: rr.RecordingStream, index: int, pair: ScanPair, result: FlowResult,
             crispness: tuple[float, float] | None, world_from_source: np.ndarray,
             arrows: bool = False) -> None:
    """Log one pair as frame `index`; `arrows` adds the total flow of all points.

    crispness          (before, after) the flow moved the source scan, or None
    world_from_source  (4, 4) where the source scan was taken
    """
    set_times(stream, index, pair)
    points = pair.source.points
    _log_frames(stream, world_from_source, result.ego_motion)
    _log_motion(stream, points, result.flow, result.is_dynamic, result.ego_motion, pair.dt_s)
    _log_boxes(stream, result)
    if result.objects:
        _log_arrows_of_objects(stream, result)
    else:
        _log_arrows_of_groups(stream, points, result.flow, result.is_dynamic, result.ego_motion, pair.dt_s)
    _log_alignment(stream, points, result.flow, pair.target.points)
    _log_matches(stream, result)
    if arrows:
        _log_total_arrows(stream, points, result.flow)
    if crispness is not None:
        stream.log(f"{CRISPNESS}/before", rr.Scalars(float(crispness[0])))
        stream.log(f"{CRISPNESS}/after", rr.Scalars(float(crispness[1])))


def log_flow(stream: rr.RecordingStream, points: np.ndarray, flow: np.ndarray, is_dynamic: np.ndarray,
             ego_motion: np.ndarray, dt_s: float, target_points: np.ndarray | None = None) -> None:
    """Log one stored result as frame 0, with the look of `log_pair`.

    points, flow (N, 3) metres, total flow; is_dynamic (N,) bool; ego_motion (4, 4) target_from_source.
    """
    stream.send_blueprint(blueprint(with_alignment=target_points is not None, with_crispness=False))
    stream.set_time(FRAME, sequence=0)
    _log_frames(stream, pose.identity(), ego_motion)
    _log_motion(stream, points, flow, is_dynamic, ego_motion, dt_s)
    _log_arrows_of_groups(stream, points, flow, is_dynamic, ego_motion, dt_s)
    _log_alignment(stream, points, flow, target_points)


def blueprint(with_alignment: bool = True, with_crispness: bool = True) -> rrb.Blueprint:
    """The layout a recording opens with: motion large, the two scans aligned, the colour wheel, crispness."""
    motion = rrb.Spatial3DView(
        name="Motion over ground", origin=SOURCE, contents=[f"{SOURCE}/**", f"{TRAJECTORY}/**"],
        background=list(colour.BACKGROUND), line_grid=False,
        eye_controls=_eye((-19.0, 0.0, 15.0), (9.0, 0.0, -2.0)),
        overrides={MATCHES: rrb.EntityBehavior(visible=False), TRAJECTORY: all_until_now()})
    alignment = rrb.Spatial3DView(
        name="Alignment: moved scan (orange) over the next (blue)", origin=TARGET,
        background=list(colour.BACKGROUND), line_grid=False,
        eye_controls=_eye((-3.0, 0.0, 9.0), (12.0, 1.0, -1.5)))
    wheel = rrb.Spatial2DView(name="Direction and speed", origin=WHEEL, background=list(colour.BACKGROUND))
    crispness = rrb.TimeSeriesView(name="Crispness", origin=CRISPNESS)
    legend = rrb.Horizontal(wheel, crispness) if with_crispness else wheel
    side = rrb.Vertical(alignment, legend, row_shares=[3, 2]) if with_alignment else legend
    return rrb.Blueprint(
        rrb.Horizontal(motion, side, column_shares=[5, 3 if with_alignment else 1]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=FRAME, fps=10.0))


def _eye(position: tuple, target: tuple) -> rrb.EyeControls3D:
    return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=position, look_target=target,
                             eye_up=(0.0, 0.0, 1.0))


def _log_static(stream: rr.RecordingStream) -> None:
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log(WHEEL, rr.Image(colour.wheel(_WHEEL_PX)), static=True)
    outline = rr.LineStrips3D([_SENSOR_OUTLINE], colors=[colour.ARROW], radii=rr.Radius.ui_points(1.5))
    stream.log(SENSOR, outline, static=True)
    for name, rgb in (("before", (150, 150, 150)), ("after", colour.MOVED_SCAN)):
        for series in (rr.SeriesLines(colors=rgb, names=name, widths=2.0),
                       rr.SeriesPoints(colors=rgb, names=name, marker_sizes=4.0)):
            stream.log(f"{CRISPNESS}/{name}", series, static=True)


def _log_frames(stream: rr.RecordingStream, world_from_source: np.ndarray, ego_motion: np.ndarray) -> None:
    """Where the two sensor frames are, and the stretch of the trajectory between them."""
    world_from_target = world_from_source @ pose.inverse(ego_motion)
    for entity, world_from_sensor in ((SOURCE, world_from_source), (TARGET, world_from_target)):
        stream.log(entity, rr.Transform3D(translation=world_from_sensor[:3, 3],
                                          mat3x3=world_from_sensor[:3, :3]))
    stretch = np.stack([world_from_source[:3, 3], world_from_target[:3, 3]])
    stream.log(TRAJECTORY, rr.LineStrips3D([stretch], colors=[colour.ARROW], radii=rr.Radius.ui_points(2.0)))


def _log_motion(stream: rr.RecordingStream, points: np.ndarray, flow: np.ndarray, is_dynamic: np.ndarray,
                ego_motion: np.ndarray, dt_s: float) -> None:
    """The source scan by its motion over ground, seen in the source frame."""
    residual_flow = pose.apply(pose.inverse(ego_motion), points + flow) - points
    finite = np.isfinite(points).all(axis=1)
    moving = is_dynamic & np.isfinite(residual_flow).all(axis=1)
    static = finite & ~moving
    colours = colour.motion_colours(residual_flow, moving, dt_s)
    _log_points(stream, STATIC, points[static], colour.static_shade(points[static]), _STATIC_PX)
    _log_points(stream, MOVING, points[moving], colours[moving], _MOVING_PX)
    shown = sparse(np.flatnonzero(moving), MAX_RESIDUAL_ARROWS)
    _log_arrows(stream, RESIDUAL_ARROWS, points[shown], residual_flow[shown], colours[shown], 0.7)


def _log_boxes(stream: rr.RecordingStream, result: FlowResult) -> None:
    """A box, number and speed over ground for every moving object; no objects clear the frame before."""
    found = result.objects
    stream.log(OBJECTS, rr.Boxes3D(
        centers=np.array([o.box_centre for o in found]).reshape(-1, 3),
        half_sizes=np.array([o.box_size for o in found]).reshape(-1, 3) / 2.0,
        quaternions=pose.yaw_quaternion([o.box_yaw for o in found]), colors=[colour.ARROW],
        radii=rr.Radius.ui_points(_BOX_PX), fill_mode="majorwireframe", show_labels=True,
        labels=[f"id {o.id}: {np.linalg.norm(o.velocity):.1f} m/s" for o in found]))


def _log_arrows_of_objects(stream: rr.RecordingStream, result: FlowResult) -> None:
    """The way of every moving object in one second, from the top of its box, whose label says the speed."""
    tops = np.stack([o.box_centre + (0.0, 0.0, o.box_size[2] / 2.0) for o in result.objects])
    velocity = np.stack([o.velocity for o in result.objects])
    _log_arrows(stream, OBJECT_ARROWS, tops, pose.turn(pose.inverse(result.ego_motion), velocity),
                [colour.ARROW], _OBJECT_ARROW_PX)


def _log_arrows_of_groups(stream: rr.RecordingStream, points: np.ndarray, flow: np.ndarray,
                          is_dynamic: np.ndarray, ego_motion: np.ndarray, dt_s: float) -> None:
    """The way of every group of moving points in one second, and its speed."""
    residual_flow = pose.apply(pose.inverse(ego_motion), points + flow) - points
    tops, moved = colour.moving_objects(points, residual_flow, is_dynamic)
    speed_m_per_s = np.linalg.norm(moved, axis=1) / dt_s
    stream.log(OBJECT_ARROWS, rr.Arrows3D(
        origins=tops + (0.0, 0.0, _ARROW_ABOVE_M), vectors=moved / dt_s, colors=[colour.ARROW],
        radii=rr.Radius.ui_points(_OBJECT_ARROW_PX), labels=[f"{speed:.1f} m/s" for speed in speed_m_per_s]))


def _log_alignment(stream: rr.RecordingStream, points: np.ndarray, flow: np.ndarray,
                   target_points: np.ndarray | None) -> None:
    """The source scan moved by its total flow, over the next scan where there is one."""
    if target_points is not None:
        _log_points(stream, NEXT, target_points[np.isfinite(target_points).all(axis=1)], [colour.NEXT_SCAN],
                    _OVERLAY_PX)
    moved = points + flow
    _log_points(stream, MOVED, moved[np.isfinite(moved).all(axis=1)], [colour.MOVED_SCAN], _OVERLAY_PX)


def _log_matches(stream: rr.RecordingStream, result: FlowResult) -> None:
    """Matches as lines from the source point to its match, the ego-motion taken out."""
    matched = pose.apply(pose.inverse(result.ego_motion), result.match_target)
    lines = np.stack([result.match_source, matched], axis=1).astype(np.float32)
    stream.log(MATCHES, rr.LineStrips3D(lines, colors=[(180, 180, 90)], radii=rr.Radius.ui_points(0.5)))


def _log_total_arrows(stream: rr.RecordingStream, points: np.ndarray, flow: np.ndarray) -> None:
    shown = sparse(np.flatnonzero(np.isfinite(points + flow).all(axis=1)), MAX_TOTAL_ARROWS)
    _log_arrows(stream, TOTAL_ARROWS, points[shown], flow[shown], [(110, 110, 130)], 0.4)


def _log_points(stream: rr.RecordingStream, entity: str, points: np.ndarray, colours, size_px: float) -> None:
    stream.log(entity, rr.Points3D(points.astype(np.float32), colors=colours,
                                   radii=rr.Radius.ui_points(size_px)))


def _log_arrows(stream: rr.RecordingStream, entity: str, origins: np.ndarray, vectors: np.ndarray, colours,
                size_px: float) -> None:
    stream.log(entity, rr.Arrows3D(origins=origins.astype(np.float32), vectors=vectors.astype(np.float32),
                                   colors=colours, radii=rr.Radius.ui_points(size_px)))
