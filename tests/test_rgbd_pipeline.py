"""RGB-D pairs and sequences from end to end: rendered rooms with their truth, and the paper's own pairs."""

import functools

import numba
import numpy as np
import pytest
import rgbd_corner
from rgbd_worlds import HALF_FRAMES, QVGA, ROOMS, frames, moving_share
from shared_data import ROOT, SHARED, needs_shared

from lidarflow import config, pose, rgbd_methods, rgbd_metrics, settings
from lidarflow.datasets.rgbd_folders import open_rgbd
from lidarflow.errors import DataError
from lidarflow.rgbd import RgbdEstimator, estimate_flow, odometry, pyramid
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdPair, RgbdResult

DEFAULTS = RgbdConfig()
PLAIN = settings.updated(DEFAULTS, {"segmentation": {"enabled": False}})
PAPER_FILE = ROOT / "configs" / "rgbd" / "jaimez2017.toml"
MOTION = pose.exp(np.array([0.012, -0.02, 0.01, 0.03, -0.015, 0.02]))
# Photometric and geometric residuals of the paper's Table III.
TABLE_3 = {"two_people_walking": (0.0284, 0.0360), "robot": (0.0251, 0.0643),
           "cleaning_whiteboard": (0.0214, 0.0377)}
# What moves and what stands still, (rows, columns) of the working size.
MOVING = {"two_people_walking": [np.s_[60:200, 30:80], np.s_[40:220, 158:195]],
          "robot": [np.s_[15:30, 195:215], np.s_[130:170, 185:218], np.s_[185:205, 175:230]],
          "cleaning_whiteboard": [np.s_[100:200, 182:205], np.s_[92:102, 146:160], np.s_[50:66, 110:122]]}
STILL = {"two_people_walking": [np.s_[20:200, 215:290]],
         "robot": [np.s_[20:220, 10:110], np.s_[20:170, 260:295]],
         "cleaning_whiteboard": [np.s_[20:190, 10:75], np.s_[20:200, 232:295]]}


@functools.cache
def followed(
    name: str, count: int, settings: RgbdConfig
) -> tuple[tuple[RgbdResult, rgbd_metrics.RgbdScores], ...]:
    """Results and scores of every pair of a rendered sequence."""
    sequence = frames(name, count=count)
    estimator = RgbdEstimator(QVGA, settings)
    results = [estimator.step(frame) for frame, _ in sequence][1:]
    return tuple((result, rgbd_metrics.score(result, truth))
                 for result, (_, truth) in zip(results, sequence[:-1], strict=True))


def equal(a: RgbdResult, b: RgbdResult) -> bool:
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes()
               for name in ("flow", "label", "b", "cluster_motions", "odometry", "is_dynamic"))


def corner_pair() -> RgbdPair:
    return rgbd_corner.pair(MOTION)


# ---- rendered rooms -------------------------------------------------------------------------------------

def test_camera_and_moving_things_of_a_room_are_found():
    scores = [score for _, score in followed("living_room", 4, DEFAULTS)]
    assert max(score.odometry_error_m for score in scores) < 0.002
    assert max(score.odometry_error_deg for score in scores) < 0.05
    assert min(score.iou for score in scores) > 0.7
    assert max(score.epe_static_m for score in scores) < 0.004
    assert max(score.epe_moving_m for score in scores) < 0.015


def test_segmentation_saves_the_odometry_when_half_of_the_image_moves():
    found, plain = (followed("passing_wardrobe", HALF_FRAMES, settings) for settings in (DEFAULTS, PLAIN))
    truths = [truth for _, truth in frames("passing_wardrobe", count=HALF_FRAMES)[:-1]]
    assert moving_share(truths[-1]) > 0.5
    for (_, score), (_, without) in zip(found, plain, strict=True):
        assert score.odometry_error_m < 0.002 and score.odometry_error_deg < 0.05
        assert score.iou > 0.9
        assert score.odometry_error_m < 0.5 * without.odometry_error_m
    assert np.median([score.epe_moving_m for _, score in found]) < 0.003


def test_the_paper_s_settings_work_too():
    settings = config.load(PAPER_FILE, kind=RgbdConfig)
    assert settings != DEFAULTS and settings.clusters.count == 24
    for _, score in followed("living_room", 4, settings):
        assert score.odometry_error_m < 0.005 and score.odometry_error_deg < 0.2 and score.iou > 0.6


# ---- what every result must be --------------------------------------------------------------------------

def test_a_still_world_is_static_and_moves_as_the_camera_does():
    result = estimate_flow(corner_pair())
    assert pose.translation_distance(MOTION, result.odometry) < 0.001
    assert result.b.max() < 1 / 3 and not result.is_dynamic.any() and result.valid.all()
    expected = pose.apply(MOTION, result.points.astype(float)) - result.points
    assert np.linalg.norm(result.flow - expected, axis=-1).max() < 0.002
    assert np.abs(result.residual_flow()).max() < 1e-5
    assert set(result.seconds) >= {"pyramid", "clusters", "robust odometry", "segmentation", "refinement"}


def test_twice_the_same_frame_is_no_motion():
    frame = rgbd_corner.frame(np.eye(4))
    result = estimate_flow(RgbdPair(frame, frame, QVGA))
    assert np.abs(pose.log(result.odometry)).max() < 1e-6 and np.abs(result.flow).max() < 1e-6


def test_swapping_the_frames_inverts_the_odometry():
    pair = corner_pair()
    back = estimate_flow(RgbdPair(pair.target, pair.source, QVGA)).odometry
    assert pose.translation_distance(pose.inverse(MOTION), back) < 0.001


def test_equal_input_gives_equal_bytes_whatever_the_number_of_threads():
    (source, _), (target, _), *_ = frames("living_room")
    pair = RgbdPair(source, target, QVGA)
    first = estimate_flow(pair)
    assert first.is_dynamic.any()
    before = numba.get_num_threads()
    try:
        for threads in sorted({1, before}):
            numba.set_num_threads(threads)
            assert equal(estimate_flow(pair), first)
    finally:
        numba.set_num_threads(before)


def test_images_are_left_alone():
    pair = corner_pair()
    before = [getattr(frame, name).tobytes()
              for frame in (pair.source, pair.target) for name in ("intensity", "depth")]
    estimate_flow(pair)
    assert before == [getattr(frame, name).tobytes()
                      for frame in (pair.source, pair.target) for name in ("intensity", "depth")]


def test_larger_images_are_worked_at_the_working_size():
    camera = Camera.from_field_of_view(640, 360)
    result = estimate_flow(rgbd_corner.pair(MOTION, camera))
    assert result.flow.shape == (180, 320, 3) and result.camera.width == 320
    assert result.camera.fx == pytest.approx(camera.fx / 2)
    assert pose.translation_distance(MOTION, result.odometry) < 0.001


def test_an_estimator_carries_the_segmentation_and_forgets_after_a_frame_it_cannot_use():
    sequence = [frame for frame, _ in frames("living_room")]
    estimator = RgbdEstimator(QVGA)
    assert estimator.step(sequence[0]) is None
    first, second = estimator.step(sequence[1]), estimator.step(sequence[2])
    alone = estimate_flow(RgbdPair(sequence[1], sequence[2], QVGA))
    told = estimate_flow(RgbdPair(sequence[1], sequence[2], QVGA), previous=first)
    assert equal(second, told) and not equal(second, alone)

    blank = RgbdFrame(np.zeros((240, 320), np.float32), np.zeros((240, 320), np.float32), name="blank")
    with pytest.raises(DataError, match="blank: no pixel has a depth"):
        estimator.step(blank)
    assert estimator.step(sequence[1]) is None
    assert equal(estimator.step(sequence[2]), alone)


LEFT, RIGHT, PIXEL = np.arange(320) < 160, np.arange(320) >= 160, np.arange(240 * 320) == 120 * 320 + 160


def with_depth(frame: RgbdFrame, where: np.ndarray) -> RgbdFrame:
    """The frame with depth at some of its pixels only, (240, 320) bool or what broadcasts to that."""
    return RgbdFrame(frame.intensity, np.where(where, frame.depth, np.float32(0.0)), name=frame.name)


@pytest.mark.parametrize(("source", "target"), [
    pytest.param(LEFT, RIGHT, id="one half and the other"),
    pytest.param(True, PIXEL.reshape(240, 320), id="one pixel"),
])
@pytest.mark.parametrize("settings", [DEFAULTS, PLAIN], ids=["default", "plain"])
def test_frames_that_show_nothing_in_common_are_refused(source, target, settings):
    pair = corner_pair()
    cut = RgbdPair(with_depth(pair.source, source), with_depth(pair.target, target), QVGA)
    with pytest.raises(DataError, match="odometry: 0% of the first frame's depth is seen again"):
        estimate_flow(cut, settings)


@pytest.mark.parametrize("share", [0.5, 0.2])
def test_frames_with_depth_for_a_part_of_each_other_are_enough(share):
    pair = corner_pair()
    target = with_depth(pair.target, np.arange(320) >= 320 * (1.0 - share))
    result = estimate_flow(RgbdPair(pair.source, target, QVGA))
    assert pose.translation_distance(MOTION, result.odometry) < 0.002


def upside_down(frame: RgbdFrame) -> RgbdFrame:
    return RgbdFrame(frame.intensity[::-1].copy(), frame.depth[::-1].copy(), name=frame.name)


def unrelated() -> dict[str, tuple[RgbdFrame, RgbdFrame]]:
    """Frames with depth nearly everywhere, of different places."""
    room, corner = frames("living_room")[0][0], rgbd_corner.frame(np.eye(4))
    other_paper = frames("living_room", seed=2)[0][0]
    return {"a room and a corner": (room, corner), "a corner and a room": (corner, room),
            "upside down": (room, upside_down(room)), "furnished alike": (room, other_paper)}


@pytest.mark.parametrize("name", unrelated())
@pytest.mark.parametrize("settings", [DEFAULTS, PLAIN], ids=["default", "plain"])
def test_frames_of_different_places_are_refused(name, settings):
    source, target = unrelated()[name]
    with pytest.raises(DataError, match=r"odometry: \d+% of .* has the depth and brightness of the first"):
        estimate_flow(RgbdPair(source, target, QVGA), settings)


@pytest.mark.parametrize("name", ROOMS)
def test_what_consecutive_frames_of_a_room_see_again_is_nearly_all_alike(name):
    (source, truth), (target, _) = frames(name)[:2]
    levels = [pyramid.build(frame, QVGA, DEFAULTS.images)[0] for frame in (source, target)]
    assert odometry.likeness(*levels, truth.flow) > 0.9
    assert odometry.likeness(*levels, np.full_like(truth.flow, 0.5)) < 0.5
    assert odometry.likeness(*levels, np.full_like(truth.flow, -100.0)) == 0.0


def test_an_estimator_goes_on_after_frames_that_show_nothing_in_common():
    first, second, third = (frame for frame, _ in frames("living_room")[:3])
    estimator = RgbdEstimator(QVGA)
    estimator.step(with_depth(first, LEFT))
    with pytest.raises(DataError, match="seen again"):
        estimator.step(with_depth(second, RIGHT))
    estimator.reset()
    assert estimator.step(second) is None
    assert equal(estimator.step(third), estimate_flow(RgbdPair(second, third, QVGA)))


@pytest.mark.parametrize("depth", [
    pytest.param(np.eye(240, 320, dtype=np.float32), id="hardly any depth"),
    pytest.param(np.full((240, 320), 2.0, np.float32), id="nothing to see on a wall"),
    pytest.param(np.linspace(900, 5e4, 240 * 320, dtype=np.float32).reshape(240, 320), id="millimetres"),
])
def test_images_that_say_little_still_give_a_finite_answer(depth):
    frame = RgbdFrame(np.full((240, 320), 0.5, np.float32), depth)
    result = estimate_flow(RgbdPair(frame, frame, QVGA))
    assert np.isfinite(result.flow).all() and np.isfinite(result.b).all()
    assert np.abs(pose.log(result.odometry)).max() < 1e-6


# ---- real images ----------------------------------------------------------------------------------

@functools.cache
def real(name: str) -> tuple[RgbdPair, RgbdResult]:
    folder = open_rgbd(SHARED / "rgbd_joint_vo_sf_pairs" / name)
    assert folder.camera == Camera.from_field_of_view(640, 480)
    pair = RgbdPair(folder.frame(0), folder.frame(1), folder.camera)
    return pair, estimate_flow(pair)


@needs_shared
@pytest.mark.parametrize("name", TABLE_3)
def test_residuals_of_the_paper_s_pairs_are_not_above_the_paper_s(name):
    scores = rgbd_metrics.warp_scores(*real(name))
    photometric, geometric_m = TABLE_3[name]
    assert scores.after.photometric <= photometric and scores.after.geometric_m <= geometric_m
    assert scores.after.geometric_m < 0.8 * scores.by_odometry.geometric_m


@needs_shared
@pytest.mark.parametrize("name", TABLE_3)
def test_people_robot_and_arm_move_and_the_room_does_not(name):
    _, result = real(name)
    for where in MOVING[name]:
        assert result.is_dynamic[where][result.valid[where]].mean() > 0.9
    for where in STILL[name]:
        assert (result.b_image[where][result.valid[where]] < 1 / 3).mean() > 0.97


@needs_shared
@pytest.mark.parametrize(("name", "most_m", "most_deg"), [
    ("rgbd_tum_fr1_desk9", 0.003, 0.4),     # the poses' own clock is about 20 ms off, a third of a degree
    ("rgbd_open3d5", 0.0008, 0.03),
])
def test_drift_over_real_images_is_small_and_below_open3d_s(name, most_m, most_deg):
    folder = open_rgbd(SHARED / name)
    drifts = {}
    for method in ("ours", "open3d"):
        estimator = rgbd_methods.estimator(method, folder.camera, DEFAULTS)
        results = [estimator.step(folder.frame(index)) for index in range(len(folder))][1:]
        poses = pose.trajectory(np.array([result.odometry for result in results]))
        drifts[method] = rgbd_metrics.drift(poses, folder.world_from_camera(), np.arange(len(folder)))
        if method == "ours":
            assert max(result.is_dynamic.mean() for result in results) < 0.02
    ours, theirs = drifts["ours"], drifts["open3d"]
    assert ours.per_frame_m < min(most_m, theirs.per_frame_m)
    assert ours.per_frame_deg < min(most_deg, theirs.per_frame_deg)


@needs_shared
@pytest.mark.parametrize("name", TABLE_3)
def test_real_frames_of_different_places_are_refused(name):
    folder = open_rgbd(SHARED / "rgbd_joint_vo_sf_pairs" / name)
    other = open_rgbd(SHARED / "rgbd_open3d5").frame(0)
    for pair in ((folder.frame(0), other), (other, folder.frame(1))):
        with pytest.raises(DataError, match=r"has the depth and brightness of the first|is seen again"):
            estimate_flow(RgbdPair(*pair, folder.camera))
