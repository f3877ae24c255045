"""The stages of the RGB-D method, each by itself: pyramid, clusters, odometry, segmentation, propagation."""

import numpy as np
import pytest
import rgbd_corner
from rgbd_corner import QVGA
from scipy import optimize

from lidarflow import pose, settings
from lidarflow.errors import DataError
from lidarflow.kernels import cluster_images
from lidarflow.rgbd import clusters as geometric
from lidarflow.rgbd import odometry, propagation, pyramid, refinement, segmentation
from lidarflow.rgbd_config import RgbdConfig, SegmentationConfig
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdResult

DEFAULTS = RgbdConfig()
MOTION = pose.exp(np.array([0.012, -0.02, 0.01, 0.03, -0.015, 0.02]))


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def levels_of(found: RgbdFrame, camera: Camera = QVGA) -> tuple[pyramid.Level, ...]:
    return pyramid.build(found, camera, DEFAULTS.images)


def pair_levels(motion: np.ndarray):
    pair = rgbd_corner.pair(motion)
    return levels_of(pair.source), levels_of(pair.target)


def two_walls(nearer_m: float, farther_m: float) -> RgbdFrame:
    """A wall that hides the left half of another."""
    depth = np.full((240, 320), farther_m, np.float32)
    depth[:, :160] = nearer_m
    return RgbdFrame(np.full_like(depth, 0.5), depth)


# ---- pyramid --------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("size", "expected"), [
    ((640, 480), [(320, 240), (160, 120), (80, 60), (40, 30), (20, 15)]),
    ((320, 240), [(320, 240), (160, 120), (80, 60), (40, 30), (20, 15)]),
    ((1280, 720), [(320, 180), (160, 90), (80, 45), (40, 22), (20, 11)]),
    ((101, 75), [(101, 75), (50, 37), (25, 18), (12, 9)]),
])
def test_levels_halve_from_the_working_size(size, expected):
    camera = Camera.from_field_of_view(*size)
    levels = levels_of(rgbd_corner.frame(np.eye(4), camera), camera)
    assert [(level.camera.width, level.camera.height) for level in levels] == expected
    for level in levels:
        assert level.packed.shape[:2] == level.points.shape[:2] == (level.camera.height, level.camera.width)


@pytest.mark.parametrize("size", [(640, 480), (500, 333), (101, 75)])
def test_points_of_every_level_lie_on_the_same_walls_with_the_same_texture(size):
    camera = Camera.from_field_of_view(*size, horizontal_deg=58.0)
    for level in levels_of(rgbd_corner.frame(np.eye(4), camera), camera)[:3]:
        points = level.points.reshape(-1, 3).astype(float)
        normals = rgbd_corner.WALLS[:, :3] / np.linalg.norm(rgbd_corner.WALLS[:, :3], axis=1, keepdims=True)
        offsets = rgbd_corner.WALLS[:, 3] / np.linalg.norm(rgbd_corner.WALLS[:, :3], axis=1)
        off_m = np.abs(points @ normals.T - offsets).min(axis=1)
        # A pixel is 2 m / fx wide; half a pixel off would be about a quarter of that, as the walls slant.
        assert np.median(off_m) < 0.15 * 2.0 / level.camera.fx
        off = np.abs(level.packed[..., 0].ravel() - rgbd_corner.texture(points))
        assert np.median(off) < 0.03


def test_depth_is_never_a_mixture_of_two_surfaces():
    for level in levels_of(two_walls(1.0, 3.0)):
        assert set(np.unique(level.packed[..., 1].round(4))) == {1.0, 3.0}


@pytest.mark.parametrize("size", [(640, 480), (400, 300), (333, 241), (848, 480)])
def test_a_slanted_plane_keeps_its_depth_at_any_size(size):
    def depth_of(camera: Camera) -> np.ndarray:
        slant = (np.arange(camera.width) - camera.cx) / camera.fx
        return np.tile(3.0 / (1.0 - 0.8 * slant), (camera.height, 1)).astype(np.float32)

    camera = Camera.from_field_of_view(*size)
    found, smaller = pyramid.at_working_size(
        RgbdFrame(np.full((camera.height, camera.width), 0.5, np.float32), depth_of(camera)), camera,
        DEFAULTS.images)
    np.testing.assert_allclose(found.depth, depth_of(smaller), atol=0.0025)


def test_a_frame_that_says_nothing_is_refused():
    blank = RgbdFrame(np.ones((240, 320), np.float32), np.zeros((240, 320), np.float32), name="dark")
    with pytest.raises(DataError, match="dark: no pixel has a depth"):
        levels_of(blank)
    with pytest.raises(DataError, match="corner: 320x240 pixels, but the camera has 640x480"):
        levels_of(rgbd_corner.frame(np.eye(4)), Camera.from_field_of_view(640, 480))
    tiny = RgbdFrame(np.ones((4, 320), np.float32), np.ones((4, 320), np.float32), name="strip")
    with pytest.raises(DataError, match="strip: 320x4 pixels are too few"):
        levels_of(tiny, Camera.from_field_of_view(320, 4))


# ---- clusters -------------------------------------------------------------------------------------------

def test_every_pixel_with_depth_belongs_to_the_nearest_centre_at_every_level():
    found = rgbd_corner.frame(np.eye(4))
    depth = found.depth.copy()
    depth[50:90, 100:140] = 0.0
    levels = levels_of(RgbdFrame(found.intensity, depth))
    clusters = geometric.find(levels, DEFAULTS.clusters)
    assert len(clusters.centres) == DEFAULTS.clusters.count
    for level, label in zip(levels, clusters.labels, strict=True):
        np.testing.assert_array_equal(label >= 0, level.points[..., 2] > 0)
        points = level.points[label >= 0].astype(float)
        distances = np.linalg.norm(points[:, None] - clusters.centres, axis=-1)
        own = np.take_along_axis(distances, label[label >= 0][:, None], axis=1)[:, 0]
        np.testing.assert_allclose(own, distances.min(axis=1), atol=1e-5)
    assert np.bincount(clusters.labels[0][clusters.labels[0] >= 0]).min() > 100


def test_clusters_touch_along_a_surface_and_not_across_a_step():
    levels = levels_of(two_walls(1.0, 1.5))
    clusters = geometric.find(levels, DEFAULTS.clusters)
    near = clusters.centres[:, 2] < 1.25
    assert 5 < near.sum() < len(near) - 5
    assert not clusters.touch[np.ix_(near, ~near)].any()
    reached = np.flatnonzero(near)[:1]
    while len(grown := np.flatnonzero(clusters.touch[reached].any(axis=0))) > len(reached):
        reached = grown
    assert set(reached) == set(np.flatnonzero(near))


def test_parts_of_the_image_without_depth_get_no_cluster():
    found = two_walls(1.0, 2.0)
    depth = found.depth.copy()
    depth[:, 100:] = 0.0
    clusters = geometric.find(levels_of(RgbdFrame(found.intensity, depth)), DEFAULTS.clusters)
    assert 0 < len(clusters.centres) < DEFAULTS.clusters.count
    assert np.isfinite(clusters.centres).all() and (clusters.centres[:, 2] > 0.9).all()


# ---- odometry -------------------------------------------------------------------------------------------

@pytest.mark.parametrize("scale", [0.0, 1.0, -1.0, 2.0])
def test_robust_and_refined_odometry_find_an_exact_motion(scale):
    motion = pose.exp(scale * pose.log(MOTION))
    source, target = pair_levels(motion)
    clusters = geometric.find(source, DEFAULTS.clusters)
    nothing_moves = np.zeros(len(clusters.centres))
    robust = odometry.robust(source, target, clusters, nothing_moves, DEFAULTS)
    refined, motions = refinement.refine(source, target, clusters, nothing_moves, robust, DEFAULTS)
    for found in (robust, refined):
        assert pose.translation_distance(motion, found) < 0.001
        assert np.degrees(pose.rotation_distance(motion[None], found[None])[0]) < 0.03
    np.testing.assert_array_equal(motions, np.tile(refined, (len(clusters.centres), 1, 1)))


def test_clusters_known_to_move_do_not_disturb_the_odometry():
    source, target = pair_levels(MOTION)
    clusters = geometric.find(source, DEFAULTS.clusters)
    far = clusters.centres[:, 2] > np.median(clusters.centres[:, 2])
    # What is far seems to stay where it was in the image: the camera moves, and it with the camera.
    stuck = np.isin(clusters.labels[0], np.flatnonzero(far))
    mixed = levels_of(RgbdFrame(
        np.where(stuck, source[0].packed[..., 0], target[0].packed[..., 0]),
        np.where(stuck, source[0].packed[..., 1], target[0].packed[..., 1])))
    told = odometry.robust(source, mixed, clusters, far.astype(float), DEFAULTS)
    untold = odometry.robust(source, mixed, clusters, np.zeros(len(far)), DEFAULTS)
    assert pose.translation_distance(MOTION, told) < 0.002 < 0.01 < pose.translation_distance(MOTION, untold)
    refined, motions = refinement.refine(source, mixed, clusters, far.astype(float), told, DEFAULTS)
    assert pose.translation_distance(MOTION, refined) < 0.002
    assert np.median(pose.translation_distance(motions[far], np.eye(4))) < 0.002


def test_where_everything_moves_the_robust_odometry_stays():
    source, target = pair_levels(MOTION)
    clusters = geometric.find(source, DEFAULTS.clusters)
    everything_moves = np.full(len(clusters.centres), 2.0)
    refined, motions = refinement.refine(source, target, clusters, everything_moves, MOTION, DEFAULTS)
    np.testing.assert_array_equal(refined, MOTION)
    assert np.median(pose.translation_distance(motions, MOTION)) < 0.002


# ---- segmentation ---------------------------------------------------------------------------------------

def some_clusters(count: int, seed: int) -> geometric.Clusters:
    random = rng(seed)
    touch = random.random((count, count)) < 0.3
    centres = random.uniform([-1, -1, 0.8], [1, 1, 4.0], (count, 3)).astype(np.float32)
    return geometric.Clusters(centres, (), touch | touch.T | np.eye(count, dtype=bool))


def energy(b, delta, lower, upper, clusters, b_before, limits: SegmentationConfig) -> float:
    """E_D + E_R + E_T + E_Z, term by term."""
    z = clusters.centres[:, 2].astype(float)
    z_min = z.min() + limits.far_share * (z.max() - z.min())
    total = 0.0
    for i in range(len(b)):
        g = min(max((delta[i] - lower) / (upper - lower), 0.0), limits.ceiling)
        w = np.sqrt(((2 * delta[i] - (upper + lower)) / (upper - lower)) ** 2 + 1)
        total += w * (b[i] - g) ** 2 + limits.depth * max(0.0, np.exp(z[i]) - np.exp(z_min)) * b[i] ** 2
        if b_before is not None:
            total += limits.temporal * (b[i] - b_before[i]) ** 2
        total += sum(limits.smoothness * (b[i] - b[j]) ** 2 for j in range(i) if clusters.touch[i, j])
    return total


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("first", [True, False])
def test_the_closed_form_is_the_minimum_of_the_energy(seed, first):
    clusters, random = some_clusters(7, seed), rng(100 + seed)
    delta, before = random.uniform(0, 0.04, 7), None if first else random.uniform(0, 1, 7)
    arguments = delta, 0.008, 0.016, clusters, before, DEFAULTS.segmentation
    b = segmentation.minimise(*arguments)
    found = optimize.minimize(energy, random.uniform(0, 1, 7), arguments, tol=1e-12)
    np.testing.assert_allclose(b, found.x, atol=2e-4)
    assert energy(b, *arguments) <= found.fun + 1e-9
    if not first:
        forgetful = segmentation.minimise(delta, 0.008, 0.016, clusters, None, DEFAULTS.segmentation)
        assert np.abs(b - before).sum() < np.abs(forgetful - before).sum()


def test_residuals_far_from_the_thresholds_decide_and_distance_speaks_for_static():
    loose = settings.updated(DEFAULTS, {"segmentation": {"smoothness": 0.0}}).segmentation
    centres = np.array([[0, 0, 1.0], [0, 0, 1.0], [0, 0, 1.0], [0, 0, 4.0]], np.float32)
    clusters = geometric.Clusters(centres, (), np.eye(4, dtype=bool))
    b = segmentation.minimise(np.array([0.0, 0.015, 0.05, 0.05]), 0.01, 0.02, clusters, None, loose)
    np.testing.assert_allclose(b[:3], [0.0, 0.5, 2.0], atol=1e-12)
    weight, far = np.hypot(7.0, 1.0), 0.15 * (np.exp(4.0) - np.exp(1.75))
    assert b[3] == pytest.approx(2.0 * weight / (weight + far)) and b[3] < 1.0
    assert segmentation.has_own_motion(b, loose).tolist() == [False, True, True, True]


@pytest.mark.parametrize(("typical", "twist_norm", "expected"), [
    (0.001, 0.0, (0.007, 0.014)),              # never below the smallest
    (0.010, 0.0, (0.010, 0.020)),
    (0.030, 0.0, (0.015, 0.030)),              # nor above the largest, which grows with the motion
    (0.030, 0.05, (1.5 * 0.0225, 2.5 * 0.0225)),
    (0.010, 0.05, (0.015, 0.025)),
])
def test_thresholds_follow_the_residuals_and_the_motion(typical, twist_norm, expected):
    delta = np.array([0.5, typical, typical, 0.5, 0.5, 0.5, 0.5, typical])
    assert segmentation.thresholds(delta, twist_norm, DEFAULTS.segmentation) == pytest.approx(expected)


def test_mean_residuals_are_those_of_the_clusters_that_do_not_follow():
    source, target = pair_levels(MOTION)
    clusters = geometric.find(source, DEFAULTS.clusters)
    followed = segmentation.mean_residuals(source[0], target[0], clusters, MOTION, DEFAULTS)
    assert followed.max() < 0.002
    left = np.isin(clusters.labels[0], np.flatnonzero(clusters.centres[:, 0] < -0.3))
    depth = np.where(left, source[0].packed[..., 1], 0)
    closer = levels_of(RgbdFrame(source[0].packed[..., 0], source[0].packed[..., 1] - 0.05 * (depth > 0)))
    delta = segmentation.mean_residuals(source[0], closer[0], clusters, np.eye(4), DEFAULTS)
    moved = clusters.centres[:, 0] < -0.3
    np.testing.assert_allclose(delta[moved], 0.05 / clusters.centres[moved, 2], rtol=0.2)
    assert np.median(delta[~moved]) < 1e-6


def test_what_is_hidden_is_no_evidence_of_motion():
    source = levels_of(two_walls(3.0, 3.0))
    hidden = levels_of(two_walls(1.0, 3.0))
    clusters = geometric.find(source, DEFAULTS.clusters)
    assert segmentation.mean_residuals(source[0], hidden[0], clusters, np.eye(4), DEFAULTS).max() == 0.0
    uncovered = segmentation.mean_residuals(hidden[0], source[0], geometric.find(hidden, DEFAULTS.clusters),
                                            np.eye(4), DEFAULTS)
    assert uncovered.max() > 0.15


# ---- blending and propagation ---------------------------------------------------------------------------

def test_flow_passes_smoothly_between_clusters_that_touch_and_breaks_between_others():
    levels = levels_of(two_walls(1.0, 1.0))
    clusters = geometric.find(levels, DEFAULTS.clusters)
    motions = pose.from_translation(rng(5).normal(scale=0.02, size=(len(clusters.centres), 3)))

    def largest_step(per_m2: float, touch: np.ndarray) -> float:
        flow = cluster_images.blended_flow(levels[0].points, clusters.labels[0], clusters.centres, touch,
                                           np.float32(per_m2), odometry.rows34(motions))
        return np.abs(np.diff(flow, axis=1)).max()

    jump = largest_step(1e9, clusters.touch)
    assert jump > 0.02
    assert largest_step(DEFAULTS.clusters.blending_per_m2, clusters.touch) < 0.4 * jump
    alone = np.eye(len(motions), dtype=bool)
    assert largest_step(DEFAULTS.clusters.blending_per_m2, alone) == pytest.approx(jump)


def result_of(levels, clusters, b: np.ndarray, motions: np.ndarray) -> RgbdResult:
    label = clusters.labels[0]
    return RgbdResult(
        np.zeros_like(levels[0].points), levels[0].points, label >= 0, label, b, motions, np.eye(4),
        np.zeros_like(label, bool), levels[0].camera, clusters.centres)


def test_the_segmentation_is_carried_along_with_the_clusters():
    levels = levels_of(two_walls(1.0, 2.0))
    clusters = geometric.find(levels, DEFAULTS.clusters)
    b = rng(6).uniform(0, 2, len(clusters.centres))
    unmoved = result_of(levels, clusters, b, np.tile(np.eye(4), (len(b), 1, 1)))
    np.testing.assert_allclose(propagation.carried(unmoved, levels[0], clusters), b, atol=1e-9)

    # The near wall moves 0.6 m away, so the same clusters are found around moved centres.
    near = clusters.centres[:, 2] < 1.5
    motions = np.tile(np.eye(4), (len(b), 1, 1))
    motions[near, 2, 3] = 0.6
    moved = levels_of(two_walls(1.6, 2.0))
    found = geometric.find(moved, DEFAULTS.clusters)
    carried = propagation.carried(result_of(levels, clusters, near.astype(float), motions), moved[0], found)
    left = found.centres[:, 2] < 1.8
    assert carried[left].min() > 0.8 and carried[~left].max() < 0.1
