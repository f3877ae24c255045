"""Refinement: limbs follow the next scan's surface where no single rigid motion does; what stands stays."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial import KDTree
from worlds import grid_edges

from lidarflow import open3d_import, pose, synthetic
from lidarflow.config import Config, RefineConfig, load
from lidarflow.kernels import tree, triangles
from lidarflow.lidar import frontend, limbs, mesh, refinement
from lidarflow.pipeline import estimate_flow
from lidarflow.solve import solve
from lidarflow.synthetic.human_motion import LIMBS
from lidarflow.types import FlowProblem, ScanPair, Truth

LEFT_FOREARM, RIGHT_FOREARM = LIMBS.index("left forearm"), LIMBS.index("right forearm")


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


# ---- which things -----------------------------------------------------------------------------------------

def patches(*places_and_widths: tuple[float, float]) -> FlowProblem:
    """Upright 4 x 4 patches of variables, (range in metres, width in metres) each, a component apiece."""
    points, edges, component = [], [], []
    for k, (range_m, width_m) in enumerate(places_and_widths):
        y, z = np.meshgrid(np.linspace(0, width_m, 4), np.linspace(0, 1, 4))
        points.append(np.column_stack([np.full(16, range_m), y.ravel(), z.ravel()]))
        edges.append(grid_edges(4, 4) + 16 * k)
        component.append(np.full(16, k, np.int32))
    points = np.concatenate(points)
    return FlowProblem(points, pose.identity(len(points)), np.empty(0, np.int32), np.empty((0, 3)),
                       np.concatenate(edges).astype(np.int32), np.concatenate(component))


def test_what_is_near_and_no_larger_than_a_person_is_refined():
    problem = patches((8.0, 1.0), (8.0, 3.0), (13.0, 1.0), (8.0, 2.4))
    kept = refinement.wanted(problem, RefineConfig())
    np.testing.assert_array_equal(kept, np.repeat([True, False, False, True], 16))


def test_no_rounds_refine_nothing_and_an_empty_graph_has_nothing_to_refine():
    assert not refinement.wanted(patches((8.0, 1.0)), RefineConfig(rounds=0)).any()
    empty = FlowProblem(np.empty((0, 3)), np.empty((0, 4, 4)), np.empty(0, np.int32), np.empty((0, 3)),
                        np.empty((0, 2), np.int32), np.empty(0, np.int32))
    assert len(refinement.wanted(empty, RefineConfig())) == 0


def scene_of(problem: FlowProblem, target: np.ndarray) -> limbs.Scene:
    """A source whose points are all variables, and a target (N, 3) without ground or triangles."""
    count, config = len(problem.points), Config()
    no_triangles = mesh.Mesh(
        np.empty((0, 3), np.int32), np.empty((0, 2), np.int32), np.arange(len(target)), "grid")
    graph = frontend.Graph(problem, np.arange(count, dtype=np.int32), np.arange(count))
    return limbs.Scene(
        graph, refinement.wanted(problem, config.refine), target, np.arange(len(target)), tree.build(target),
        no_triangles, partial(solve, min_matches=config.graph.min_matches), config)


def motions_of(parts: list[limbs.Part], count: int) -> np.ndarray:
    """Motions (count, 4, 4) of the points of all parts, none of which share any; NaN where none has one."""
    motions = np.full((count, 4, 4), np.nan)
    for part in parts:
        rows = np.flatnonzero(part.graph.variable >= 0)
        assert np.isnan(motions[rows]).all()
        motions[rows] = part.motions[part.graph.variable[rows]]
    return motions


def test_what_objects_touch_is_refined_with_them_and_the_rest_as_part_of_the_world():
    """A post, a person, and a car's fragment: the first two wave something, the last is rigid."""
    problem = patches((8.0, 1.0), (9.0, 1.0), (7.0, 1.0))
    by_object = np.stack([pose.from_translation([0.0, 0.4, 0.0]), pose.from_translation([0.0, 1.5, 0.0])])
    owner = np.repeat([-1, 0, 1], 16)
    owner[16:24] = -1      # a component is touched where some of it is on an object
    target = problem.points.copy()
    target[owner == 0] += [0.0, 0.4, 0.0]
    upper = problem.points[:, 2] > 0.9
    target[upper, 0] += 0.1
    scene, ego_motion = scene_of(problem, target), np.eye(4)
    touched = frontend.touched(scene.graph, owner)
    np.testing.assert_array_equal(touched, np.repeat([False, True, True], 16))
    solved = limbs.Part(
        replace(scene.graph, variable=np.full(48, -1, np.int32)), np.empty((0, 4, 4)), np.empty(0, bool))

    def with_objects(touched: np.ndarray) -> limbs.Part:
        return limbs.of_objects(
            scene, touched, solved, owner, by_object, np.array([False, True]), ego_motion)

    world = limbs.of_world(scene, ego_motion)
    assert (world.graph.variable >= 0).all()
    motions = motions_of([limbs.apart_from(world, scene.graph, touched), with_objects(touched)], 48)
    np.testing.assert_array_equal(np.isnan(motions[:, 0, 0]), np.repeat([False, False, True], 16))
    np.testing.assert_array_equal(motions, motions_of([with_objects(np.ones(48, bool))], 48))
    moved = pose.apply(motions[:32], problem.points[:32]) - problem.points[:32]
    lower = problem.points[:16, 2] < 0.5
    assert (moved[:16][upper[:16], 0] > 0.06).all() and (np.abs(moved[:16][lower, 0]) < 0.02).all()
    assert np.median(moved[24:32, 1]) > 0.3


def test_limbs_begin_at_what_was_solved():
    problem = patches((8.0, 1.0))
    scene = replace(scene_of(problem, problem.points), config=load(overrides=("refine.rounds=0",)))
    start = np.broadcast_to(pose.from_translation([0.0, 0.0, 0.2]), (16, 4, 4))
    solved = limbs.Part(scene.graph, start, np.ones(16, bool))
    found = limbs.of_objects(
        scene, np.ones(16, bool), solved, np.full(16, -1), np.empty((0, 4, 4)), np.empty(0, bool), np.eye(4))
    np.testing.assert_array_equal(found.motions, start)
    assert not found.solved.any()


def test_what_the_next_scan_does_not_show_is_not_solved():
    problem = patches((8.0, 1.0), (9.0, 1.0))
    scene = scene_of(problem, problem.points[:16])
    found = limbs.of_world(scene, np.eye(4))
    np.testing.assert_array_equal(found.solved, np.repeat([True, False], 16))
    np.testing.assert_array_equal(found.motions[16:], problem.initial[16:])


# ---- where the surface is ---------------------------------------------------------------------------------

def test_the_nearest_place_lies_within_a_triangle_and_else_on_a_point():
    points = np.array([[5.0, 0.0, 0.0], [5.0, 1.0, 0.0], [5.0, 0.0, 1.0], [5.0, 3.0, 0.0], [5.0, 0.0, 9.0]])
    one_triangle = mesh.Mesh(np.array([[0, 1, 2]], np.int32), np.array([[0, 1], [0, 2], [1, 2]], np.int32),
                             np.array([0, 0, 0, 1, 2], np.int32), "grid")
    surface = refinement.Surface.around(
        points[:4], 1.5, points, np.arange(5), tree.build(points), one_triangle)
    asked = np.array([[5.2, 0.25, 0.25], [4.9, 2.9, 0.1], [5.1, -0.3, 0.5]])
    np.testing.assert_allclose(
        surface.nearest(asked, 0.5), [[5.0, 0.25, 0.25], [5.0, 3.0, 0.0], [5.0, 0.0, 0.5]], atol=1e-12)
    assert np.isnan(surface.nearest(asked, 0.1)).all()
    no_triangles = mesh.Mesh(np.empty((0, 3), np.int32), np.empty((0, 2), np.int32), np.arange(5), "grid")
    others = np.array([0, 2, 3, 4])
    bare = refinement.Surface.around(
        points[:4], 1.5, points, others, tree.build(points[others]), no_triangles)
    np.testing.assert_allclose(bare.nearest(asked[:1], 0.5), [[5.0, 0.0, 0.0]])


def test_places_out_of_reach_say_nothing():
    problem = patches((8.0, 1.0))
    points = problem.points + [0.1, 0.0, 0.0]
    points[problem.points[:, 2] > 0.9, 0] += 1.0
    no_triangles = mesh.Mesh(np.empty((0, 3), np.int32), np.empty((0, 2), np.int32), np.arange(16), "grid")
    surface = refinement.Surface.around(
        problem.points, 1.5, points, np.arange(16), tree.build(points), no_triangles)
    matched = refinement.rematched(problem, problem.initial, surface, 0.3)
    np.testing.assert_array_equal(matched.match_index, np.flatnonzero(problem.points[:, 2] < 0.9))
    np.testing.assert_allclose(matched.match_target, points[matched.match_index])


def test_a_scan_without_a_point_upright_says_nothing():
    problem = patches((8.0, 1.0))
    no_triangles = mesh.Mesh(np.empty((0, 3), np.int32), np.empty((0, 2), np.int32), np.arange(4), "grid")
    ground = np.array([[8.0, y, -1.7] for y in range(4)])
    surface = refinement.Surface.around(
        problem.points, 1.5, ground, np.empty(0, np.int64), tree.build(np.empty((0, 3))), no_triangles)
    assert len(refinement.rematched(problem, problem.initial, surface, 0.3).match_index) == 0


def test_the_nearest_place_on_triangles_is_the_nearest_of_a_fine_sampling_and_what_is_lone_counts_too():
    generator = rng(5)
    corners = generator.uniform(-1.0, 1.0, (40, 1, 3)) + generator.normal(0.0, 0.2, (40, 3, 3))
    corners[0, 2] = corners[0, 1]                   # triangles without an area
    corners[2, 1], corners[3, 2], corners[4, 1:] = corners[2, 0], corners[3, 0], corners[4, 0]
    lone = generator.uniform(-1.5, 1.5, (30, 3))
    asked = generator.uniform(-1.5, 1.5, (700, 3))   # more than one thread's share
    shares = np.array([(i, j, 60 - i - j) for i in range(61) for j in range(61 - i)]) / 60.0
    sampled = np.concatenate([np.einsum("sk,tkd->tsd", shares, corners).reshape(-1, 3), lone])
    sampled_m, _ = KDTree(sampled).query(asked)

    places = triangles.nearest(triangles.build(corners), tree.build(lone), asked, 0.6)
    apart_m = np.linalg.norm(places - asked, axis=1)
    found = np.isfinite(apart_m)
    assert 300 < found.sum() < 700
    np.testing.assert_array_equal(found, np.where(np.abs(sampled_m - 0.6) < 0.01, found, sampled_m < 0.6))
    assert (apart_m[found] <= sampled_m[found] + 1e-9).all()
    assert (apart_m[found] > sampled_m[found] - 0.015).all()
    on_surface_m, _ = KDTree(sampled).query(places[found])
    assert on_surface_m.max() < 0.015

    flat = np.cross(corners[1, 1] - corners[1, 0], corners[1, 2] - corners[1, 0])
    within = corners[1].mean(axis=0)
    above = within + 0.1 * flat / np.linalg.norm(flat)
    alone = triangles.nearest(triangles.build(corners[1:2]), tree.NOTHING, above[None], 0.6)
    np.testing.assert_allclose(alone, within[None], atol=1e-12)
    assert np.isnan(triangles.nearest(triangles.build(corners[:0]), tree.NOTHING, above[None], 0.6)).all()


# ---- people -----------------------------------------------------------------------------------------------

def person_pair(name: str, seed: int) -> tuple[ScanPair, Truth, np.ndarray]:
    """Two scans 0.3 s apart of a person 7 m away, the truth, and the person's points in the second one."""
    generator = rng(seed)
    scene = synthetic.human_motion(name, generator, 7.0)
    (source, truth), (target, next_truth), _ = synthetic.scan_sequence(
        scene, synthetic.hdl32e(columns=2170), 3, generator, 0.3)
    return ScanPair(source, target), truth, target.points[next_truth.object_id >= 0]


def by_icp(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Flow (N, 3) of the best single motion that point-to-point ICP finds."""
    o3d = open3d_import.open3d()
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud)) for cloud in (points, target)]
    motion = np.eye(4)
    for gate_m in (1.0, 0.5, 0.25):
        motion = o3d.pipelines.registration.registration_icp(*clouds, gate_m, motion).transformation
    return pose.apply(np.array(motion), points) - points


@pytest.mark.parametrize("name", ["arms_up_down", "arms_backwards", "bend_sidewards", "bend_forward"])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_moving_person_is_followed_better_than_by_one_motion_and_than_by_none(name, seed):
    pair, truth, target = person_pair(name, seed)
    person = truth.object_id >= 0
    points, flow = pair.source.points[person], truth.flow[person]

    def error_m(found: np.ndarray) -> float:
        return float(np.linalg.norm(found - flow, axis=1).mean())

    ours = error_m(estimate_flow(pair).flow[person])
    assert ours < error_m(by_icp(points, target))
    assert ours < max(0.8 * error_m(np.zeros_like(flow)), 0.01)


def test_one_arm_is_followed_upwards_and_the_other_downwards():
    pair, truth, _ = person_pair("arms_up_down", 0)
    flow = estimate_flow(pair).flow
    for limb, sign in ((LEFT_FOREARM, 1.0), (RIGHT_FOREARM, -1.0)):
        on_limb = truth.object_id == limb
        assert on_limb.sum() >= 8
        true, found = truth.flow[on_limb].mean(axis=0), flow[on_limb].mean(axis=0)
        assert sign * true[2] > 0.1 and sign * found[2] > 0.6 * abs(true[2])
        assert np.linalg.norm(flow[on_limb] - truth.flow[on_limb], axis=1).mean() < 0.1
    legs = truth.object_id == LIMBS.index("legs")
    assert np.linalg.norm(flow[legs], axis=1).mean() < 0.01


def test_a_room_stays_as_it_is():
    """Refinement may move nothing that stands: noise is not a limb."""
    scans = synthetic.scan_sequence(synthetic.room(rng(3)), synthetic.hdl64e(400), 2, rng(4))
    pair, truth = ScanPair(scans[0][0], scans[1][0]), scans[0][1]
    by_rounds = [estimate_flow(pair, load(overrides=(f"refine.rounds={n}",))) for n in (0, 2)]
    assert by_rounds[1].in_graph.sum() > by_rounds[0].in_graph.sum() + 500
    error_m = [np.linalg.norm(r.flow - truth.flow, axis=1)[truth.valid].mean() for r in by_rounds]
    assert error_m[1] < error_m[0] + 0.003


def test_the_solver_keeps_its_other_settings():
    config = replace(Config().solver, smoothness_weight=7.0)
    limits = RefineConfig(data_weight=2.0, reach_m=0.2)
    found = refinement.solver(config, limits)
    assert (found.smoothness_weight, found.data_weight, found.truncation_m) == (7.0, 2.0, 0.2)
