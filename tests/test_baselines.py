"""The baselines: one rigid motion for a whole scan, on scenes and recordings whose motion is known."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from command_line import drive
from numpy.testing import assert_allclose, assert_array_equal
from shared_data import SHARED, needs_shared

from lidarflow import baselines, methods, pose, synthetic
from lidarflow.baselines import ransac
from lidarflow.config import Config, EgoConfig, load
from lidarflow.datasets import open_dataset
from lidarflow.errors import ConfigError, DataError
from lidarflow.lidar import features, matching, odometry
from lidarflow.settings import to_dict, updated
from lidarflow.types import FlowResult, Scan, ScanPair

NAMES = tuple(name for name in methods.METHODS if name != methods.OURS)
SENSOR = synthetic.hdl64e(columns=450)
LIMITS = {"icp": (0.03, 0.3), "ransac_icp": (0.01, 0.05), "ego": (0.01, 0.05)}   # metres, degrees


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def pair_of(scene) -> tuple[ScanPair, np.ndarray]:
    """Two scans of a scene and the true ego-motion between them."""
    (source, truth), (target, _) = synthetic.scan_sequence(scene, SENSOR, 2, rng(1))
    return ScanPair(source, target), truth.ego_motion


@pytest.fixture(scope="module")
def room():
    """A static yard, the sensor moves 0.2 m and turns 1.1°."""
    return pair_of(synthetic.room(rng()))


@pytest.fixture(scope="module")
def answers(room):
    return {name: methods.find(name).estimate(room[0], Config()) for name in NAMES}


def off(found: np.ndarray, known: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two motions."""
    return (float(pose.translation_distance(found, known)),
            float(np.degrees(pose.rotation_distance(found, known))))


# --- what they ask for ---

@pytest.mark.parametrize("name", NAMES)
def test_settings_that_are_said_to_have_no_effect_have_none(room, answers, name):
    other = load(overrides=(
        "normals.radius_m=0.4", "mesh.max_edge_m=0.2", "shot.radius_m=0.7", "matching.max_ratio=0.5",
        "graph.start=ego", "solver.method=gtsam", "refine.rounds=0", "ego.method=kiss_icp",
        "ego.refine=false", "ego.voxel_m=0.4", "dynamic.min_speed_m_per_s=2.0", "objects.enabled=false"))
    (line,) = methods.without_effect((name,), other)
    keys, reason = line.split(": no effect with ")
    assert reason == f"--method {name}" and "solver.method" in keys
    used, idle = to_dict(Config()), to_dict(other)
    for key in keys.split(", "):
        section, _, setting = key.partition(".")
        used[section][setting] = idle[section][setting]
    found = methods.find(name).estimate(room[0], updated(Config(), used))
    assert_array_equal(found.flow, answers[name].flow)


def test_settings_that_another_switches_off_are_said_to_have_no_effect():
    def idle(*overrides, along=True):
        return methods.without_effect((methods.OURS,), load(overrides=overrides), along)

    assert idle("mesh.max_edge_m=0.2", "objects.near_m=0.1", "refine.rounds=0", "ego.method=kiss_icp") == []
    assert idle("ego.method=kiss_icp", along=False) == ["ego.method: no effect with a single pair"]
    assert idle("dynamic.min_gain_m=0.1") == ["dynamic.min_gain_m: no effect with objects.enabled = true"]
    assert idle("objects.enabled=false", "objects.near_m=0.1", "solver.tie_weight=3.0",
                "dynamic.min_gain_m=0.1", "refine.rounds=0", "refine.reach_m=0.2") == [
        "solver.tie_weight, objects.near_m: no effect with objects.enabled = false",
        "refine.reach_m: no effect with refine.rounds = 0"]


# --- what they find ---

@pytest.mark.parametrize("name", LIMITS)
def test_the_motion_of_a_static_scene_is_found(room, answers, name):
    metres, degrees = off(answers[name].ego_motion, room[1])
    assert metres <= LIMITS[name][0] and degrees <= LIMITS[name][1]


@pytest.fixture(scope="module")
def fast():
    """An open place where little stands, the sensor moves 2 m."""
    def straight(time_s):
        return pose.from_translation(np.array([20.0 * time_s, 0.0, 0.0]))

    return pair_of(replace(synthetic.one_car(8.0, rng()), world_from_vehicle=straight))


def test_matches_find_a_large_motion(fast):
    metres, degrees = off(baselines.RansacIcp.estimate(fast[0]).ego_motion, fast[1])
    assert metres <= 0.03 and degrees <= 0.1


def test_icp_without_a_start_value_may_miss_a_large_motion(fast):
    """Not wanted, but what this baseline is known for: nearest points are other points."""
    metres, _ = off(baselines.Icp.estimate(fast[0]).ego_motion, fast[1])
    assert 1.0 < metres < 2.0


def test_ground_would_hold_icp_where_it_is(room, monkeypatch):
    """Rings on the ground look alike wherever the sensor is: with them, part of the way is lost."""
    monkeypatch.setattr(baselines.icp, "_standing", lambda scan, masks: scan.points[masks.usable])
    with_ground, _ = off(baselines.Icp.estimate(room[0]).ego_motion, room[1])
    assert with_ground > LIMITS["icp"][0]


def test_zero_is_zero(room, answers):
    assert not answers["zero"].flow.any()
    assert_array_equal(answers["zero"].ego_motion, np.eye(4))


def test_ego_is_the_ego_motion_of_the_method(room, answers):
    ours = methods.find(methods.OURS).estimate(room[0], Config())
    assert answers["ego"].ego_motion.tobytes() == ours.ego_motion.tobytes()


# --- what they answer ---

@pytest.mark.parametrize("name", NAMES)
def test_every_point_has_the_one_motion(room, answers, name):
    points, result = room[0].source.points, answers[name]
    masks = features.masks(room[0].source, Config())
    assert (result.motions == result.ego_motion).all() and pose.is_rigid(result.ego_motion)
    assert_allclose(result.flow, pose.apply(result.ego_motion, points) - points)
    assert_array_equal(result.valid, masks.usable)
    assert_array_equal(result.is_ground, masks.ground)
    assert not (result.is_dynamic.any() or result.in_graph.any()) and result.objects == ()
    assert result.stats.solver == name and result.stats.variables == (name != "zero")
    assert min(result.seconds.values()) > 0


def test_only_ransac_has_matches_and_says_how_many_agree(answers):
    for name, result in answers.items():
        matches = len(result.match_source)
        assert (matches > 1000) == (name == "ransac_icp") and result.stats.matches == matches
    stats = answers["ransac_icp"].stats
    assert 0.5 * stats.matches < stats.inliers < stats.matches and stats.robust_iterations >= 100


@pytest.mark.parametrize("name", NAMES)
def test_equal_input_gives_equal_bytes(room, answers, name):
    again = methods.find(name).estimate(room[0], Config())
    for array in ("flow", "motions", "ego_motion", "valid", "match_source", "match_target"):
        assert getattr(again, array).tobytes() == getattr(answers[name], array).tobytes(), array


@pytest.mark.parametrize("name", NAMES)
def test_nan_rows_stay_where_they_are(name):
    (source, _), (target, _), _ = drive()
    rows = np.array([3, 100, 4000])
    result = methods.find(name).estimate(
        ScanPair(worlds.with_nan_rows(source, rows), worlds.with_nan_rows(target, rows)), Config())
    hole = rows + np.arange(len(rows))
    assert np.isnan(result.flow[hole]).all() and not result.valid[hole].any()
    assert np.isfinite(np.delete(result.flow, hole, axis=0)).all()


# --- along a sequence ---

def stepped(name: str, config: Config | None = None) -> list[FlowResult | None]:
    estimator = methods.find(name).along(config or Config())
    return [estimator.step(scan) for scan, _ in drive()]


@pytest.mark.parametrize("name", ["zero", "icp", "ransac_icp"])
def test_a_sequence_is_its_pairs(name):
    first, *results = stepped(name)
    assert first is None
    for (source, _), (target, _), result in zip(drive(), drive()[1:], results, strict=False):
        alone = methods.find(name).estimate(ScanPair(source, target), Config())
        assert result.ego_motion.tobytes() == alone.ego_motion.tobytes()
        assert_array_equal(result.valid, alone.valid)


def test_ego_is_registration_or_kiss_icp_along_a_sequence():
    settings = [EgoConfig(), EgoConfig(method="kiss_icp"), EgoConfig(method="kiss_icp", refine=False)]
    registered, refined, alone = (stepped("ego", replace(Config(), ego=ego)) for ego in settings)
    kiss_icp = odometry.KissIcp(Config())
    by_kiss_icp = [kiss_icp.step(scan.points, 0.1) for scan, _ in drive()]
    for (_, truth), one, other, coarse, kiss in zip(
            drive(), registered[1:], refined[1:], alone[1:], by_kiss_icp[1:], strict=False):
        assert_allclose(coarse.ego_motion, kiss, atol=1e-6)
        assert_allclose(one.ego_motion, other.ego_motion, atol=1e-3)
        assert off(one.ego_motion, truth.ego_motion)[0] <= 0.03 < off(kiss, truth.ego_motion)[0]


def test_the_first_pair_bears_the_work_on_both_its_scans(monkeypatch):
    """Times are counted from the last answer on."""
    seconds = [result.seconds["ground"] for result in stepped("zero")[1:]]
    estimator = baselines.Zero()
    estimator.step(drive()[0][0])
    before = estimator._timed.seconds["ground"]
    result = estimator.step(drive()[1][0])
    assert min(seconds) > 0 and result.seconds["ground"] > before > 0
    assert estimator._timed.seconds == {}


@pytest.mark.parametrize("name", ["zero", "ego"])
def test_a_sequence_goes_on_after_a_bad_scan(name):
    good = [scan for scan, _ in drive()]
    estimator = methods.find(name).along(replace(Config(), ego=EgoConfig(method="registration")))
    estimator.step(good[0])
    with pytest.raises(DataError, match="empty: none of 0 points"):
        estimator.step(Scan(np.empty((0, 3)), 0, "empty"))
    assert estimator.step(good[1]) is None, "the scan before the bad one is not its source"
    assert estimator.step(good[2]).valid.any()


# --- scans that are hardly usable ---

@pytest.mark.parametrize("name", ["icp", "ransac_icp", "ego"])
def test_too_few_points_are_one_clear_line(name):
    pair = worlds.plane_pair(rng())
    few = ScanPair(pair.source, replace(pair.target, points=pair.target.points[:10], name="000007"))
    with pytest.raises(DataError, match=r"^000007: registration: a scan has 10 points in range"):
        methods.find(name).estimate(few, Config())


@pytest.mark.parametrize("name", ["ransac_icp", "ego"])
def test_scans_that_have_nothing_in_common_are_named(name, room):
    scans = replace(room[0].source, name="7"), Scan(rng().uniform(-70, 70, (3000, 3)), name="8")
    with pytest.raises(DataError, match=r"ego-motion: .*% of 7 comes within .* m of 8, at least 30%"):
        methods.find(name).estimate(ScanPair(*scans), Config())


@pytest.mark.parametrize("name", NAMES)
def test_a_bare_floor_has_an_answer(name):
    pair = worlds.plane_pair(rng())
    result = methods.find(name).estimate(pair, Config())
    assert np.abs(result.flow[:, 2]).max() < 0.1 and result.valid.all()


def test_without_matches_icp_starts_at_the_identity(room, monkeypatch):
    none = np.empty(0, np.int64)
    monkeypatch.setattr(matching, "match", lambda *args: (none, none))
    result = baselines.RansacIcp.estimate(room[0])
    assert result.stats.matches == result.stats.inliers == 0
    assert off(result.ego_motion, room[1])[0] <= 0.01


def test_an_unknown_method_is_told_the_known_ones():
    with pytest.raises(ConfigError, match="unknown method 'icq'; known are ours, zero, ego, icp, ransac_icp"):
        methods.find("icq")


# --- RANSAC ---

KNOWN = pose.from_yaw(0.3, np.array([2.0, -1.0, 0.2]))


def matches(wrong_share: float, count: int = 400, noise_m: float = 0.03):
    random = rng(7)
    source = random.uniform(-30, 30, (count, 3))
    target = pose.apply(KNOWN, source) + random.normal(scale=noise_m, size=(count, 3))
    wrong = np.arange(count) < wrong_share * count
    target[wrong] = random.uniform(-30, 30, (wrong.sum(), 3))
    return source, target, wrong


@pytest.mark.parametrize("wrong_share", [0.0, 0.5, 0.8])
def test_wrong_matches_do_not_count(wrong_share):
    source, target, wrong = matches(wrong_share)
    found, inlier, _ = ransac.rigid_motion(source, target, rng())
    right = pose.aligned(source[~wrong], target[~wrong])
    assert_allclose(found, right, atol=0.01)
    assert (inlier == ~wrong).mean() > 0.99


def test_more_wrong_matches_take_more_samples():
    drawn = [ransac.rigid_motion(*matches(share)[:2], rng())[2] for share in (0.0, 0.8, 1.0)]
    assert drawn[0] == 100 < drawn[1] < drawn[2] == 10_000


def test_samples_needed_follow_from_the_confidence():
    """1 − (1 − w³)ⁿ = 0.9999."""
    assert ransac._samples_needed(0.5) == pytest.approx(np.log(1e-4) / np.log(0.875))
    assert ransac._samples_needed(1.0) == 0.0 and ransac._samples_needed(0.0) == np.inf


def test_random_matches_have_no_consensus():
    found, inlier, _ = ransac.rigid_motion(*matches(1.0)[:2], rng())
    assert found is None and not inlier.any()
    for few in (0, 2, 5):
        source, target, _ = matches(0.0, few)
        assert ransac.rigid_motion(source, target, rng())[0] is None


def test_the_seed_decides():
    source, target, _ = matches(0.8, noise_m=0.1)
    first, again = (ransac.rigid_motion(source, target, rng(3))[0] for _ in range(2))
    assert first.tobytes() == again.tobytes()


# --- real recordings ---

@needs_shared
@pytest.mark.parametrize("name, limit_m, limit_deg", [("ransac_icp", 0.02, 0.06), ("icp", 0.035, 0.15)])
@pytest.mark.parametrize("folder", ["kitti_odometry_00_pair_094", "kitti_odometry_00_pair_198"])
def test_static_kitti_pairs(folder, name, limit_m, limit_deg):
    dataset = open_dataset(SHARED / folder)
    world_from_sensor = dataset.world_from_sensor()
    known = pose.inverse(world_from_sensor[1]) @ world_from_sensor[0]
    result = methods.find(name).estimate(ScanPair(dataset.scan(0), dataset.scan(1)), Config())
    metres, degrees = off(result.ego_motion, known)
    assert metres <= limit_m and degrees <= limit_deg
