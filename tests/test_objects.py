"""Moving objects: the evidence for them, their fit, and what is found in generated scenes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shared_data import SHARED, needs_shared

from lidarflow import pose, synthetic
from lidarflow.config import ObjectsConfig
from lidarflow.datasets import open_dataset
from lidarflow.kernels import grid, ground_plane, icp, links, tree
from lidarflow.lidar import acceptance, evidence, frontend, hypotheses, objects, rigid_fit, seeds
from lidarflow.lidar import body as body_of
from lidarflow.lidar import view as view_of_pair
from lidarflow.lidar.body import Body
from lidarflow.lidar.surface import MIN_AGREEMENT, Cloud, Surface
from lidarflow.pipeline import FlowEstimator, estimate_flow, run
from lidarflow.types import FlowProblem, ScanPair

CONFIG = ObjectsConfig()


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def box_surface(count: int, seed: int) -> np.ndarray:
    """Points (count, 3) on the sides of a 4 x 2 x 1.5 m box at the origin."""
    random = rng(seed)
    points = random.uniform(-0.5, 0.5, (count, 3))
    axis = random.integers(0, 2, count)
    points[np.arange(count), axis] = random.choice([-0.5, 0.5], count)
    return points * [4.0, 2.0, 1.5]


def test_points_link_up_to_the_distance_and_not_beyond():
    row = np.column_stack([np.arange(0, 4, 0.1), np.zeros(40), np.zeros(40)])
    label = links.components(np.concatenate([row, row + [0, 1.5, 0]]), 0.5)
    assert len(np.unique(label[:40])) == len(np.unique(label[40:])) == 1
    assert label[0] != label[-1]
    assert len(links.components(np.empty((0, 3)), 0.5)) == 0


@pytest.mark.parametrize("turn", [-0.08, 0.0, 0.05])
def test_a_rigid_fit_finds_turn_and_shift(turn):
    truth = pose.from_translation([8.4, 3.1, 0.02]) @ pose.from_yaw(turn) @ pose.from_translation([-8, -3, 0])
    source = box_surface(800, 1) + [8.0, 3.0, 0.0]
    target = pose.apply(truth, box_surface(4000, 2) + [8.0, 3.0, 0.0])
    found, = rigid_fit.onto([source], [(0, np.array([0.3, 0.2, 0.0]))], tree.build(target))
    off_m = (pose.apply(found, source) - pose.apply(truth, source))[:, :2]   # sides say nothing of height
    assert np.linalg.norm(off_m, axis=1).mean() < 0.01


def test_a_rigid_fit_without_counterparts_keeps_its_start():
    far = tree.build(np.array([[90.0, 0, 0]]))
    found, = rigid_fit.onto([box_surface(50, 3)], [(0, np.array([0.3, 0.2, 0.1]))], far)
    np.testing.assert_allclose(found, pose.from_translation([0.3, 0.2, 0.1]), atol=1e-12)


def cloud(upright: np.ndarray, ground: np.ndarray, normal_radius_m: float) -> Cloud:
    return Cloud(Surface.of(upright, 0.12, normal_radius_m), tree.build(ground))


def wall(x: float, seed: int) -> np.ndarray:
    """Points (4000, 3) of a wall across the line of sight, `x` metres ahead."""
    random = rng(seed)
    return np.column_stack([np.full(4000, x), random.uniform(-3, 3, 4000), random.uniform(-2, 2, 4000)])


def test_evidence_tells_what_is_gone_from_what_is_out_of_view():
    still, gone, beside = wall(10.0, 1), np.array([[6.0, 0.0, 0.0]]), np.array([[0.0, 10.0, 0.0]])
    points, other = np.concatenate([gone, beside, still]), wall(10.0, 2)
    left_m, _ = cKDTree(other).query(points)
    tolerance_m = evidence.tolerance(np.linalg.norm(points, axis=1), CONFIG)
    found = evidence.gather(points, left_m, tolerance_m, other)
    assert found.unexplained[0] and not found.blind[0], "the sensor looks through where it was"
    assert found.blind[1] and not found.unexplained[1], "nothing was looked at there"
    assert not found.blind[2:].any() and found.unexplained[2:].mean() < 0.05
    assert (left_m[2:][~found.unexplained[2:]] <= evidence.tolerance(np.array(12.0), CONFIG)).all()


def test_an_object_is_described_along_its_way():
    truth = pose.from_yaw(0.6, (10.0, 4.0, 0.0))
    points = pose.apply(truth, box_surface(2000, 4))
    along = truth[:3, :3] @ [0.5, 0.0, 0.0]
    ego_motion = pose.from_yaw(0.02, (-0.7, 0.0, 0.0))
    found = objects.describe(3, points, ego_motion @ pose.from_translation(along), ego_motion, 0.1)
    assert found.id == 3 and found.points == 2000 and found.box_yaw == pytest.approx(0.6, abs=0.01)
    np.testing.assert_allclose(found.box_size, [4.0, 2.0, 1.5], atol=0.1)
    np.testing.assert_allclose(found.box_centre, [10.0, 4.0, 0.0], atol=0.05)
    assert np.linalg.norm(found.velocity) == pytest.approx(5.0, abs=0.01)


def test_only_components_with_an_object_stay_in_the_graph():
    points = rng(5).normal(size=(6, 3))
    problem = FlowProblem(
        points=points, initial=pose.identity(6), match_index=np.array([0, 2, 4], np.int32),
        match_target=points[[0, 2, 4]] + 1.0, edges=np.array([[0, 1], [2, 3], [4, 5]], np.int32),
        component=np.array([0, 0, 1, 1, 2, 2], np.int32))
    variable = np.array([-1, 0, 1, 2, 3, 4, 5, -1], np.int32)
    object_id = np.array([-1, -1, -1, 0, -1, -1, -1, 0], np.int32)   # scan row 3 is variable 2
    car, ego_motion = pose.from_translation([[1.0, 0, 0]]), pose.from_yaw(0.1)
    graph = frontend.focused(frontend.Graph(problem, variable, np.arange(1, 7)), object_id, car, ego_motion)
    np.testing.assert_array_equal(graph.variable, [-1, -1, -1, 0, 1, -1, -1, -1])
    np.testing.assert_array_equal(graph.rows, [3, 4])
    np.testing.assert_array_equal(graph.problem.points, points[2:4])
    np.testing.assert_array_equal(graph.problem.edges, [[0, 1]])
    np.testing.assert_array_equal(graph.problem.match_target, points[[2]] + 1.0)
    np.testing.assert_array_equal(graph.problem.group_motions[graph.problem.group], [car[0], ego_motion])
    np.testing.assert_array_equal(graph.problem.initial, [car[0], ego_motion])


def street_pair(columns: int) -> tuple[ScanPair, object]:
    scans = synthetic.scan_sequence(synthetic.street(rng(1)), synthetic.hdl64e(columns), 2, rng(2))
    return ScanPair(scans[0][0], scans[1][0]), scans[0][1]


def test_objects_of_a_street_move_as_they_should():
    pair, truth = street_pair(1200)
    result = estimate_flow(pair)
    error_m = np.linalg.norm(result.flow - truth.flow, axis=1)
    still = ~truth.is_dynamic
    assert error_m[still].mean() < 0.01
    assert result.is_dynamic[still].mean() < 0.003
    for car in np.unique(truth.object_id[truth.is_dynamic]):
        on_car = (truth.object_id == car) & truth.is_dynamic
        if on_car.sum() > 600:
            assert result.is_dynamic[on_car].mean() > 0.85, f"object {car}"
            assert np.median(error_m[on_car]) < 0.05, f"object {car}"
    np.testing.assert_array_equal(result.object_id >= 0, result.is_dynamic)
    assert [found.id for found in result.objects] == list(range(len(result.objects)))
    for found in result.objects:
        assert found.points == (result.object_id == found.id).sum()


def test_nothing_moves_in_a_static_yard():
    scans = synthetic.scan_sequence(synthetic.room(rng(3)), synthetic.hdl64e(900), 2, rng(4))
    result = estimate_flow(ScanPair(scans[0][0], scans[1][0]))
    assert result.objects == () and not result.is_dynamic.any()
    assert np.linalg.norm(result.flow - scans[0][1].flow, axis=1).mean() < 0.01


def onto_planes(source: Surface, target: Surface, turn: float, shift: list[float]) -> np.ndarray:
    """The motion (4, 4) that growth fits to a whole surface on level ground."""
    return icp.onto_planes(
        source.points, source.normals, target.tree, target.normals, turn, np.array(shift),
        rigid_fit.PLANE_GATES_M, np.array([0.0, 0.0, 1.0]), 1.0, rigid_fit.PLANE_SCALE_M,
        rigid_fit.POINT_SCALE_M, rigid_fit.POINT_WEIGHT, MIN_AGREEMENT)


def test_the_ground_tells_which_way_a_fit_may_go():
    hood = np.stack(np.meshgrid(np.linspace(0, 1.5, 40), np.linspace(-0.8, 0.8, 30)), axis=-1).reshape(-1, 2)
    hood = np.column_stack([hood + [8.0, 0.0], 0.15 * hood[:, 0]])   # 15 % slope, so that x and z trade
    front = wall(9.5, 7)[:600] * [1.0, 0.25, 0.1] + [0.0, 0.0, 0.6]
    body = np.concatenate([hood, front])
    truth = pose.from_translation([0.5, 0.0, 0.0])
    target = Surface.of(pose.apply(truth, body) + rng(8).normal(0, 0.004, body.shape), 0.12, 0.5)
    source = Surface.of(body, 0.12, 0.5)
    found = onto_planes(source, target, 0.0, [0.35, 0.0, 0.05])
    np.testing.assert_allclose(found[:3, 3], [0.5, 0.0, 0.0], atol=0.02)


def rings_on_hood(shift_m: float) -> np.ndarray:
    """Returns (N, 3) of rings that stand still on a sloped hood that has moved along x by `shift_m`."""
    x, y = np.meshgrid(np.arange(8.0, 9.4, 0.28), np.linspace(-0.8, 0.8, 60))
    height = 0.5 - 0.4 * (x - shift_m - 8.0)
    return np.column_stack([x.ravel(), y.ravel(), height.ravel()])


def test_planes_are_not_carried_along_by_rings():
    source, target = Surface.of(rings_on_hood(0.0), 0.12, 0.6), Surface.of(rings_on_hood(0.2), 0.12, 0.6)
    by_points, = rigid_fit.onto([source.points], [(0, np.array([0.1, 0.0, 0.0]))], target.tree)
    by_planes = onto_planes(source, target, 0.0, [0.1, 0.0, 0.0])
    moved = pose.apply(by_planes, source.points) - source.points
    np.testing.assert_allclose(moved.mean(axis=0), [0.2, 0.0, 0.0], atol=0.03)
    assert abs(by_points[0, 3] - 0.2) > 0.1, "nearest points follow the rings"


def look(source: Cloud, target: Cloud, matched: np.ndarray, moved: np.ndarray) -> view_of_pair.View:
    def matches(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        asked = np.isin(matched, rows)
        return matched[asked], moved[asked]

    return replace(view_of_pair.look(source, target, CONFIG), matches=matches)


def scene(car_shift: np.ndarray, seed: int) -> view_of_pair.View:
    """A view of a box 9 m ahead that moves by `car_shift`, and a wall at 14 m."""
    random = rng(seed)

    def returns(car: np.ndarray) -> np.ndarray:
        box = box_surface(1500, int(random.integers(1 << 30))) + [9.0, 0.0, 0.0] + car
        background = wall(14.0, int(random.integers(1 << 30))) * [1.0, 2.0, 0.5]
        both = np.concatenate([box[box[:, 0] < 9.0 + car[0]], background])
        return both + random.normal(0.0, 0.01, both.shape)

    source, target = returns(np.zeros(3)), returns(car_shift)
    ground = np.column_stack([random.uniform(2, 16, 4000), random.uniform(-6, 6, 4000), np.full(4000, -0.8)])
    matched = np.arange(0, len(source), 20)
    moved = source[matched] + np.where(source[matched, :1] < 13.0, car_shift, 0.0)
    return look(cloud(source, ground, 0.5), cloud(target, ground, 0.5), matched, moved)


@pytest.mark.parametrize("shift_m", [0.08, 0.15, 0.6, 1.4])
def test_slow_and_fast_bodies_are_found(shift_m):
    view = scene(np.array([shift_m, 0.0, 0.0]), 11)
    body, = objects.find(view, seeds.find(view, tree.NOTHING, CONFIG), 0.1, CONFIG)
    on_box = view.points[:, 0] < 12.0
    assert on_box[body.rows].all() and len(body.rows) > 0.9 * on_box.sum()
    off_m = pose.apply(body.over_ground, view.points[body.rows]) - view.points[body.rows] - [shift_m, 0, 0]
    assert np.linalg.norm(off_m, axis=1).mean() < 0.03


def test_a_still_scene_has_no_body():
    view = scene(np.zeros(3), 12)
    assert objects.find(view, seeds.find(view, tree.NOTHING, CONFIG), 0.1, CONFIG) == []


def test_a_wall_is_not_believed_to_slide_along_itself():
    view = scene(np.zeros(3), 13)
    rows = np.flatnonzero(view.points[:, 0] > 12.0)
    sliding = Body(rows, pose.from_translation([0.0, 0.5, 0.0]))
    assert not acceptance.moves(view, sliding, 0.1, CONFIG)


def expected_at(view: view_of_pair.View, rows: np.ndarray, shift: list[float]) -> hypotheses.Expected:
    """An object expected where `rows` of a view are, to move over ground by `shift`."""
    return hypotheses.Expected(
        tree.build(view.points[rows]), np.zeros(len(rows), np.int64), np.array([shift], float))


def test_a_side_that_slides_is_believed_where_it_goes_on_as_before():
    view = scene(np.array([0.0, 0.8, 0.0]), 14)
    side, wall_rows = np.flatnonzero(view.points[:, 0] < 7.05), np.flatnonzero(view.points[:, 0] > 12.0)
    sliding = Body(side, pose.from_translation([0.0, 0.8, 0.0]))
    strict = replace(CONFIG, min_observability=0.1)     # some normals at its edges face the motion
    assert acceptance.moves(view, sliding, 0.1, replace(CONFIG, min_observability=0.0))
    assert not acceptance.moves(view, sliding, 0.1, strict)
    assert acceptance.moves(view, sliding, 0.1, strict, expected_at(view, side, [0.0, 0.7, 0.0]))
    for rows, shift in ((side, [0.0, 0.4, 0.0]), (side, [0.8, 0.0, 0.0]), (wall_rows, [0.0, 0.8, 0.0])):
        assert not acceptance.moves(view, sliding, 0.1, strict, expected_at(view, rows, shift))


def test_a_wall_does_not_slide_on_because_an_object_did():
    view = scene(np.zeros(3), 13)
    rows = np.flatnonzero(view.points[:, 0] > 12.0)
    sliding = Body(rows, pose.from_translation([0.0, 0.5, 0.0]))
    assert not acceptance.moves(view, sliding, 0.1, CONFIG, expected_at(view, rows, [0.0, 0.5, 0.0]))


def test_leaves_that_hang_are_no_body():
    view = scene(np.array([0.6, 0.0, 0.0]), 16)
    rows = np.flatnonzero(view.points[:, 0] < 12.0)
    shift = pose.from_translation([0.6, 0.0, 0.0])
    assert acceptance.moves(view, Body(rows, shift), 0.1, CONFIG)
    assert not acceptance.moves(view, Body(rows, shift), 0.1, replace(CONFIG, max_clearance_m=0.01))


def test_what_the_surroundings_do_too_is_not_a_body():
    shift = np.array([0.0, 0.12, 0.0])
    random = rng(17)
    box = box_surface(6000, 18) * [3.0, 0.3, 2.0] + [12.0, 0.0, 0.0]
    source = box + random.normal(0, 0.004, box.shape)
    target = box_surface(6000, 19) * [3.0, 0.3, 2.0] + [12.0, 0.0, 0.0] + shift
    matched = np.arange(0, len(source), 10)
    nothing = np.empty((0, 3))
    view = look(cloud(source, nothing, 0.4), cloud(target, nothing, 0.4), matched, source[matched] + shift)
    part = np.flatnonzero(np.abs(view.points[:, 0] - 12.0) < 0.8)
    body = Body(part, pose.from_translation(shift))
    assert acceptance._surroundings_gain(view, body, shift)
    assert not acceptance.moves(view, body, 0.1, CONFIG)


def grown_twin(view: view_of_pair.View, seed: np.ndarray, start: np.ndarray, free: np.ndarray) -> Body | None:
    """Growth step by step."""
    near, motion, body = seed, start, seed
    looked = np.zeros(len(view.points), bool)
    for step in range(5):
        reach_m = 1.0 if step == 0 else 0.7
        apart_m, _ = cKDTree(view.points[body]).query(view.points)
        if not (looked | (apart_m < reach_m)).sum() > looked.sum():
            break
        looked |= apart_m < reach_m
        near = np.flatnonzero(looked & free)
        after, ego = view.after(near, motion), view.by_ego[near]
        fits = after.distance_m <= view.tolerance_m[near]
        better = after.distance_m < ego.distance_m - 0.02
        plane_better = fits & (after.plane_m < ego.plane_m - 0.03)
        as_good = (fits & (after.distance_m < ego.distance_m + 0.03)
                   & (after.plane_m < ego.plane_m + 0.02))
        plane_worse = (after.plane_m > ego.plane_m + 0.03) & ~better
        body = near[(better | plane_better | as_good) & ~plane_worse]
        label = links.components(view.points[body], 0.5)
        body = body[np.isin(label, label[np.isin(body, seed)])]
        if len(body) < CONFIG.min_points:
            return None
        thinned = body[grid.first_per_voxel(view.points[body], 0.12)] if len(body) > 40 else body
        points = view.points[thinned]
        centre, turn = points.mean(axis=0), np.arctan2(motion[1, 0], motion[0, 0])
        rise_x, rise_y, count = ground_plane.slope(view.ground, centre, 5.0)
        up = np.array([-rise_x, -rise_y, 1.0])
        if count < 20 or np.hypot(rise_x, rise_y) > 0.2:
            up = np.array([0.0, 0.0, 1.0])
        motion = icp.onto_planes(
            points, view.source.normals[thinned], view.upright.tree, view.upright.normals, turn,
            pose.apply(motion, centre) - centre, rigid_fit.PLANE_GATES_M, up / np.linalg.norm(up),
            CONFIG.along_ground, 0.05, 0.15, 0.05, MIN_AGREEMENT)
        if (view.after(body, motion).plane_m**2).sum() > 0.55 * (view.by_ego.plane_m[body]**2).sum():
            return None
    return Body(body, motion)


def test_bodies_grow_step_by_step_and_each_as_if_alone():
    view = scene(np.array([0.6, 0.0, 0.0]), 14)
    on_box = np.flatnonzero(view.points[:, 0] < 12.0)
    seeds = [on_box[::9], on_box[5:6], np.flatnonzero(view.points[:, 0] > 13.0)[:40]]
    starts = [pose.from_translation(shift) for shift in ([0.55, 0.03, 0.0], [0.6, 0.0, 0.0], [0.6, 0.0, 0.0])]
    free = np.ones(len(view.points), bool)
    free[on_box[:100]] = False
    found = body_of.grown(view, seeds, starts, free, 0.0, CONFIG)
    for seed, start, growth in zip(seeds, starts, found, strict=True):
        alone, = body_of.grown(view, [seed], [start], free, 0.0, CONFIG)
        expected = grown_twin(view, seed, start, free)
        np.testing.assert_array_equal(growth.asked, alone.asked)
        assert (growth.body is None) == (expected is None) == (alone.body is None)
        if expected is not None:
            np.testing.assert_array_equal(growth.body.rows, expected.rows)
            np.testing.assert_allclose(growth.body.over_ground, expected.over_ground, atol=1e-9)
            assert growth.asked[growth.body.rows].all() and free[growth.body.rows].all()
    least_m = np.linalg.norm(found[0].body.over_ground[:2, 3])
    slower, = body_of.grown(view, seeds[:1], starts[:1], free, least_m - 0.01, CONFIG)
    np.testing.assert_array_equal(slower.body.rows, found[0].body.rows)
    given_up, = body_of.grown(view, seeds[:1], starts[:1], free, least_m + 0.01, CONFIG)
    assert given_up.body is None and given_up.asked.any()
    assert found[0].body is not None and len(found[0].body.rows) > 0.8 * (len(on_box) - 100)


def test_a_body_whose_shape_gains_little_is_given_up_as_it_grows(monkeypatch):
    view = scene(np.array([0.6, 0.0, 0.0]), 14)
    seeds, start = np.flatnonzero(view.points[:, 0] < 12.0)[::9], pose.from_translation([0.6, 0.0, 0.0])
    free = np.ones(len(view.points), bool)

    def grow(config: ObjectsConfig) -> body_of.Growth:
        return body_of.grown(view, [seeds], [start], free, 0.0, config)[0]

    whole = grow(CONFIG)
    after, at_rest = view.after(whole.body.rows, whole.body.over_ground), view.by_ego[whole.body.rows]
    left = (after.plane_m**2).sum() / (at_rest.plane_m**2).sum()
    assert left < 0.2
    strict = replace(CONFIG, max_shape_ratio=0.0)
    monkeypatch.setattr(body_of, "_MOST_LEFT", 0.1 * left)
    given_up = grow(strict)
    assert given_up.body is None and 0 < given_up.asked.sum() <= whole.asked.sum()
    # What the settings would accept is not given up before.
    assert grow(replace(CONFIG, max_shape_ratio=0.5)).body is not None


def test_a_body_is_completed_by_what_it_surrounds_and_what_follows_it():
    view = scene(np.array([0.6, 0.0, 0.0]), 14)
    rows = np.flatnonzero(view.points[:, 0] < 12.0)
    kept = rows[rng(15).random(len(rows)) < 0.7]
    nowhere, everywhere = np.zeros((2, len(view.points)), bool)
    everywhere[:] = True
    growth = body_of.Growth(Body(kept, pose.from_translation([0.6, 0.0, 0.0])), nowhere)
    whole = body_of.completed(view, growth, everywhere)
    assert len(whole.body.rows) > 0.98 * len(rows) and np.isin(whole.body.rows, rows).all()
    assert whole.asked[whole.body.rows].all() and not nowhere.any()
    # Of what it depends on, nothing else is looked at: what lies apart may be taken.
    again = body_of.completed(view, growth, whole.asked)
    np.testing.assert_array_equal(again.body.rows, whole.body.rows)
    taken = everywhere.copy()
    taken[np.setdiff1d(rows, kept)] = False
    np.testing.assert_array_equal(body_of.completed(view, growth, taken).body.rows, kept)
    none = body_of.Growth(None, nowhere)
    assert body_of.completed(view, none, everywhere) is none


def test_what_begins_too_slow_or_explains_too_little_does_not_grow(monkeypatch):
    view = scene(np.array([0.6, 0.0, 0.0]), 14)
    found = seeds.find(view, tree.NOTHING, CONFIG)

    def tried(min_speed_m_per_s: float) -> list[np.ndarray]:
        """The starts of what is grown, where objects are at least that fast."""
        starts: list[np.ndarray] = []

        def grown(_view, _seeds, given, *_others):
            starts.extend(given)
            return [body_of.Growth(None, np.zeros(len(view.points), bool)) for _ in given]

        monkeypatch.setattr(body_of, "grown", grown)
        assert objects.find(view, found, 0.1, replace(CONFIG, min_speed_m_per_s=min_speed_m_per_s)) == []
        return starts

    start, = tried(11.0)     # half of it is 0.55 m a scan
    assert pose.translation_distance(start, pose.from_translation([0.6, 0.0, 0.0])) < 0.1
    assert tried(14.0) == []
    monkeypatch.setattr(objects, "_MAX_START_RATIO", 1e-6)
    assert tried(11.0) == []


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize("name", ["kitti_tracked_0005_from_000", "kitti_tracked_0005_from_040"])
def test_tracked_kitti_drives(name):
    dataset = open_dataset(SHARED / name)
    for index, (_, result) in enumerate(run(dataset, [0, 1, 2], FlowEstimator())):
        truth = dataset.truth(index)
        error_m = np.linalg.norm(result.flow - truth.flow, axis=1)
        moving, still = truth.is_dynamic & truth.valid, ~truth.is_dynamic & truth.valid
        assert error_m[still].mean() < 0.010
        assert result.is_dynamic[still].mean() < 0.003
        assert error_m[moving].mean() < 0.065
        assert np.median(error_m[moving]) < 0.065
        assert result.is_dynamic[moving].mean() > 0.97


@needs_shared
@pytest.mark.parametrize(
    "name, movers", [("kitti_odometry_00_pair_198", 0), ("kitti_odometry_00_start", 1)])
def test_static_folders_hold_no_more_than_they_show(name, movers):
    dataset = open_dataset(SHARED / name)
    (_, result), = run(dataset, [0, 1], FlowEstimator())
    assert len(result.objects) == movers   # a car drives 25 m ahead in the second


@needs_shared
def test_what_moves_in_argoverse_does_so_as_labelled():
    dataset = open_dataset(SHARED / "argoverse2")
    (_, result), = run(dataset, [0, 1], FlowEstimator())
    truth = dataset.truth(0)
    error_m = np.linalg.norm(result.flow - truth.flow, axis=1)
    moving = truth.is_dynamic & truth.valid
    assert error_m[moving].mean() < 0.13 and result.is_dynamic[moving].mean() > 0.88
    assert result.is_dynamic[truth.valid & ~truth.is_dynamic].mean() < 0.002


@needs_shared
@pytest.mark.slow
def test_a_car_that_passes_beside_the_sensor_moves_to_the_last():
    dataset = open_dataset(SHARED / "kitti_raw_0048")
    *_, before, last = (result for _, result in run(dataset, range(4, 8), FlowEstimator()))
    car, same = (max(result.objects, key=lambda moving: moving.points) for result in (before, last))
    assert same.id == car.id and same.points > 10_000
    assert np.linalg.norm(same.velocity[:2] - car.velocity[:2]) < 1.0   # 10 cm a pair; as static it is 6 off
