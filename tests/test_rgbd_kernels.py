"""Compiled RGB-D kernels against slow NumPy twins that share no code with them.

Every check takes a size, so that the same comparison also runs with compilation off, on tiny images.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from scipy import ndimage

from lidarflow import pose, robust
from lidarflow.kernels import alignment, cluster_images, images, kmeans, linalg
from lidarflow.rgbd_types import Camera

JUMP_M = 0.1
NOISE = np.array([0.01, 5e-5], np.float32)


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def random_images(height: int, width: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Smooth intensity and depth (H, W) float32 with a step in depth and some holes."""
    random = rng(seed)
    smooth = ndimage.gaussian_filter(random.normal(size=(2, height, width)), (0, 1.5, 1.5))
    intensity = np.clip(0.5 + 0.8 * smooth[0], 0.0, 1.0).astype(np.float32)
    depth = (2.0 + 0.15 * smooth[1] + 1.3 * (np.arange(width) > 0.6 * width)).astype(np.float32)
    depth[random.random(depth.shape) < 0.04] = 0.0
    return intensity, depth


class World:
    """A source and a target image, their camera, a motion between them, and clusters of the source."""

    def __init__(self, height: int, width: int, clusters: int = 5):
        camera = Camera.from_field_of_view(width, height)
        self.camera = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        (intensity, depth), (next_intensity, next_depth) = (random_images(height, width, k) for k in (0, 1))
        # The target resembles the source, so that residuals are those of a start value, not of chance.
        next_intensity = 0.9 * np.roll(intensity, 1, axis=1) + 0.1 * next_intensity
        next_depth = np.where(next_depth > 0, np.roll(depth, 1, axis=1), 0.0)
        self.source = images.pack(intensity, depth)
        self.target = images.pack(next_intensity.astype(np.float32), next_depth.astype(np.float32))
        self.points = camera.points(depth)
        self.motion = pose.exp(np.array([0.01, -0.02, 0.015, 0.03, -0.02, 0.02]))
        flat = self.points[depth > 0]
        self.centres = flat[rng(2).choice(len(flat), clusters, replace=False)]
        self.label = kmeans.nearest(self.points.reshape(-1, 3), self.centres).reshape(depth.shape)
        self.touch = rng(3).random((clusters, clusters)) < 0.5
        self.touch |= self.touch.T | np.eye(clusters, dtype=bool)
        self.motions = pose.exp(rng(4).normal(scale=0.02, size=(clusters, 6)))

    def seen(self, motion: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Moved points (P, 3), what the target shows there (P, 6), and where it shows anything (P,)."""
        moved = pose.apply(motion, self.points.reshape(-1, 3)[pixels].astype(float))
        u = self.camera[0] * moved[:, 0] / moved[:, 2] + self.camera[2]
        v = self.camera[1] * moved[:, 1] / moved[:, 2] + self.camera[3]
        height, width = self.label.shape
        inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        u, v = np.where(inside, u, 0), np.where(inside, v, 0)
        left, top = np.minimum(u.astype(int), width - 2), np.minimum(v.astype(int), height - 2)
        corners = np.stack([self.target[top + j, left + i, 1] for j in (0, 1) for i in (0, 1)])
        jump = corners.max(axis=0) - corners.min(axis=0) > JUMP_M
        u = np.where(jump, np.floor(u + 0.5), u)
        v = np.where(jump, np.floor(v + 0.5), v)
        shown = np.stack([ndimage.map_coordinates(self.target[..., k].astype(float), [v, u], order=1)
                          for k in range(6)], axis=1)
        return moved, shown, inside & (corners > 0).all(axis=0)


def rows34(motion: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(motion[..., :3, :], np.float32)


# ---- images ---------------------------------------------------------------------------------------------

def surface_mean(readings: np.ndarray, shares: np.ndarray) -> float:
    known = readings > 0
    readings, shares = readings[known], shares[known]
    if not len(readings):
        return 0.0
    near = np.abs(readings - np.sort(readings)[(len(readings) - 1) // 2]) < JUMP_M
    return np.average(readings[near].astype(float), weights=shares[near])


def check_resize(height: int, width: int, small_height: int, small_width: int) -> None:
    intensity, depth = random_images(height, width, 5)
    small_intensity, small_depth = images.resize(intensity, depth, small_width, small_height, JUMP_M)
    for v in range(small_height):
        for u in range(small_width):
            edges = [np.clip(np.arange(size + 1), begin * size / small, (begin + 1) * size / small)
                     for size, small, begin in ((height, small_height, v), (width, small_width, u))]
            share = np.outer(*(np.diff(edge) for edge in edges))
            expected = (share * intensity).sum() / share.sum()
            np.testing.assert_allclose(small_intensity[v, u], expected, atol=1e-5)
            under = share > 1e-6
            np.testing.assert_allclose(
                small_depth[v, u], surface_mean(depth[under], share[under]), rtol=1e-5)


def check_halve(height: int, width: int) -> None:
    intensity, depth = random_images(height, width, 6)
    small_intensity, small_depth = images.halve(intensity, depth, JUMP_M)
    assert small_depth.shape == (height // 2, width // 2)
    binomial = np.array([1.0, 2.0, 2.0, 1.0])
    padded = np.pad(np.stack([intensity, depth]), ((0, 0), (1, 2), (1, 2)), constant_values=np.nan)
    for v in range(height // 2):
        for u in range(width // 2):
            bright, far = padded[:, 2 * v:2 * v + 4, 2 * u:2 * u + 4].astype(float)
            weight = np.where(np.isnan(bright), 0.0, np.outer(binomial, binomial))
            middle = np.sort(far[1:3, 1:3][far[1:3, 1:3] > 0])
            expected_depth = 0.0
            if len(middle):
                off = np.abs(far - middle[(len(middle) - 1) // 2])
                weight = np.where((far > 0) & (off < JUMP_M), weight * (JUMP_M - off), 0.0)
                expected_depth = np.nansum(weight * far) / weight.sum()
            np.testing.assert_allclose(small_depth[v, u], expected_depth, rtol=1e-5)
            np.testing.assert_allclose(
                small_intensity[v, u], np.nansum(weight * bright) / weight.sum(), atol=1e-5)


def slope(before: float | None, after: float | None, grain: float) -> float:
    if before is None or after is None:
        return (before or 0.0) + (after or 0.0)
    return ((abs(after) + grain) * before + (abs(before) + grain) * after) / (
        abs(before) + abs(after) + 2 * grain)


def check_pack(height: int, width: int) -> None:
    intensity, depth = random_images(height, width, 7)
    packed = images.pack(intensity, depth)
    np.testing.assert_array_equal(packed[..., 0], intensity)
    np.testing.assert_array_equal(packed[..., 1], depth)
    for image, layer, grain in ((intensity, 2, 1e-6), (depth, 4, 0.005)):
        for v, u in np.ndindex(image.shape):
            for axis, (dv, du) in ((0, (0, 1)), (1, (1, 0))):
                steps = []
                for sign in (-1, 1):
                    j, i = v + sign * dv, u + sign * du
                    known = 0 <= j < height and 0 <= i < width
                    known &= layer == 2 or (known and image[j, i] > 0 and image[v, u] > 0)
                    steps.append(sign * (float(image[j, i]) - float(image[v, u])) if known else None)
                np.testing.assert_allclose(packed[v, u, layer + axis], slope(*steps, grain), atol=1e-5)


# ---- clusters -------------------------------------------------------------------------------------------

def check_kmeans(count: int) -> None:
    points = rng(8).normal(size=(count, 3)).astype(np.float32)
    points[:, 2] = np.abs(points[:, 2]) + 0.5
    points[::7] = 0.0
    seeds = points[points[:, 2] > 0][:6].copy()
    real = points[:, 2] > 0

    def labels(centres):
        distance_sq = ((points[:, None].astype(float) - centres) ** 2).sum(axis=-1)
        return np.where(real, distance_sq.argmin(axis=1), -1)

    np.testing.assert_array_equal(kmeans.nearest(points, seeds), labels(seeds))
    centres = seeds.astype(float)
    for _ in range(4):
        label = labels(centres)
        centres = np.array([points[label == k].mean(axis=0, dtype=float) for k in range(6)])
    np.testing.assert_allclose(kmeans.centres(points, seeds, 4, 0.0), centres, atol=1e-5)
    loose = kmeans.centres(points, seeds, 50, 1e3)      # one round, then every step is small enough
    np.testing.assert_array_equal(loose, kmeans.centres(points, seeds, 1, 0.0))


def check_touching(height: int, width: int) -> None:
    world = World(height, width)
    spacing = np.median(np.linalg.norm(np.diff(world.points, axis=1), axis=-1))
    found = kmeans.touching(world.label, world.points, len(world.centres), 1.2 * spacing)
    expected = np.eye(len(world.centres), dtype=bool)
    for shift in ((0, 1), (1, 0)):
        a, b = (np.s_[:height - shift[0], :width - shift[1]], np.s_[shift[0]:, shift[1]:])
        near = np.linalg.norm(world.points[a] - world.points[b], axis=-1) < 1.2 * spacing
        for i, j in zip(world.label[a][near], world.label[b][near], strict=True):
            if i >= 0 and j >= 0:
                expected[i, j] = expected[j, i] = True
    np.testing.assert_array_equal(found, expected)


def blending_twin(world: World, per_m2: float) -> np.ndarray:
    """Weights (H, W, K) of every pixel in every cluster."""
    distance_sq = ((world.points[:, :, None].astype(float) - world.centres) ** 2).sum(axis=-1)
    own_sq = np.take_along_axis(distance_sq, np.maximum(world.label, 0)[..., None], axis=-1)
    exponent = per_m2 * np.abs(own_sq - distance_sq)
    weights = np.where(world.touch[world.label] & (exponent < 6.0), np.exp(-exponent), 0.0)
    return weights / weights.sum(axis=-1, keepdims=True)


def check_membership_and_blending(height: int, width: int) -> None:
    world = World(height, width)
    weights = blending_twin(world, 3.0)
    wanted = np.array([True, False, True, True, False])
    arguments = world.points, world.label, world.centres, world.touch, np.float32(3.0)
    pixels, starts = cluster_images.members(*arguments, 0.2, wanted)
    assert starts[-1] == len(pixels) > 0
    for k in range(5):
        expected = np.flatnonzero((weights[..., k] > 0.2) & (world.label >= 0)) if wanted[k] else []
        np.testing.assert_array_equal(pixels[starts[k]:starts[k + 1]], expected)

    flow = cluster_images.blended_flow(*arguments, rows34(world.motions))
    each = np.stack([pose.apply(motion, world.points.astype(float)) for motion in world.motions], axis=-2)
    expected = (weights[..., None] * (each - world.points[:, :, None])).sum(axis=-2)
    np.testing.assert_allclose(flow, np.where(world.label[..., None] >= 0, expected, 0.0), atol=2e-6)


def check_cluster_residuals(height: int, width: int) -> None:
    world = World(height, width)
    found = cluster_images.residuals(
        world.points, world.source, world.target, world.camera, rows34(world.motion), world.label, 5,
        np.float32(JUMP_M), np.float32(0.2), np.float32(0.3), np.float32(0.05), np.float32(0.3))
    moved, shown, visible = world.seen(world.motion, np.arange(height * width))
    visible, hidden_m = visible.reshape(height, width), (moved[:, 2] - shown[:, 1]).reshape(height, width)
    off = np.abs(shown[:, 0].reshape(height, width) - world.source[..., 0])
    depth = world.source[..., 1].astype(float)
    edge = np.full_like(depth, np.inf)
    edge[1:-1, 1:-1] = sum(np.abs(np.roll(depth, shift, axis)[1:-1, 1:-1] - depth[1:-1, 1:-1])
                           for shift in (-1, 1) for axis in (0, 1))
    counted = visible & (world.label >= 0) & (edge <= 0.3)
    assert counted.sum() > 0.2 * height * width
    weight = np.where(counted, np.clip(2.0 - hidden_m / 0.05, 0.0, 1.0), 0.0)
    for k in range(5):
        own = world.label == k
        expected = [(weight * np.minimum(off, 0.3))[own].sum(),
                    (weight * np.minimum(np.abs(hidden_m), 0.2))[own].sum(), weight[own].sum(), own.sum()]
        np.testing.assert_allclose(found[k], expected, rtol=2e-3, atol=1e-3)


def check_misfits(height: int, width: int) -> None:
    world = World(height, width)
    sets = [np.flatnonzero(world.label == k) for k in range(4)] + [np.empty(0, int)]
    starts = np.concatenate([[0], np.cumsum([len(one) for one in sets])])
    found = cluster_images.misfits(
        world.points, world.source, world.target, world.camera, np.concatenate(sets), starts,
        rows34(world.motions), world.touch, np.float32(JUMP_M), 0.15, np.float32(0.3), np.float32(0.2))
    for k in range(5):
        for j in range(5):
            if not world.touch[k, j] or not len(sets[k]):
                assert np.isinf(found[k, j])
                continue
            moved, shown, visible = world.seen(world.motions[j], sets[k])
            off = np.abs(shown[:, 0] - world.source.reshape(-1, 6)[sets[k], 0])
            each = (0.15 * np.minimum(off, 0.3) + np.minimum(np.abs(shown[:, 1] - moved[:, 2]), 0.2))
            expected = np.where(visible, each, 0.15 * 0.3 + 0.2).mean()
            np.testing.assert_allclose(found[k, j], expected, rtol=2e-3)


# ---- alignment ------------------------------------------------------------------------------------------

def check_seen_again(height: int, width: int) -> None:
    world = World(height, width)
    world.points[:, :width // 4, 2] *= -1.0     # no depth, whatever x and y
    x, y, z = pose.apply(world.motion, world.points[world.points[..., 2] > 0].astype(float)).T
    u = np.floor(world.camera[0] * x / z + world.camera[2] + 0.5).astype(int)
    v = np.floor(world.camera[1] * y / z + world.camera[3] + 0.5).astype(int)
    padded = np.pad(world.target[..., 1], 1)
    expected = padded[np.clip(v + 1, 0, height + 1), np.clip(u + 1, 0, width + 1)] > 0
    assert 0.5 < expected.mean() < 0.99
    found = alignment.seen_again(world.points, world.target, world.camera, rows34(world.motion))
    np.testing.assert_allclose(found, expected.mean(), atol=1.5 / len(expected))
    behind = pose.from_translation(np.array([0.0, 0.0, -9.0]))
    assert alignment.seen_again(world.points, world.target, world.camera, rows34(behind)) == 0.0


def unpacked(system: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Equations (2, 7, P) of a system."""
    return np.concatenate([chunk[:, :, :count] for chunk, count in zip(system, counts, strict=True)], axis=-1)


def linearised(world: World, weights: np.ndarray, weighting: float = 1.0) -> tuple:
    pixels = np.flatnonzero(world.label >= 0)
    return alignment.linearise(
        world.points, world.source, world.target, world.camera, rows34(world.motion), pixels,
        weights[pixels], NOISE, np.float32(weighting), np.float32(JUMP_M))


def check_linearise(height: int, width: int) -> None:
    world = World(height, width)
    weights = rng(9).uniform(0.5, 2.0, height * width).astype(np.float32)
    system, counts, largest = linearised(world, weights)
    pixels = np.flatnonzero(world.label >= 0)
    moved, shown, visible = world.seen(world.motion, pixels)
    assert counts.sum() == visible.sum() > 0.3 * len(pixels)

    here = world.source.reshape(-1, 6)[pixels].astype(float)
    gradient = 0.5 * (shown + here)[:, 2:].reshape(-1, 2, 2)
    residual = np.stack([shown[:, 0] - here[:, 0], shown[:, 1] - moved[:, 2]], axis=1)
    noise = NOISE + (gradient**2).sum(axis=2) + residual**2
    weight = weights[pixels][:, None] / np.sqrt(noise)
    np.testing.assert_allclose(largest, weight[visible].max(axis=0), rtol=2e-3)

    def seen_at(twist):
        x, y, z = pose.apply(pose.exp(twist), moved).T
        return np.stack([world.camera[0] * x / z, world.camera[1] * y / z, z], axis=1)

    step = 1e-5
    for axis, unit in enumerate(np.eye(6)):
        change = (seen_at(step * unit) - seen_at(-step * unit)) / (2 * step)
        along = np.einsum("pkc,pc->pk", gradient, change[:, :2]) - change[:, 2:] * [0.0, 1.0]
        expected = (weight * along)[visible].T
        np.testing.assert_allclose(
            unpacked(system, counts)[:, axis], expected, rtol=5e-3, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(
        unpacked(system, counts)[:, 6], (weight * residual)[visible].T, rtol=5e-3, atol=2e-3)


def irls_twin(equations: np.ndarray, scales: np.ndarray, cauchy_scale: float, rounds: int) -> np.ndarray:
    jacobian = np.concatenate([scale * part[:6].T for scale, part in zip(scales, equations, strict=True)])
    residual = np.concatenate([scale * part[6] for scale, part in zip(scales, equations, strict=True)])
    jacobian, residual, twist = jacobian.astype(float), residual.astype(float), np.zeros(6)
    for _ in range(rounds):
        left = residual + jacobian @ twist
        _, weight = robust.cauchy(left**2, cauchy_scale * np.abs(left).mean())
        normal = jacobian.T @ (weight[:, None] * jacobian)
        normal += 1e-4 * np.trace(normal) / 6 * np.eye(6)
        twist = np.linalg.solve(normal, -jacobian.T @ (weight * residual))
    return twist


def check_solve(height: int, width: int) -> None:
    world = World(height, width)
    system, counts, largest = linearised(world, np.ones(height * width, np.float32))
    scales = np.array([0.15, 1.0]) / largest
    expected = irls_twin(unpacked(system, counts), scales, 0.5, 4)
    assert np.linalg.norm(expected) > 1e-3
    for alone in (False, True):
        found = alignment.solve(system, counts, scales, 0.5, 4, -1e9, 0.0, 1e-4, alone)
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-6)
    np.testing.assert_array_equal(
        found, alignment.solve(system, counts, scales, 0.5, 4, -1e9, 0.0, 1e-4, False))
    at_once = alignment.solve(system, counts, scales, 0.5, 1, 0.0, 0.0, 1e-4, True)
    assert np.linalg.norm(at_once - found) > 0
    assert (alignment.solve(system[:0], counts[:0], scales, 0.5, 4, 0.0, 0.0, 1e-4, False) == 0).all()


def check_solve_each(height: int, width: int) -> None:
    world = World(height, width)
    sets = [np.flatnonzero(world.label == k) for k in range(4)] + [np.empty(0, int)]
    starts = np.concatenate([[0], np.cumsum([len(one) for one in sets])])
    tail = 0.7, 3, -1e9, 0.0, 1e-4
    images_of = world.points, world.source, world.target, world.camera
    twists = alignment.solve_each(*images_of, rows34(world.motions), np.concatenate(sets), starts, NOISE,
                                  np.float32(JUMP_M), 0.15, *tail)
    for k, pixels in enumerate(sets):
        system, counts, largest = alignment.linearise(
            *images_of, rows34(world.motions[k]), pixels, np.ones(len(pixels), np.float32), NOISE,
            np.float32(1.0), np.float32(JUMP_M))
        if counts.sum() == 0:
            assert (twists[k] == 0).all()
            continue
        expected = alignment.solve(system, counts, np.array([0.15, 1.0]) / largest, *tail, False)
        np.testing.assert_allclose(twists[k], expected, rtol=1e-3, atol=1e-6)


def check_solve_positive6(count: int) -> None:
    for seed in range(count):
        root, right = rng(seed).normal(size=(6, 8)), rng(100 + seed).normal(size=6)
        matrix = root @ root.T
        solution = right.copy()
        linalg.solve_positive6(matrix.copy(), solution)
        np.testing.assert_allclose(solution, np.linalg.solve(matrix, right), rtol=1e-6, atol=1e-9)


def check_all_tiny() -> None:
    """Every comparison on tiny inputs, for interpreted kernels."""
    check_resize(13, 17, 4, 6)
    check_halve(9, 13)
    check_pack(6, 8)
    check_kmeans(60)
    check_solve_positive6(2)
    for check in (check_touching, check_membership_and_blending, check_cluster_residuals, check_misfits,
                  check_seen_again, check_linearise, check_solve, check_solve_each):
        check(12, 16)


def test_resize():
    check_resize(48, 64, 24, 32)
    check_resize(45, 61, 17, 23)


def test_halve():
    check_halve(36, 48)
    check_halve(15, 21)


def test_pack():
    check_pack(30, 40)


def test_kmeans():
    check_kmeans(4000)


def test_touching():
    check_touching(30, 40)


def test_membership_and_blending():
    check_membership_and_blending(60, 80)


def test_cluster_residuals():
    check_cluster_residuals(60, 80)


def test_misfits():
    check_misfits(60, 80)


def test_seen_again():
    check_seen_again(60, 80)


def test_linearise():
    check_linearise(60, 80)


def test_solve():
    check_solve(60, 80)


def test_solve_each():
    check_solve_each(60, 80)


def test_solve_positive6():
    check_solve_positive6(20)


def test_kernels_are_plain_python_underneath():
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", "import test_rgbd_kernels; test_rgbd_kernels.check_all_tiny()"],
        cwd=Path(__file__).parent, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
