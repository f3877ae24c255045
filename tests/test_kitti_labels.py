"""Truth of KITTI drives from labelled boxes: a generated drive, and the shared ones whose flow was stored."""

import labelled_drive as drive
import numpy as np
import pytest
from cloud_files import message
from labelled_drive import ROWS
from shared_data import SHARED, needs_shared

from lidarflow import pose
from lidarflow.datasets import guess_loader, open_dataset
from lidarflow.datasets.kitti_truth import labelled_truth
from lidarflow.datasets.oxts import world_from_imu
from lidarflow.types import Category

OFF = {"kitti_correction": "off"}


def check_truth(data, frame, atol):
    """The truth of a frame is what drove there, to within the accuracy of its poses."""
    truth = data.truth(frame)
    np.testing.assert_allclose(truth.ego_motion, drive.ego_motion(frame), atol=atol)
    expected = drive.true_flow(frame)
    expected[ROWS["car"]] = drive.true_flow(frame, drive.CAR)[ROWS["car"]]
    if frame == 0:
        expected[ROWS["cyclist"]] = drive.true_flow(frame, drive.CYCLIST)[ROWS["cyclist"]]
    np.testing.assert_allclose(truth.flow, expected, atol=50 * atol)
    np.testing.assert_array_equal(truth.is_dynamic[:6], [True] * 4 + [False] * 2, "the van is parked")
    np.testing.assert_array_equal(truth.valid[ROWS["car"]], [True, True, False, True], "4 cm over the road")
    np.testing.assert_array_equal(truth.valid[ROWS["van"]], [True, True])
    return truth


def test_a_tracking_sequence_is_recognised(tmp_path):
    part = drive.write_tracking(tmp_path, poses="poses")
    for folder in (tmp_path, part, part / "velodyne" / "0003"):
        data = open_dataset(folder)
        assert (guess_loader(folder), data.name, len(data)) == ("kitti_tracking", "kitti_tracking 0003", 5)
    assert "correction on" in data.note and open_dataset(tmp_path, **OFF).note == "10 Hz assumed"
    drive.write_tracking(tmp_path, sequence="0012")
    assert "holds the sequences 0003, 0012; choose one" in message(open_dataset, tmp_path)
    assert open_dataset(tmp_path, sequence="12").name == "kitti_tracking 0012"
    assert "is the sequence '0003', not '7'" in message(
        open_dataset, part / "velodyne" / "0003", sequence="7")
    assert "expected KITTI tracking data" in message(open_dataset, part / "calib", "kitti_tracking")


@pytest.mark.parametrize(("poses", "atol"), [("poses", 1e-9), ("oxts", 2e-6)])
def test_flow_of_a_tracking_sequence_is_known(tmp_path, poses, atol):
    drive.write_tracking(tmp_path, poses=poses)
    data = open_dataset(tmp_path, **OFF)
    assert ("poses from oxts" in data.note) == (poses == "oxts")
    for frame in range(drive.FRAMES - 1):
        truth = check_truth(data, frame, atol)
        assert truth.origin == "boxes (0003.txt)"
        # Unlabelled in frame 0; then beyond 50 m, before 3 m, 42 degrees aside, behind.
        np.testing.assert_array_equal(
            truth.valid[ROWS["beside"]], [True, True, frame != 0, False, False, False, False])
    truth = data.truth(0)
    by_part = {name: set(truth.category[rows].tolist()) for name, rows in ROWS.items()}
    assert by_part == {"car": {Category.CAR}, "van": {Category.CAR}, "beside": {Category.BACKGROUND},
                       "cyclist": {Category.WHEELED_VRU}}
    assert truth.is_dynamic[ROWS["cyclist"]].all() and truth.valid[ROWS["cyclist"]].all()
    gone = data.truth(1)
    assert not gone.valid[ROWS["cyclist"]].any(), "its box has no successor"
    assert set(truth.object_id.tolist()) == {drive.CAR, drive.VAN, drive.CYCLIST, -1}
    assert data.truth(drive.FRAMES - 1) is None


def test_boxes_are_found_around_uncorrected_points(tmp_path):
    drive.write_tracking(tmp_path, poses="poses")
    data = open_dataset(tmp_path)
    truth = data.truth(0)
    np.testing.assert_array_equal(truth.object_id, open_dataset(tmp_path, **OFF).truth(0).object_id)
    points = data.scan(0).points
    np.testing.assert_allclose(truth.flow[6:9], (pose.apply(truth.ego_motion, points) - points)[6:9])


def test_what_a_tracking_sequence_lacks(tmp_path):
    part = drive.write_tracking(tmp_path, labels=False, poses="oxts")
    data = open_dataset(tmp_path)
    assert data.truth(0) is None and data.world_from_sensor().shape == (5, 4, 4)
    drive.write_tracking(tmp_path, calibration=False)
    (part / "calib" / "0003.txt").unlink()
    data = open_dataset(tmp_path)
    assert data.truth(0) is None and data.world_from_sensor() is None, "no calibration"
    drive.write_tracking(tmp_path, poses="oxts")
    (part / "oxts" / "0003.txt").write_text("\n".join(drive.oxts_lines()[:2]))
    data = open_dataset(tmp_path)
    assert data.truth(0) is None and "oxts/0003.txt has 2 lines for 5 scans and is ignored" in data.note
    (part / "label_02" / "0003.txt").write_text("0 1 Car 0 0 0 1 2 3 4 1.5\n")
    (part / "oxts" / "0003.txt").write_text("\n".join(drive.oxts_lines()))
    assert "expected 17 columns per line" in message(open_dataset(tmp_path).truth, 0)
    (part / "label_02" / "0003.txt").write_text("0 1 Car" + " x" * 14)
    assert "expected 11 finite numbers" in message(open_dataset(tmp_path).truth, 0)
    (part / "calib" / "0003.txt").write_text("R_rect 1 0 0 0 1 0 0 0 2\nTr_velo_cam " + "0 " * 12)
    assert "not a rigid motion" in message(open_dataset, tmp_path)


def test_a_missing_scan_has_no_truth(tmp_path):
    part = drive.write_tracking(tmp_path, poses="poses")
    (part / "velodyne" / "0003" / "000002.bin").unlink()
    data = open_dataset(tmp_path, **OFF)
    assert data.truth(1) is None, "frame 2 is not there, and the labels speak of it"
    np.testing.assert_allclose(data.truth(2).flow[ROWS["car"]],
                               drive.true_flow(3, drive.CAR)[ROWS["car"]], atol=1e-6)


@pytest.mark.parametrize("labels", ["tracklets", "table"])
def test_flow_of_a_raw_drive_is_known(tmp_path, labels):
    folder = drive.write_raw(tmp_path, labels)
    data = open_dataset(folder, **OFF)
    assert data.loader == "kitti_raw" and data.note == "10 Hz assumed; poses from oxts"
    for frame in range(drive.FRAMES - 1):
        truth = check_truth(data, frame, 2e-6)
    assert truth.origin == ("boxes (tracklet_labels.xml)" if labels == "tracklets" else "boxes (boxes.csv)")
    assert set(truth.category.tolist()) == {Category.BACKGROUND, Category.CAR}
    (folder / "oxts" / "data" / "0000000001.txt").unlink()
    data = open_dataset(folder, **OFF)
    assert data.truth(0) is None and data.note == (
        "10 Hz assumed; oxts/data lacks 1 of 5 packets and is ignored")


@pytest.mark.parametrize(("labels", "text", "found"), [
    ("tracklets", "<boost_serialization><tracklets>", "expected tracklets as KITTI's"),
    ("tracklets", drive.tracklets().replace("<h>1.5</h>", ""), "expected tracklets as KITTI's"),
    ("tracklets", drive.tracklets().replace("<h>1.5</h>", "<h>nan</h>"), "frame 0: numbers that are not"),
    ("table", "frame,track_id\n0,1\n", "expected a table with the columns frame, track_id, type"),
    ("table", drive.table().replace("4.2", "wide"), "expected a table with the columns frame"),
])
def test_damaged_labels(tmp_path, labels, text, found):
    folder = drive.write_raw(tmp_path, labels)
    (folder / ("tracklet_labels.xml" if labels == "tracklets" else "boxes.csv")).write_text(text)
    assert found in message(open_dataset(folder).truth, 0)


def test_stored_truth_gets_the_classes_of_labelled_tracks(tmp_path):
    folder = drive.write_raw(tmp_path, "table")
    track = np.array([drive.CAR] * 4 + [drive.VAN] * 2 + [-1] * 7 + [99], np.int16)
    (folder / "truth").mkdir()
    arrays = {"flow": np.ones((14, 3), np.float32), "valid": np.ones(14, bool), "dynamic": np.ones(14, bool),
              "track": track, "target_from_source": np.eye(4)}
    np.savez(folder / "truth" / "0000000000.npz", **arrays)
    truth = open_dataset(folder).truth(0)
    assert truth.origin == "flow"
    np.testing.assert_array_equal(truth.category, [Category.CAR] * 6 + [Category.BACKGROUND] * 8)
    np.savez(folder / "truth" / "0000000000.npz", **arrays, category=np.full(14, 3), is_ground=track == -1)
    truth = open_dataset(folder).truth(0)
    assert (truth.category == Category.PEDESTRIAN).all() and truth.is_ground.sum() == 7
    np.savez(folder / "truth" / "0000000000.npz", **arrays, category=np.full(14, 9))
    assert "expected numbers of BACKGROUND, CAR" in message(open_dataset(folder).truth, 0)


def test_navigation_begins_at_the_origin_and_goes_east_and_north():
    packets = np.zeros((3, 30))
    packets[:, 0], packets[:, 1], packets[:, 2] = 49.0, 8.0, 110.0
    packets[1, 1] += np.degrees(10.0 / (np.cos(np.radians(49.0)) * 6378137.0))
    packets[2, 0] += np.degrees(10.0 / 6378137.0)
    packets[2, 2:6] = 112.0, 0.1, 0.2, np.pi / 2
    poses = world_from_imu(packets)
    np.testing.assert_allclose(poses[:, :3, 3], [[0, 0, 0], [10, 0, 0], [0, 10, 2]], atol=1e-4)
    expected = (pose.from_yaw(np.pi / 2) @ pose.exp(np.array([0, 0.2, 0, 0, 0, 0]))
                @ pose.exp(np.array([0.1, 0, 0, 0, 0, 0])))
    np.testing.assert_allclose(poses[2, :3, :3], expected[:3, :3], atol=1e-12)


@needs_shared
@pytest.mark.parametrize("start", ["000", "040"])
def test_stored_flow_of_the_shared_drives_follows_from_their_boxes(start):
    data = open_dataset(SHARED / f"kitti_tracked_0005_from_{start}")
    for index in range(5):
        stored = data.truth(index)
        made = labelled_truth(data, index, data.labels(), data.world_from_sensor())
        # A van that sets off at walking pace counts as parked in the stored flow, and as moving here.
        compared = stored.valid & (stored.object_id != 3)
        np.testing.assert_array_equal(made.valid, stored.valid)
        np.testing.assert_array_equal(made.object_id, stored.object_id)
        np.testing.assert_array_equal(made.category, stored.category)
        np.testing.assert_array_equal(made.is_dynamic[compared], stored.is_dynamic[compared])
        assert np.linalg.norm(made.flow - stored.flow, axis=1)[compared].max() < 0.005
        assert {Category.CAR, Category.WHEELED_VRU} <= set(stored.category[stored.valid].tolist())
