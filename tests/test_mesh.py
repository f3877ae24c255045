"""Scan rings and the mesh: what belongs together is joined, what stands behind something else is not."""

from dataclasses import dataclass

import numpy as np
import pytest
from shared_data import SHARED, needs_shared

from lidarflow import pose, synthetic
from lidarflow.config import Config, MeshConfig
from lidarflow.datasets import open_dataset
from lidarflow.errors import DataError
from lidarflow.kernels import grid
from lidarflow.lidar import frontend, ground, mesh, preparation, rings
from lidarflow.synthetic import Part, Scene, shapes

CONFIG = Config()
SENSOR = synthetic.hdl64e(range_noise_m=0.0, drop_probability=0.0)
NEAR, FAR, BACKDROP = 0, 1, 2
MOST_POINTS = 2000


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def built(points: np.ndarray, kept: np.ndarray | None = None, **settings) -> mesh.Mesh:
    kept = np.isfinite(points).all(axis=1) if kept is None else kept
    surface = points[kept]
    surface = surface[grid.first_per_voxel(surface, CONFIG.shot.surface_voxel_m)]
    return mesh.build(points, kept, surface, MeshConfig(**settings), CONFIG.normals.radius_m)


def ring_of(points: np.ndarray, sensor: synthetic.Sensor) -> np.ndarray:
    """Ring (N,) of noise-free or radially noisy points by the angles the sensor was made with."""
    pitch = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    return np.abs(pitch[:, None] - sensor.elevations_rad).argmin(axis=1)


def ball_of_walls(sensor: synthetic.Sensor, range_m: float = 12.0) -> np.ndarray:
    ball = shapes.ellipsoid((0.0, 0.0, sensor.height_m), (range_m,) * 3, count=32)
    scene = Scene((Part(ball, "walls"),), synthetic.scene.at_rest)
    return synthetic.scan_sequence(scene, sensor, 1, rng(0))[0][0].points


def turned(points: np.ndarray, yaw: float) -> np.ndarray:
    return pose.apply(pose.from_yaw(yaw), points)


# ---- rings ----------------------------------------------------------------------------------------------

@pytest.mark.parametrize("make", [synthetic.hdl64e, synthetic.hdl32e])
@pytest.mark.parametrize("yaw", [0.0, 1.0, np.pi, -2.0])
@pytest.mark.parametrize("is_clockwise", [False, True])
def test_rings_come_back_exactly_from_file_order(make, yaw, is_clockwise):
    sensor = make(columns=400)
    points = turned(ball_of_walls(sensor), yaw)
    if is_clockwise:
        points = points * [1, -1, 1]
    np.testing.assert_array_equal(rings.recover(points).index, ring_of(points, sensor))


@pytest.mark.parametrize("drop", [0.0, 0.2])
def test_rings_know_their_azimuths_and_the_median_angle_between_them(street_scan, drop):
    points = street_scan[rng(15).random(len(street_scan)) >= drop]
    found = rings.recover(points)
    np.testing.assert_array_equal(found.azimuth, np.arctan2(points[:, 1], points[:, 0]))
    pitch = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    middle = [np.median(pitch[found.index == ring]) for ring in range(found.index.max() + 1)]
    assert found.spacing_rad == np.median(np.abs(np.diff(middle)))


def test_file_order_carries_rings_whose_pitch_wanders():
    sensor = synthetic.hdl64e(columns=400)
    points = ball_of_walls(sensor)
    expected = ring_of(points, sensor)
    wandering = points + np.column_stack([np.zeros((len(points), 2)), rng(1).normal(0, 0.04, len(points))])
    np.testing.assert_array_equal(rings.recover(wandering).index, expected)
    assert rings.recover(wandering[rng(2).permutation(len(points))]) is None


@pytest.mark.parametrize("make", [synthetic.hdl64e, synthetic.hdl32e])
def test_rings_come_back_exactly_from_pitch_in_any_order(make):
    sensor = make(columns=400)
    points = ball_of_walls(sensor)
    shuffled = points[rng(3).permutation(len(points))]
    np.testing.assert_array_equal(rings.recover(shuffled).index, ring_of(shuffled, sensor))


def test_rows_without_a_point_have_no_ring_and_change_no_other():
    sensor = synthetic.hdl64e(columns=400)
    points = ball_of_walls(sensor)
    expected = ring_of(points, sensor)
    gone = rng(4).random(len(points)) < 0.1
    holed = points.copy()
    holed[gone] = np.where(rng(5).random(gone.sum()) < 0.5, np.nan, 0.0)[:, None]
    expected[gone] = -1
    np.testing.assert_array_equal(rings.recover(holed).index, expected)


def test_other_clouds_have_no_rings():
    random = rng(6)
    assert rings.recover(random.normal(scale=10, size=(20_000, 3))) is None
    flat = np.column_stack([random.uniform(-20, 20, (20_000, 2)), random.normal(0, 0.02, 20_000) - 1.7])
    assert rings.recover(flat) is None
    assert rings.recover(flat[np.lexsort(flat.T)]) is None
    for count in (0, 3, 300):
        assert rings.recover(random.normal(size=(count, 3))) is None
    assert rings.recover(np.full((1000, 3), np.nan)) is None


# ---- two walls ------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Walls:
    """A revolution (N, 3) that sees a near wall and one behind it; label (N,) NEAR, FAR or BACKDROP."""

    points: np.ndarray
    label: np.ndarray


def two_walls(range_m: float, facing: float, incidence: float, border: str, gap_m: float = 0.4) -> Walls:
    """Upright parallel walls `gap_m` apart; the near one ends at a vertical or a horizontal border.

    The border is `range_m` away in direction `facing`, where the line of sight makes the angle `incidence`
    with the walls' normal. The walls are cut off some way from the border; a sparse backdrop is behind them.
    """
    rays = SENSOR.directions(phase=0.37)
    normal = np.array([np.cos(facing + incidence), np.sin(facing + incidence), 0.0])
    along = np.array([-normal[1], normal[0], 0.0])
    middle = range_m * np.array([np.cos(facing), np.sin(facing), 0.0])
    towards = np.maximum(rays @ normal, 1e-3)
    near = rays * (middle @ normal / towards)[:, None]
    far = rays * ((middle @ normal + gap_m) / towards)[:, None]
    is_near = {"left": (near - middle) @ along > 0, "right": (near - middle) @ along < 0,
               "top": near[:, 2] < -0.02 * range_m}[border]
    points, label = np.where(is_near[:, None], near, far), np.where(is_near, NEAR, FAR)
    half_width_m = min(3.0, 0.5 * range_m)
    close = np.abs((points - middle) @ along) < half_width_m
    close &= np.abs(points[:, 2]) < min(3.0, 0.3 * range_m)
    points[~close], label[~close] = 70.0 * rays[~close], BACKDROP
    shown = close | (np.arange(len(rays)) % 5 == 0)
    return Walls(points[shown], label[shown])


BORDERS = ("left", "right", "top")
FACINGS = tuple(np.radians([77.0, 180.0]))
INCIDENCES = tuple(np.radians([-50.0, -25.0, 0.0, 10.0, 35.0, 50.0]))


def edges_within_and_across(method: str, border: str, range_m: float) -> tuple[int, int]:
    """How many edges stay on one of the two walls, and how many join them, seen from several sides."""
    within = across = 0
    for facing in FACINGS:
        for incidence in INCIDENCES:
            walls = two_walls(range_m, facing, incidence, border)
            kept = walls.label != BACKDROP
            if method == "tangent" and kept.sum() > MOST_POINTS:
                kept[kept] = rng(7).random(kept.sum()) < MOST_POINTS / kept.sum()
            side = walls.label[built(walls.points, kept, method=method).edges]
            across += int((side[:, 0] != side[:, 1]).sum())
            for wall in (NEAR, FAR):
                on_this = int((side == wall).all(axis=1).sum())
                assert on_this > 0.5 * (walls.label[kept] == wall).sum(), "a wall is hardly meshed"
                within += on_this
    return within, across


@pytest.mark.parametrize("method", ["grid", "tangent"])
@pytest.mark.parametrize("border", BORDERS)
@pytest.mark.parametrize("range_m", [2.0, 5.0, 10.0, 17.0, 25.0, 32.0, 40.0])
def test_surfaces_40_cm_apart_are_never_joined(method, border, range_m):
    assert edges_within_and_across(method, border, range_m)[1] == 0


# ---- one wall -------------------------------------------------------------------------------------------

def lone_wall(distance_m: float, facing: float, sensor: synthetic.Sensor) -> np.ndarray:
    """Scan of a wall 12 m long and 3 m high, its middle straight ahead in direction `facing`."""
    wall = shapes.box((0.2, 12.0, 3.0), (distance_m, 0.0, 1.5))
    floor = shapes.box((160.0, 160.0, 0.1), (0.0, 0.0, -0.05))
    parts = tuple(Part(shapes.moved(part, pose.from_yaw(facing)), name)
                  for part, name in ((wall, "wall"), (floor, "floor")))
    return synthetic.scan_sequence(Scene(parts, synthetic.scene.at_rest), sensor, 1, rng(8))[0][0].points


@pytest.mark.parametrize("facing_deg", [0.0, 45.0, 180.0, -179.0])
@pytest.mark.parametrize("distance_m", [4.0, 20.0, 30.0])
def test_a_wall_is_one_component_also_behind_the_sensor(facing_deg, distance_m):
    points = lone_wall(distance_m, np.radians(facing_deg), synthetic.hdl64e(columns=2000))
    on_wall = points[:, 2] > -SENSOR.height_m + 0.3
    found = built(points, on_wall)
    assert found.method == "grid" and on_wall.sum() > 1000
    assert largest_share(found.component[on_wall]) > 0.99


def largest_share(component: np.ndarray) -> float:
    return np.bincount(component).max() / len(component)


# ---- thin things ----------------------------------------------------------------------------------------

@pytest.mark.parametrize("slope_deg", [0.0, 10.0, 25.0])
def test_an_arm_in_front_of_a_wall_is_one_piece(slope_deg):
    """A bar 9 cm thick and 0.9 m long, 7 m from an HDL-32E whose rings are 16 cm apart there."""
    sensor = synthetic.hdl32e(columns=2170, range_noise_m=0.0, drop_probability=0.0)
    arm = shapes.moved(shapes.box((0.09, 0.9, 0.09)), pose.exp(np.radians([slope_deg, 0, 0, 0, 0, 0])))
    parts = (Part(shapes.shifted(arm, 7.0, 0.0, sensor.height_m - 0.02), "arm"),
             Part(shapes.box((0.2, 12.0, 3.0), (11.0, 0.0, 1.5)), "wall"))
    points = synthetic.scan_sequence(Scene(parts, synthetic.scene.at_rest), sensor, 1, rng(8))[0][0].points
    on_arm = points[:, 0] < 8.0
    component = built(points).component
    assert on_arm.sum() >= 20 and largest_share(component[on_arm]) > 0.9
    assert not np.isin(component[~on_arm], component[on_arm]).any()


# ---- the graph ------------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def street_scan() -> np.ndarray:
    scene = synthetic.street(rng(9))
    return synthetic.scan_sequence(scene, synthetic.hdl64e(columns=600), 1, rng(10))[0][0].points


def components_by_search(edges: np.ndarray, count: int) -> np.ndarray:
    """Lowest row (count,) that each point can be reached from, by relaxing edges until nothing changes."""
    lowest = np.arange(count)
    while True:
        before = lowest.copy()
        np.minimum.at(lowest, edges[:, 0], lowest[edges[:, 1]])
        np.minimum.at(lowest, edges[:, 1], lowest[edges[:, 0]])
        if (before == lowest).all():
            return lowest


@pytest.mark.parametrize("method", ["grid", "tangent"])
def test_edges_are_sides_of_triangles_or_along_rings_and_components_follow(street_scan, method):
    kept = street_scan[:, 2] > -1.5
    found = built(street_scan, kept, method=method)
    triangles, edges = found.triangles.astype(int), found.edges
    assert found.method == method and len(edges) > 5000
    assert kept[triangles].all()
    assert (edges[:, 0] < edges[:, 1]).all()
    sides = {(min(a, b), max(a, b)) for t in triangles.tolist()
             for a, b in ((t[0], t[1]), (t[1], t[2]), (t[0], t[2]))}
    assert sides <= set(map(tuple, edges.tolist())) and len(np.unique(edges, axis=0)) == len(edges)
    by_side = np.array([edge in sides for edge in map(tuple, edges.tolist())])
    if method == "tangent":
        assert by_side.all()
    else:
        # The others join points of a ring, at least one of which no triangle has.
        on_triangle = np.isin(edges[~by_side], triangles)
        ring = rings.recover(street_scan).index[edges[~by_side]]
        assert 0 < len(ring) < 0.05 * len(edges)
        assert (ring[:, 0] == ring[:, 1]).all() and not on_triangle.all(axis=1).any()

    assert found.component.shape == (len(street_scan),)
    lowest = components_by_search(edges, len(street_scan))
    assert len(np.unique(np.column_stack([lowest, found.component]), axis=0)) == len(np.unique(lowest))
    assert np.unique(found.component).tolist() == list(range(len(np.unique(lowest))))


@pytest.mark.parametrize("method", ["grid", "tangent"])
def test_no_edge_is_longer_or_jumps_farther_than_allowed(street_scan, method):
    found = built(street_scan, street_scan[:, 2] > -1.5, method=method)
    a, b = street_scan[found.edges].swapaxes(0, 1)
    length_m, ranges_m = np.linalg.norm(a - b, axis=1), np.linalg.norm([a, b], axis=2)
    jump_m = np.abs(ranges_m[0] - ranges_m[1])
    # An HDL-64E's rings are 1/3 degree apart in the upper half and 1/2 in the lower.
    spacing_rad = np.radians(0.5) if method == "grid" else 0.0
    far_m = CONFIG.mesh.max_edge_rings * spacing_rad * ranges_m.min(axis=0)
    limit_m = np.maximum(CONFIG.mesh.max_edge_m, far_m)
    assert (length_m <= limit_m + 1e-9).all()
    assert (jump_m <= CONFIG.mesh.max_depth_jump_m + 1e-9).all()
    sine_sq = np.sin(np.radians(CONFIG.mesh.min_grazing_deg)) ** 2
    assert (length_m**2 - jump_m**2 >= sine_sq * length_m**2 - 1e-9).all()


@pytest.mark.parametrize("thinning_m", [0.0, 0.5])
def test_the_graph_of_a_mesh_has_its_points_edges_and_components(street_scan, thinning_m):
    found = built(street_scan, street_scan[:, 2] > -1.5)
    graph = frontend.build(street_scan, found, thinning_m)
    problem = graph.problem
    np.testing.assert_array_equal(np.flatnonzero(graph.variable >= 0), np.unique(found.edges))
    np.testing.assert_array_equal(problem.points, street_scan[graph.rows])
    between = np.sort(graph.variable[found.edges], axis=1)
    between = np.unique(between[between[:, 0] != between[:, 1]], axis=0)
    np.testing.assert_array_equal(problem.edges, between)
    _, component = np.unique(found.component[graph.rows], return_inverse=True)
    np.testing.assert_array_equal(problem.component, component)
    assert {problem.edges.dtype, problem.component.dtype, graph.variable.dtype} == {np.dtype(np.int32)}
    assert (problem.initial == pose.identity()).all() and len(problem.initial) == len(graph.rows)


@pytest.mark.parametrize("method", ["grid", "tangent"])
def test_points_that_are_written_twice_change_no_triangle(street_scan, method):
    kept = street_scan[:, 2] > -1.5
    once = built(street_scan, kept, method=method)
    twice = built(np.repeat(street_scan, 2, axis=0), np.repeat(kept, 2), method=method)
    np.testing.assert_array_equal(2 * once.triangles, twice.triangles)
    np.testing.assert_array_equal(2 * once.edges, twice.edges)


def test_only_points_that_are_kept_are_meshed():
    nothing = built(np.full((200, 3), np.nan))
    assert len(nothing.edges) == 0 and len(nothing.triangles) == 0 and nothing.method == "tangent"
    assert len(np.unique(nothing.component)) == 200
    points = ball_of_walls(synthetic.hdl64e(columns=400))
    for method in ("grid", "tangent"):
        none_kept = built(points, np.zeros(len(points), bool), method=method)
        assert len(none_kept.edges) == 0 and len(np.unique(none_kept.component)) == len(points)


def test_a_grid_that_is_asked_for_must_be_there():
    with pytest.raises(DataError, match="use auto or tangent"):
        built(rng(11).normal(scale=5.0, size=(3000, 3)), method="grid")


# ---- clouds without rings -------------------------------------------------------------------------------

def sampled_ball(count: int) -> np.ndarray:
    direction = rng(12).normal(size=(count, 3))
    return 5.0 * direction / np.linalg.norm(direction, axis=1, keepdims=True)


def sampled_plane(count: int) -> np.ndarray:
    u, v = rng(13).uniform(-7, 7, (2, count))
    return np.column_stack([np.full(count, 6.0) + 0.3 * u, u, v]) + rng(14).normal(0, 0.01, (count, 3))


@pytest.mark.parametrize("sample", [sampled_ball, sampled_plane])
def test_a_sampled_surface_becomes_one_two_sided_sheet(sample):
    points = sample(15_000)
    found = built(points)
    assert found.method == "tangent"
    assert largest_share(found.component) > 0.98
    sides = np.sort(found.triangles[:, [0, 1, 1, 2, 0, 2]].reshape(-1, 2), axis=1)
    _, uses = np.unique(sides, axis=0, return_counts=True)
    assert (uses <= 2).mean() > 0.95
    # A closed triangulation has two triangles per point; the angle limits cost some.
    assert 1.5 < len(found.triangles) / len(points) < 2.1


# ---- real scans -----------------------------------------------------------------------------------------

@needs_shared
@pytest.mark.parametrize("name", ["kitti_tracked_0005_from_000", "kitti_raw_0048", "kitti_odometry_00_start"])
def test_most_of_a_real_scan_lies_in_components_worth_solving(name):
    points = open_dataset(SHARED / name).scan(0).points
    usable = preparation.usable(points, CONFIG.preparation)
    kept = usable & ~ground.detect(points, usable, CONFIG.ground).mask
    found = built(points, kept)
    assert found.method == "grid"
    sizes = np.bincount(found.component[kept])
    near = kept & (np.linalg.norm(points, axis=1) < 40)
    share = (sizes[found.component[near]] >= 20).mean()
    assert near.sum() > 20_000
    assert share >= 0.88, f"{share:.3f}"
