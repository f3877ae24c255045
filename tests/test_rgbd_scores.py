"""RGB-D scores on small images and poses whose scores are computed by hand; Open3D's odometry as a method."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from rgbd_worlds import PERFECT, QVGA, frames, pair

from lidarflow import pose, rgbd_methods
from lidarflow import rgbd_metrics as metrics
from lidarflow.errors import DataError, SolveError
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdPair, RgbdResult, RgbdTruth

SMALL = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)
SHAPE = (6, 8)
STILL = np.zeros((*SHAPE, 3))
PERIOD_NS = 33_333_333


def flat(depth_m=2.0, intensity=0.5):
    """A frame of one depth and one intensity, which may be images themselves."""
    whole = np.ones(SHAPE, np.float32)
    return RgbdFrame(whole * np.float32(intensity), whole * np.float32(depth_m))


def shifted(x=0.0, y=0.0, z=0.0):
    return STILL + (x, y, z)


# Residuals after warping

def test_residuals_are_what_the_target_has_more_than_the_moved_source():
    found = metrics.residuals(flat(2.0, 0.5), flat(2.1, 0.6), SMALL, STILL)
    assert found.photometric == pytest.approx(0.1, abs=1e-6)
    assert found.geometric_m == pytest.approx(0.1, abs=1e-6)
    assert found.occluded == 0.0
    # On the last row and column, rounding decides what is inside; all others surely are.
    assert 5 * 7 <= found.pixels <= 48
    perfect = metrics.residuals(flat(2.0, 0.5), flat(2.1, 0.5), SMALL, shifted(z=0.1))
    assert perfect.geometric_m < 1e-6 and perfect.photometric < 1e-6


def test_intensity_is_interpolated_where_the_moved_point_projects_to():
    ramp = np.repeat(0.1 * np.arange(8)[None], 6, axis=0)
    # Half a pixel at 2 m and 10 pixels of focal length is 0.1 m; the last column leaves the image.
    found = metrics.residuals(flat(2.0, ramp), flat(2.0, ramp), SMALL, shifted(x=0.1))
    assert found.photometric == pytest.approx(0.05, abs=1e-6)
    assert found.geometric_m < 1e-6
    depth, intensity, seen = metrics.sampled(flat(2.0, ramp), SMALL, np.array([[[0.13, 0.0, 2.0]]]))
    assert seen.all() and intensity[0, 0] == pytest.approx(0.1 * 4.15) and depth[0, 0] == pytest.approx(2.0)


def test_pixels_behind_something_nearer_are_left_out_and_revealed_ones_are_not():
    target = np.full(SHAPE, 2.0)
    target[:3] = 1.5
    nearer = metrics.residuals(flat(), flat(target, np.where(target < 2, 0.9, 0.5)), SMALL, STILL)
    assert nearer.geometric_m < 1e-6 and nearer.photometric < 1e-6
    assert 0.4 < nearer.occluded < 0.65
    target[:3] = 2.5
    farther = metrics.residuals(flat(), flat(target), SMALL, STILL)
    assert farther.occluded == 0.0
    assert farther.geometric_m == pytest.approx(0.5 * np.sqrt(0.5), rel=0.15)
    just = metrics.residuals(flat(), flat(1.81), SMALL, STILL)
    assert just.geometric_m == pytest.approx(0.19, abs=1e-6) and just.occluded == 0.0
    assert np.isnan(metrics.residuals(flat(), flat(1.79), SMALL, STILL).geometric_m)


def test_points_that_the_target_does_not_see_do_not_count():
    target = flat()
    target.depth[2, 3] = 0.0
    middle, z = np.array([[[0.0, 0.0, 2.0]]]), 2.0
    assert not metrics.sampled(target, SMALL, middle)[2].any()     # between columns 3 and 4, rows 2 and 3
    for x, y, depth_m in ((z * 0.41, 0, z), (0, z * 0.31, z), (-z * 0.36, 0, z), (0, 0, -z), (0, 0, 0.0)):
        assert not metrics.sampled(flat(), SMALL, np.array([[[x, y, depth_m]]]))[2].any()
    nothing = metrics.residuals(flat(), flat(), SMALL, shifted(x=5.0))
    assert nothing.pixels == 0
    assert np.isnan([nothing.photometric, nothing.geometric_m, nothing.occluded]).all()
    source = flat()
    source.depth[:] = 0.0
    source.depth[2, 4] = 2.0
    assert metrics.residuals(source, flat(), SMALL, STILL).pixels == 1


def test_the_true_flow_leaves_least():
    found, truth = pair(sensor=PERFECT)
    done = metrics.warp_scores(found, result_of(truth, QVGA.points(found.source.depth)))
    assert done.after.geometric_m < done.by_odometry.geometric_m < done.before.geometric_m
    assert done.after.photometric < 0.5 * done.before.photometric
    assert done.after.pixels > 0.85 * truth.valid.sum()


def result_of(truth, points):
    """A result that is the truth."""
    label = np.where(truth.valid, truth.is_dynamic, -1).astype(np.int32)
    motions = np.stack([truth.odometry, np.eye(4)])
    return RgbdResult(truth.flow, points, truth.valid, label, np.array([0.0, 1.0]), motions, truth.odometry,
                      truth.is_dynamic, QVGA, np.zeros((2, 3), np.float32))


# Against the truth

def test_scores_of_eight_pixels():
    truth = RgbdTruth(
        flow=np.zeros((2, 4, 3), np.float32), odometry=np.eye(4),
        valid=np.array([[1, 1, 1, 1], [1, 1, 0, 1]], bool),
        is_dynamic=np.array([[1, 1, 0, 0], [1, 0, 1, 0]], bool))
    flow = np.zeros((2, 4, 3), np.float32)
    flow[0, 0], flow[0, 2], flow[1, 1] = (0.3, 0, 0.4), (0, 0.1, 0), (0, 0, 0.2)
    valid = np.array([[1, 1, 1, 1], [1, 1, 1, 0]], bool)
    dynamic = np.array([[1, 0, 1, 0], [1, 0, 0, 0]], bool)
    odometry = pose.from_yaw(np.radians(2.0), (0.03, 0.04, 0.0))
    camera = Camera(4, 2, 1, 1, 0, 0)
    result = RgbdResult(
        flow, np.zeros_like(flow), valid, np.where(valid, 0, -1), np.zeros(1), np.eye(4)[None], odometry,
        dynamic, camera, np.zeros((1, 3), np.float32))
    # Six pixels count: moving (0,0) (0,1) (1,0), static (0,2) (0,3) (1,1).
    done = metrics.score(result, truth)
    assert done.epe_m == pytest.approx(0.8 / 6) and done.epe_moving_m == pytest.approx(0.5 / 3)
    assert done.epe_static_m == pytest.approx(0.3 / 3)
    assert done.wrong == pytest.approx(2 / 6) and done.missed == pytest.approx(1 / 3)
    assert done.false == pytest.approx(1 / 3) and done.iou == pytest.approx(2 / 4)
    assert done.odometry_error_m == pytest.approx(0.05) and done.odometry_error_deg == pytest.approx(2.0)
    larger = RgbdTruth(*(np.repeat(np.repeat(image, 2, 0), 2, 1) if name != "odometry" else image
                         for name, image in (("flow", truth.flow), ("odometry", truth.odometry),
                                             ("valid", truth.valid), ("is_dynamic", truth.is_dynamic))))
    assert metrics.score(result, larger) == done
    still = metrics.score(replace(result, is_dynamic=np.zeros_like(dynamic)),
                          replace(truth, is_dynamic=np.zeros_like(dynamic)))
    assert np.isnan([still.iou, still.missed, still.epe_moving_m]).all() and still.wrong == 0.0


# Against poses

def steady(count, step):
    return np.stack([np.linalg.matrix_power(step, k) for k in range(count)])


def test_drift_per_frame_and_per_second_of_a_steady_error():
    times_ns = np.arange(91) * PERIOD_NS
    true = steady(91, pose.from_translation((0.01, 0.0, 0.0)))
    done = metrics.drift(steady(91, pose.from_translation((0.011, 0.0, 0.0))), true, times_ns)
    assert done.frames == 90
    assert done.per_frame_m == pytest.approx(0.001) and done.per_second_m == pytest.approx(0.030)
    assert done.per_frame_deg == pytest.approx(0.0, abs=1e-5)
    turned = metrics.drift(steady(91, pose.from_yaw(np.radians(0.1))), steady(91, np.eye(4)), times_ns)
    assert turned.per_frame_deg == pytest.approx(0.1) and turned.per_second_deg == pytest.approx(3.0)


def test_drift_does_not_depend_on_where_the_world_is():
    rng = np.random.default_rng(5)
    true, found = pose.exp(rng.normal(size=(2, 40, 6)))
    world = pose.exp(rng.normal(size=6))
    times_ns = np.arange(40) * PERIOD_NS
    there, here = (asdict(metrics.drift(poses, true, times_ns)) for poses in (world @ found, found))
    assert there == pytest.approx(here)


def test_drift_takes_the_root_of_the_mean_square_and_leaves_unknown_poses_out():
    found, true = np.tile(np.eye(4), (2, 4, 1, 1))
    found[1, 0, 3], found[2:, 0, 3] = 0.03, 0.07       # errors of 3, 4 and 0 cm
    times_ns = np.array([0, 1, 2, 3]) * PERIOD_NS
    assert metrics.drift(found, true, times_ns).per_frame_m == pytest.approx(np.sqrt((9 + 16) / 3) / 100)
    true[3] = np.nan
    done = metrics.drift(found, true, times_ns)
    assert done.frames == 2 and done.per_frame_m == pytest.approx(np.sqrt((9 + 16) / 2) / 100)
    assert np.isnan([done.per_second_m, done.per_second_deg]).all()     # shorter than a second
    assert metrics.drift(found[:1], true[:1], times_ns[:1]).frames == 0


def test_a_second_later_is_the_frame_nearest_to_it():
    times_ns = np.array([0.0, 0.4, 1.1, 1.3, 2.7]) * 1e9
    found = np.tile(np.eye(4), (5, 1, 1))
    found[:, 0, 3] = 0.0, 1.0, 2.0, 4.0, 8.0
    # Steps of 0.55 s at the median, so within 0.275 s: 0 -> 1.1, 0.4 -> 1.3; the others find nothing.
    done = metrics.drift(found, np.tile(np.eye(4), (5, 1, 1)), times_ns)
    assert done.per_second_m == pytest.approx(np.sqrt((2.0**2 + 3.0**2) / 2))


def test_depth_statistics():
    depth = np.array([[0.0, 1.0], [2.0, 6.0]], np.float32)
    assert metrics.depth_statistics(depth) == metrics.DepthStatistics(0.75, 3.0, 2.0)
    assert metrics.depth_statistics(np.zeros((2, 2), np.float32)).valid == 0.0


# Open3D's odometry

def test_open3d_as_a_method_follows_the_camera_and_calls_nothing_moving():
    found, truth = pair()
    result = rgbd_methods.estimate_flow("open3d", found, RgbdConfig())
    done = metrics.score(result, truth)
    assert done.odometry_error_m < 0.03 and done.odometry_error_deg < 0.5
    assert not result.is_dynamic.any() and set(np.unique(result.label)) == {-1, 0}
    np.testing.assert_allclose(result.flow, result.odometry_flow(), atol=1e-6)
    np.testing.assert_array_equal(result.valid, found.source.depth > 0)


def test_open3d_of_a_still_camera_is_still():
    source = frames()[0][0]
    result = rgbd_methods.estimate_flow("open3d", RgbdPair(source, source, QVGA), RgbdConfig())
    np.testing.assert_allclose(result.odometry, np.eye(4), atol=1e-6)


@pytest.mark.parametrize(("depth_m", "intensity"), [(60.0, 0.5), (9.0, 0.0)])
def test_open3d_without_a_motion_is_an_error(depth_m, intensity):
    image = np.ones((240, 320), np.float32)
    plain = RgbdFrame(np.float32(intensity) * image, np.float32(depth_m) * image, name="plain")
    with pytest.raises(SolveError, match="plain: Open3D's odometry"):
        rgbd_methods.estimate_flow("open3d", RgbdPair(plain, plain, QVGA), RgbdConfig())


def test_an_unknown_method():
    with pytest.raises(DataError, match="--method icp: unknown; expected one of ours, open3d"):
        rgbd_methods.estimator("icp", QVGA, RgbdConfig())
