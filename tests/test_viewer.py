import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import rerun as rr

from lidarflow import pose, rerun_streams, viewer
from lidarflow.types import FlowResult, MovingObject, Scan, ScanPair, SolveStats


def drive(count=2, points_n=400):
    """Pairs of a sensor that moves 0.5 m forward per scan past noise; twenty points move to the left."""
    rng = np.random.default_rng(8)
    ego_motion = pose.from_translation((-0.5, 0, 0))
    stats = SolveStats("none", 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, {})
    for k in range(count):
        points = rng.uniform(-20, 20, (points_n, 3))
        points[:20] = rng.uniform(-0.5, 0.5, (20, 3)) + (8, 0, 0)
        points[-1] = np.nan
        is_dynamic = np.arange(points_n) < 20
        flow = pose.apply(ego_motion, points) - points
        flow[:20] += (0, 0.6, 0)
        valid = np.isfinite(points).all(axis=1)
        source = Scan(points, (k + 1) * 100_000_000, f"{k:06d}")
        pair = ScanPair(source, Scan(points + flow, (k + 2) * 100_000_000, f"{k + 1:06d}"))
        matched = points[:50]
        yield pair, FlowResult(flow, pose.identity(points_n), valid, valid, is_dynamic, ego_motion, stats, {},
                               matched, matched + flow[:50])


@pytest.fixture(autouse=True)
def mistakes_in_logging_raise():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def record(path, **options):
    stream = viewer.open_recording(path)
    world_from_source = pose.identity()
    for k, (pair, result) in enumerate(drive()):
        viewer.log_pair(stream, k, pair, result, (0.5, 0.7 + 0.1 * k), world_from_source, **options)
        world_from_source = world_from_source @ pose.inverse(result.ego_motion)
    rerun_streams.close(stream)


def with_object(pair, result):
    """The result with its twenty moving points as an object that a turned sensor sees go."""
    ego_motion = pose.from_yaw(np.pi / 2, (-0.5, 0, 0))
    turned = replace(result, ego_motion=ego_motion)
    size, centre = np.array([4.0, 2.0, 1.5]), np.array([8.0, 0.0, 0.0])
    velocity = np.array([-6.0, 0.0, 0.0])       # +y in the source's axes
    motion = pose.from_translation(velocity * pair.dt_s) @ ego_motion
    found = MovingObject(3, motion, velocity, centre, size, np.pi / 2, 20)
    object_id = np.where(result.is_dynamic, 3, -1).astype(np.int32)
    return replace(turned, objects=(found,), object_id=object_id)


class Logged:
    """A stream that keeps what is logged, entity by entity."""

    def __init__(self):
        self.by_entity = {}

    def log(self, entity, what, **_):
        self.by_entity[entity] = what


def printed(path, *options) -> str:
    command = [sys.executable, "-m", "rerun", "rrd", *options, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_a_recording_is_valid_and_holds_every_entity_and_its_blueprint(tmp_path):
    path = tmp_path / "recording.rrd"
    record(path)
    printed(path, "verify")
    text = printed(path, "print", "-v")
    for entity in (viewer.STATIC, viewer.MOVING, viewer.RESIDUAL_ARROWS, viewer.OBJECT_ARROWS, viewer.MATCHES,
                   viewer.NEXT, viewer.MOVED, viewer.TRAJECTORY, viewer.WHEEL, "crispness/before",
                   "crispness/after"):
        assert f" /{entity} " in text, entity
    assert f" /{viewer.TOTAL_ARROWS} " not in text
    assert "ViewBlueprint" in text and "EyeControls3D" in text
    assert "Transform3D" in text


def test_moving_objects_are_boxes_and_arrows(tmp_path):
    pair, result = next(drive())
    stream = viewer.open_recording(tmp_path / "objects.rrd")
    viewer.log_pair(stream, 0, pair, with_object(pair, result), None, pose.identity())
    viewer.log_pair(stream, 1, pair, result, None, pose.identity())
    rerun_streams.close(stream)
    printed(tmp_path / "objects.rrd", "verify")
    text = printed(tmp_path / "objects.rrd", "print", "-vvv")
    assert "/world/source/objects " in text and "id 3: 6.0 m/s" in text and "Boxes3D" in text
    assert f" /{viewer.OBJECT_ARROWS} " in text


def test_boxes_and_arrows_of_objects_are_in_the_sources_axes():
    pair, result = next(drive())
    logged = Logged()
    viewer._log_boxes(logged, with_object(pair, result))
    viewer._log_arrows_of_objects(logged, with_object(pair, result))
    boxes, arrows = logged.by_entity[viewer.OBJECTS], logged.by_entity[viewer.OBJECT_ARROWS]

    def values(batch):
        return np.array(batch.as_arrow_array().to_pylist())

    np.testing.assert_allclose(values(boxes.centers), [[8, 0, 0]])
    np.testing.assert_allclose(values(boxes.half_sizes), [[2, 1, 0.75]])
    np.testing.assert_allclose(values(boxes.quaternions), [[0, 0, 0.5**0.5, 0.5**0.5]], atol=1e-6)
    np.testing.assert_allclose(values(arrows.origins), [[8, 0, 0.75]])
    np.testing.assert_allclose(values(arrows.vectors), [[0, 6, 0]], atol=1e-6)
    viewer._log_boxes(logged, result)
    assert len(values(logged.by_entity[viewer.OBJECTS].centers)) == 0, "those of the frame before are gone"


def test_a_scan_without_any_motion_or_match_or_crispness_can_be_logged(tmp_path):
    pair, result = next(drive())
    still = replace(result, is_dynamic=np.zeros(len(pair.source), bool), match_source=np.empty((0, 3)),
                    match_target=np.empty((0, 3)))
    stream = viewer.open_recording(tmp_path / "still.rrd")
    viewer.log_pair(stream, 0, pair, still, None, pose.identity(), arrows=True)
    rerun_streams.close(stream)
    text = printed(tmp_path / "still.rrd", "print", "-v")
    assert f" /{viewer.STATIC} " in text and "Scalars" not in text


@pytest.mark.parametrize(("start_ns", "is_date"), [(10**18, True), (10**9, False)])
def test_times_are_dates_where_they_count_from_1970(tmp_path, start_ns, is_date):
    pair, result = next(drive())
    pair = ScanPair(replace(pair.source, time_ns=start_ns), replace(pair.target, time_ns=start_ns + 10**8))
    stream = viewer.open_recording(tmp_path / "timed.rrd")
    viewer.log_pair(stream, 0, pair, result, None, pose.identity())
    rerun_streams.close(stream)
    text = printed(tmp_path / "timed.rrd", "print", "-vvv")
    assert f"index_name: {rerun_streams.TIME} " in text
    assert ("Duration(ns)" in text) != is_date


def test_total_flow_arrows_come_on_request(tmp_path):
    path = tmp_path / "arrows.rrd"
    record(path, arrows=True)
    assert f" /{viewer.TOTAL_ARROWS} " in printed(path, "print", "-v")


def test_stored_arrays_get_the_same_look_with_or_without_the_next_scan(tmp_path):
    pair, result = next(drive())
    arrays = (pair.source.points, result.flow, result.is_dynamic, result.ego_motion, pair.dt_s)
    for name, target_points in (("with.rrd", pair.target.points), ("without.rrd", None)):
        stream = viewer.open_recording(tmp_path / name)
        viewer.log_flow(stream, *arrays, target_points=target_points)
        rerun_streams.close(stream)
        text = printed(tmp_path / name, "print", "-v")
        assert f" /{viewer.MOVING} " in text and f" /{viewer.MOVED} " in text
        assert (f" /{viewer.NEXT} " in text) == (target_points is not None)


def test_a_recording_of_a_full_scan_stays_small(tmp_path):
    path = tmp_path / "large.rrd"
    pair, result = next(drive(points_n=120_000))
    stream = viewer.open_recording(path)
    viewer.log_pair(stream, 0, pair, result, None, pose.identity())
    rerun_streams.close(stream)
    assert path.stat().st_size < 8e6
