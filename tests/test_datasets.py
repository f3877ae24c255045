"""Opening data sets: what lies in a folder is recognised, what is wrong with it is one clear line."""

import sys
from pathlib import Path

import numpy as np
import pytest
from cloud_files import POINTS, message, write_bin, write_numpy
from PIL import Image
from shared_data import SHARED, needs_shared

from lidarflow import pose
from lidarflow.datasets import LOADERS, guess_loader, loader_names, open_dataset
from lidarflow.datasets.base import times_from_names
from lidarflow.datasets.clouds import natural_sorted, read_scan
from lidarflow.datasets.kitti_correction import correct_vertical_angle
from lidarflow.errors import ConfigError, DataError, InputError, InstallError

# --- folders ---

def test_a_folder_is_read_in_natural_order(tmp_path):
    for number in (10, 9, 1):
        write_bin(tmp_path / f"scan{number}.bin", POINTS + number)
    data = open_dataset(tmp_path)
    assert [data.scan(i).name for i in range(3)] == ["scan1", "scan9", "scan10"]
    assert [data.scan(i).time_ns for i in range(3)] == [0, 100_000_000, 200_000_000]
    assert (data.loader, data.note, data.truth(0), data.world_from_sensor()) == (
        "folder", "10 Hz assumed", None, None)
    assert "no scan 3; there are 3" in message(data.scan, 3)
    assert "no scan -1" in message(data.scan, -1)


def test_a_data_set_is_iterated_and_indexed(tmp_path):
    for number in range(3):
        write_bin(tmp_path / f"scan{number}.bin", POINTS + number)
    data = open_dataset(tmp_path)
    assert [scan.name for scan in data] == [scan.name for scan in data] == ["scan0", "scan1", "scan2"]
    assert [data[k].name for k in (0, np.int64(1), -1, -3)] == ["scan0", "scan1", "scan2", "scan0"]
    assert [scan.name for scan in reversed(data)] == ["scan2", "scan1", "scan0"]
    np.testing.assert_array_equal(data[-2].points, data.scan(1).points)


@pytest.mark.parametrize("index", [3, -4])
def test_outside_a_data_set_is_an_error_of_ours_and_of_python(tmp_path, index):
    for number in range(3):
        write_bin(tmp_path / f"scan{number}.bin")
    data = open_dataset(tmp_path)
    for ask in (data.scan, data.__getitem__):
        with pytest.raises(IndexError) as caught:
            ask(index)
        assert isinstance(caught.value, DataError)
        assert str(caught.value) == f"{data.name}: no scan {index}; there are 3, from 0 on"


@pytest.mark.parametrize("index", [slice(0, 2), 1.0, "1", True, None])
def test_what_is_no_number_of_a_scan(tmp_path, index):
    write_bin(tmp_path / "scan0.bin")
    data = open_dataset(tmp_path)
    for ask in (data.scan, data.__getitem__):
        with pytest.raises(InputError) as caught:
            ask(index)
        assert str(caught.value) == f"{data.name}: scan {index!r}; expected the number of a scan, from 0 on"


def test_scans_are_read_when_their_turn_comes(tmp_path):
    for number in range(3):
        write_bin(tmp_path / f"scan{number}.bin")
    (tmp_path / "scan1.bin").write_bytes(b"no points")
    scans = iter(open_dataset(tmp_path))
    assert next(scans).name == "scan0"
    with pytest.raises(DataError, match=r"scan1\.bin"):
        next(scans)


def test_a_folder_of_clouds_has_the_truth_that_lies_in_it(tmp_path):
    for number in (4, 5):
        write_bin(tmp_path / f"{number:06d}.bin")
    write_truth(tmp_path / "truth" / "000004.npz", len(POINTS))
    data = open_dataset(tmp_path)
    assert data.loader == "folder" and data.truth(0).flow.shape == POINTS.shape
    assert data.truth(1) is None, "the last scan has no successor"


def test_the_order_of_equal_numbers_and_of_digits_that_are_no_numbers_is_fixed():
    names = ["01.bin", "1.bin", "1²2.bin", "1²10.bin", "٢.bin"]
    for order in (names, names[::-1]):
        assert [file.name for file in natural_sorted(map(Path, order))] == names


STAMPS = ["1700000000.95", "1700000001", "1700000001.05", "1700000001.1", "1700000001.15", "1700000001.2"]


def test_names_that_are_seconds_with_trimmed_zeros_are_in_order_of_time(tmp_path):
    for k, stamp in enumerate(STAMPS):
        write_numpy(tmp_path / f"{stamp}.npy", POINTS + k)
    data = open_dataset(tmp_path)
    assert [data.scan(k).name for k in range(6)] == STAMPS
    assert [data.scan(k).time_ns - 1_700_000_000_950_000_000 for k in range(6)] == [
        50_000_000 * k for k in range(6)]


@pytest.mark.parametrize("names", [
    ["1.8", "1.9", "1.10", "1.11"],                         # counters
    ["0.5.a", "0.05"],                                      # not all are numbers
    ["0.05", "0.1", "0.15", "0.5"],                         # seconds, but no stamps
    ["1.50", "2.05", "10.00"],
    ["1.0", "1", "1.5", "2"],
    ["0.05", "0.25", "٢.1"],
    ["1", "2", "10"],
])
def test_other_names_with_points_have_one_order_and_no_times(names):
    for order in (names, names[::-1]):
        files = [Path(f"{name}.npy") for name in order]
        assert [file.stem for file in natural_sorted(files)] == names
        assert times_from_names(files) == []


def test_seconds_in_names_are_exact():
    files = [Path(f"1700000000.{digits}.pcd") for digits in ("123456789", "123456791", "9")]
    assert times_from_names(files) == [1_700_000_000_123_456_789, 1_700_000_000_123_456_791,
                                       1_700_000_000_900_000_000]
    assert times_from_names(files[::-1]) == [], "not increasing"
    assert times_from_names([Path("99999999999.5.pcd"), Path("99999999999.6.pcd")]) == [], "not 64 bits"


@pytest.mark.parametrize("times, apart", [
    ("0\n100\n200\n", "100 s"), ("0\n1e8\n2e8\n", "1e+08 s"), ("0\n2\n4\n", None),
    ("0\n0.1\n90\n90.1\n", None)])
def test_times_that_may_not_be_seconds_are_said(tmp_path, times, apart):
    for number in range(len(times.split())):
        write_bin(tmp_path / f"{number}.bin")
    (tmp_path / "times.txt").write_text(times)
    expected = "" if apart is None else f"scans are {apart} apart by their times; are those seconds?"
    assert open_dataset(tmp_path).note == expected


@pytest.mark.parametrize("pair", [("1.bin", "1.BIN"), ("Scan1.bin", "scan1.bin")])
def test_scans_whose_results_would_share_a_file_are_refused(tmp_path, pair):
    for name in (*pair, "01.bin"):
        write_bin(tmp_path / name)
    if len(list(tmp_path.iterdir())) < 3:
        pytest.skip("this disc takes small letters for capitals")
    said = message(open_dataset, tmp_path)
    assert all(name in said for name in pair) and "rename one of them" in said
    (tmp_path / pair[1]).unlink()
    assert len(open_dataset(tmp_path)) == 2


def test_times_come_from_names_or_from_a_file(tmp_path):
    for stamp in (315966265259836000, 315966265360032000):
        write_bin(tmp_path / f"{stamp}.bin")
    assert open_dataset(tmp_path).scan(1).time_ns == 315966265360032000
    (tmp_path / "times.txt").write_text("1.5\n1.6\n")
    assert open_dataset(tmp_path).scan(1).time_ns == 1_600_000_000
    (tmp_path / "times.txt").write_text("1.5\n1.6\n1.7\n")
    assert "times.txt has 3 times for 2 scans and is ignored" in open_dataset(tmp_path).note
    for times in ("1.6\n1.5\n", "1.6\n1.6\n"):
        (tmp_path / "times.txt").write_text(times)
        data = open_dataset(tmp_path)
        assert data.scan(1).time_ns == 315966265360032000, "those of the names"
        assert f"times.txt has 1.6 s before {times[4:7]} s and is ignored" in data.note
    (tmp_path / "times.txt").write_text("soon\n")
    assert "expected 1 finite numbers per line, got 'soon'" in message(open_dataset, tmp_path)


def test_poses_lie_beside_the_scans(tmp_path):
    world_from_sensor = np.stack([pose.from_yaw(0.1 * i, (i, 0, 0)) for i in range(2)])
    write_bin(tmp_path / "0.bin")
    write_bin(tmp_path / "1.bin")
    lines = [" ".join(map(repr, m[:3].ravel().tolist())) for m in world_from_sensor]
    (tmp_path / "drive_poses_kitti.txt").write_text("\n".join(lines))
    np.testing.assert_allclose(open_dataset(tmp_path).world_from_sensor(), world_from_sensor)
    (tmp_path / "drive_poses_kitti.txt").write_text(lines[0])
    data = open_dataset(tmp_path)
    assert data.world_from_sensor() is None and "has 1 poses for 2 scans and is ignored" in data.note
    (tmp_path / "drive_poses_kitti.txt").write_text(lines[0] + "\n2 0 0 0 0 1 0 0 0 0 1 0\n")
    assert "not a rigid motion" in message(open_dataset, tmp_path)


def test_a_folder_of_two_kinds_is_refused(tmp_path):
    write_bin(tmp_path / "a.bin")
    write_numpy(tmp_path / "b.npy")
    assert "found 1 .bin and 1 .npy files" in message(open_dataset, tmp_path)


def test_folders_that_hold_nothing_to_read(tmp_path):
    (tmp_path / "empty").mkdir()
    assert "it is empty" in message(open_dataset, tmp_path / "empty")
    (tmp_path / "pictures").mkdir()
    for name in ("1.png", "2.png"):
        (tmp_path / "pictures" / name).touch()
    text = message(open_dataset, tmp_path / "pictures")
    assert "(found 2 .png); is this the 'velodyne' folder?" in text
    assert "found folders empty, pictures" in message(open_dataset, tmp_path)
    assert "no such folder" in message(open_dataset, tmp_path / "nowhere")
    (tmp_path / "velodyne").mkdir()
    assert "it is empty" in message(open_dataset, tmp_path / "velodyne")
    assert "is a file; expected a folder" in message(open_dataset, write_bin(tmp_path / "a.bin"))


def test_unknown_loader_names_the_nearest(tmp_path):
    assert "did you mean 'argoverse2'?" in message(open_dataset, tmp_path, "argoverse")
    assert "known are kitti, kitti_raw" in message(open_dataset, tmp_path, "zzz")
    names = loader_names()
    assert names[:len(LOADERS)] == list(LOADERS) and len(set(names)) == len(names) and "mulran" in names


# --- KITTI ---

CAMERA_FROM_LIDAR = pose.from_rotation_translation(
    [[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0.0, -0.08, -0.27])


def make_odometry(folder, names=("000000", "000001", "000002"), sequence="00"):
    place = folder / "sequences" / sequence
    for name in names:
        write_bin(place / "velodyne" / f"{name}.bin")
    calibration = " ".join(map(str, CAMERA_FROM_LIDAR[:3].ravel()))
    (place / "calib.txt").write_text(f"P0: 1 2 3\nTr: {calibration}\n")
    (place / "times.txt").write_text("".join(f"{0.1037 * i:e}\n" for i in range(len(names))))
    return place


def write_camera_poses(folder, world_from_lidar):
    camera_poses = CAMERA_FROM_LIDAR @ world_from_lidar @ pose.inverse(CAMERA_FROM_LIDAR)
    (folder / "poses").mkdir(exist_ok=True)
    lines = [" ".join(map(repr, m[:3].ravel().tolist())) for m in camera_poses]
    (folder / "poses" / "00.txt").write_text("\n".join(lines) + "\n")


def test_kitti_poses_are_those_of_the_lidar(tmp_path):
    place = make_odometry(tmp_path)
    world_from_lidar = np.stack([pose.from_yaw(0.05 * i, (0.8 * i, 0, 0)) for i in range(3)])
    write_camera_poses(tmp_path, world_from_lidar)
    for folder in (tmp_path, place, place / "velodyne"):
        data = open_dataset(folder)
        assert (data.loader, data.name, data.scan(2).time_ns) == ("kitti", "kitti 00", 207_400_000)
        np.testing.assert_allclose(data.world_from_sensor(), world_from_lidar, atol=1e-9)
        np.testing.assert_allclose(data.scan(0).points, correct_vertical_angle(POINTS))
        assert data.note == "KITTI vertical-angle correction on"
    with pytest.raises(ConfigError, match="kitti_correction: expected one of auto, on, off, got 'no'"):
        open_dataset(tmp_path, kitti_correction="no")
    off = open_dataset(tmp_path, kitti_correction="off")
    np.testing.assert_allclose(off.scan(0).points, POINTS)
    assert off.note == ""


def test_kitti_pose_lines_are_matched_to_scans(tmp_path):
    place = make_odometry(tmp_path, names=("000002", "000004"))
    world_from_lidar = np.stack([pose.from_translation([i, 0, 0]) for i in range(6)])
    write_camera_poses(tmp_path, world_from_lidar)
    np.testing.assert_allclose(open_dataset(place).world_from_sensor()[:, 0, 3], [2, 4], atol=1e-9)
    write_camera_poses(tmp_path, world_from_lidar[:3])
    data = open_dataset(place)
    assert data.world_from_sensor() is None and "00.txt has 3 poses for 2 scans and is ignored" in data.note
    (place / "calib.txt").write_text("P0: 1 2 3\n")
    assert "calib.txt has no Tr" in open_dataset(place).note


def test_kitti_sequences_are_chosen(tmp_path):
    make_odometry(tmp_path, sequence="00")
    make_odometry(tmp_path, sequence="07")
    assert "holds the sequences 00, 07; choose one with --sequence" in message(open_dataset, tmp_path)
    assert open_dataset(tmp_path, sequence="7").name == "kitti 07"
    for number in 0, np.int64(0):
        data = open_dataset(tmp_path, sequence=number)
        assert data.name == "kitti 00" and data.source.sequence == "0", "a run's files name it by a text"
    assert "no sequence '3'; there is 00, 07" in message(open_dataset, tmp_path, sequence="3")
    one = tmp_path / "sequences" / "07"
    assert "is the sequence '07', not '3'" in message(open_dataset, one, sequence="3")
    assert open_dataset(one / "velodyne", "kitti").name == "kitti 07"
    assert "expected KITTI odometry data" in message(open_dataset, tmp_path / "sequences", "kitti")


def test_only_bin_files_are_taken_for_uncorrected_kitti_data(tmp_path):
    (tmp_path / "velodyne").mkdir()
    write_numpy(tmp_path / "velodyne" / "1.npy")
    data = open_dataset(tmp_path)
    assert data.loader == "kitti_raw" and data.note == "10 Hz assumed"
    np.testing.assert_array_equal(data.scan(0).points, POINTS)


def write_truth(file, count, **changes):
    file.parent.mkdir(exist_ok=True)
    arrays = {"flow": np.ones((count, 3), np.float32), "valid": np.ones(count, bool),
              "dynamic": np.zeros(count, bool), "track": np.full(count, -1, np.int16),
              "target_from_source": np.eye(4)}
    np.savez(file, **{key: value for key, value in (arrays | changes).items() if value is not None})


@pytest.mark.parametrize("scans", ["velodyne", "velodyne_points/data"])
def test_kitti_raw_has_times_poses_and_truth(tmp_path, scans):
    for name in ("0000000004", "0000000005", "0000000007"):
        write_bin(tmp_path / scans / f"{name}.bin")
    (tmp_path / "ego_poses.txt").write_text("# none\n" + "".join(
        f"{i} 1 0 0 {i} 0 1 0 0 0 0 1 0\n" for i in range(8)))
    for name in ("0000000004", "0000000005", "0000000007"):
        write_truth(tmp_path / "truth" / f"{name}.npz", len(POINTS))
    for folder in (tmp_path, tmp_path / scans):
        data = open_dataset(folder)
        assert data.loader == "kitti_raw" and "correction on" in data.note
        np.testing.assert_allclose(data.world_from_sensor()[:, 0, 3], [4, 5, 7])
        assert data.truth(0).flow.shape == POINTS.shape
        assert data.truth(1) is None, "frame 6 is not there, and the truth speaks of it"
        assert data.truth(2) is None, "the last scan has no successor"
    write_truth(tmp_path / "truth" / "0000000004.npz", 3)
    assert "3 rows, but 0000000004.bin has 5 points" in message(open_dataset(tmp_path).truth, 0)
    write_truth(tmp_path / "truth" / "0000000004.npz", len(POINTS), track=None)
    assert "lacks track" in message(open_dataset(tmp_path).truth, 0)
    write_truth(tmp_path / "truth" / "0000000004.npz", len(POINTS), valid=np.ones(2, bool))
    assert "4.npz: 'valid': expected shape (5,), got (2,)" in message(open_dataset(tmp_path).truth, 0)
    for wrong, said in (
            ({"dynamic": np.zeros(5, np.uint8)}, "'dynamic': expected dtype bool, got uint8"),
            ({"track": np.array(list("abcde"))}, "'track': expected numbers, got <U1"),
            ({"target_from_source": np.ones((4, 4))}, "'target_from_source': expected a rigid motion"),
            ({"target_from_source": np.eye(3)}, "'target_from_source': expected shape (4, 4), got (3, 3)"),
            ({"category": np.full(5, 9)}, "'category': expected numbers of BACKGROUND, CAR"),
            ({"category": np.zeros(5)}, "'category': expected dtype int or unsigned int, got float64")):
        write_truth(tmp_path / "truth" / "0000000004.npz", len(POINTS), **wrong)
        assert f"0000000004.npz: {said}" in message(open_dataset(tmp_path).truth, 0)
    flow = np.zeros((len(POINTS), 3))
    flow[[1, 3], 2] = np.nan, np.inf
    write_truth(tmp_path / "truth" / "0000000004.npz", len(POINTS), flow=flow)
    assert ("0000000004.npz: 'flow': not finite in 2 valid rows, the first is row 1"
            in message(open_dataset(tmp_path).truth, 0))
    write_truth(tmp_path / "truth" / "0000000004.npz", len(POINTS), flow=flow, valid=np.isfinite(flow[:, 2]))
    assert open_dataset(tmp_path).truth(0).valid.sum() == len(POINTS) - 2


def test_kitti_raw_timestamps(tmp_path):
    for i in range(2):
        write_bin(tmp_path / "velodyne_points" / "data" / f"{i:010d}.bin")
    stamps = tmp_path / "velodyne_points" / "timestamps.txt"
    stamps.write_text("2011-09-26 13:02:25.951199337\n2011-09-26 13:02:26.05\n")
    data = open_dataset(tmp_path)
    assert data.scan(0).time_ns == 1317042145951199337
    assert data.scan(1).time_ns - data.scan(0).time_ns == 98_800_663
    stamps.write_text("yesterday\nnow\n")
    assert "expected a time like 2011-09-26" in message(open_dataset, tmp_path)


# --- Argoverse 2 ---

def make_argoverse(folder, log="7fab", times=(315966265259836000, 315966265360032000)):
    feather, pa = pytest.importorskip("pyarrow.feather"), pytest.importorskip("pyarrow")
    sweeps = folder / "val" / log / "sensors" / "lidar"
    sweeps.mkdir(parents=True)
    for time_ns in times:
        columns = {axis: POINTS[:, k].astype(np.float16) for k, axis in enumerate("xyz")}
        feather.write_feather(pa.table(columns), str(sweeps / f"{time_ns}.feather"))
    poses = {"timestamp_ns": [0, *times], "qw": [1.0] * 3, "qx": [0.0] * 3, "qy": [0.0] * 3, "qz": [0.0] * 3,
             "tx_m": [9.0, 1.0, 2.0], "ty_m": [0.0] * 3, "tz_m": [0.0] * 3}
    feather.write_feather(pa.table(poses), str(sweeps.parent.parent / "city_SE3_egovehicle.feather"))
    return sweeps


def test_argoverse_sweeps_poses_and_times(tmp_path):
    sweeps = make_argoverse(tmp_path)
    for folder in (tmp_path, tmp_path / "val", sweeps.parent.parent):
        data = open_dataset(folder)
        assert data.loader == "argoverse2" and "correction" not in data.note
        np.testing.assert_array_equal(data.scan(0).points, POINTS)
        assert data.scan(1).time_ns == 315966265360032000
        np.testing.assert_allclose(data.world_from_sensor()[:, 0, 3], [1, 2])
        assert data.truth(0) is None
    (sweeps / "315966265360032000.feather").write_bytes(b"ARROW1 and no more")
    assert "not a readable .feather table" in message(open_dataset(tmp_path).scan, 1)
    make_argoverse(tmp_path, "8aaa")
    assert "holds 2 logs; choose one with --sequence out of 7fab, 8aaa" in message(open_dataset, tmp_path)
    assert open_dataset(tmp_path, sequence="8").name == "argoverse2 8aaa"
    assert "0 logs are called 'x...'" in message(open_dataset, tmp_path, sequence="x")


def test_a_missing_pyarrow_is_named(tmp_path, monkeypatch):
    make_argoverse(tmp_path)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InstallError, match="pip install pyarrow"):
        open_dataset(tmp_path).scan(0)


# --- range images ---

def make_range_images(folder, pixels):
    height, width = pixels.shape
    Image.fromarray(pixels).save(folder / "scan00003.png")
    Image.fromarray(pixels.astype(np.uint8)).save(folder / "mask.png")
    (folder / "img.cfg").write_text(f"# w; h; azimuth; pitch\n{width}; {height}; 180; -180; -10; 0; 30")
    (folder / "imu.cfg").write_text("scans\n====\ntimestamp;#sats\n" + "".join(
        f"2010-03-11 13:49:1{i}.5;5;49.0;\n" for i in range(4)))


def test_range_images_keep_a_row_per_pixel(tmp_path):
    pixels = np.full((3, 4), 1000, np.uint16)
    pixels[1, 2] = 0
    make_range_images(tmp_path, pixels)
    data = open_dataset(tmp_path)
    points = data.scan(0).points.reshape(3, 4, 3)
    assert data.loader == "range_images" and len(data) == 1 and data.scan(0).time_ns == 1268315353500000000
    assert np.isnan(points[1, 2]).all() and np.isnan(points).sum() == 3
    np.testing.assert_allclose(points[1, 1], 2.0 * np.array([1, 1, 0]) / np.sqrt(2), atol=1e-12)
    np.testing.assert_allclose(points[2, 0], [-2 * np.cos(np.pi / 6) / np.sqrt(2),
                                              2 * np.cos(np.pi / 6) / np.sqrt(2), -1.0], atol=1e-12)
    (tmp_path / "img.cfg").write_text("4; 3; 180; -180; -20; 40")
    elevation_deg = np.degrees(np.arcsin(open_dataset(tmp_path).scan(0).points[::4, 2] / 2.0))
    np.testing.assert_allclose(elevation_deg, [10, -10, -30])


def test_damaged_range_images(tmp_path):
    make_range_images(tmp_path, np.zeros((3, 4), np.uint16))
    assert "empty scan" in message(open_dataset(tmp_path).scan, 0)
    (tmp_path / "img.cfg").write_text("5; 3; 180; -180; -10; 0; 30")
    assert "img.cfg says 16-bit (3, 5)" in message(open_dataset(tmp_path).scan, 0)
    (tmp_path / "img.cfg").write_text("5; 3; 180; -180; -10; 0; 30; 40")
    assert "with 4 pitch angles" in message(open_dataset, tmp_path)
    (tmp_path / "img.cfg").write_text("five")
    assert "expected a line 'width; height" in message(open_dataset, tmp_path)
    make_range_images(tmp_path, np.ones((3, 4), np.uint16))
    (tmp_path / "scan00003.png").write_bytes(b"PNG?")
    assert "not a readable PNG" in message(open_dataset(tmp_path).scan, 0)


# --- KISS-ICP's loaders ---

class FakeLoader:
    """Stands in for a loader of KISS-ICP."""

    def __init__(self, data_dir, **_):
        sys.stdout.write("reading a lot of things")
        self.gt_poses = pose.identity(3)
        self.resets, self.at = 0, 0

    def __len__(self):
        return 3

    def __getitem__(self, index):
        self.at += 1     # like a stream: whatever index is asked for, the next one comes
        return POINTS + self.at - 1, np.array([])

    def reset(self):
        self.resets, self.at = self.resets + 1, 0

    def get_frames_timestamps(self):
        return [1.7e9 + 0.2 * step for step in range(self.at)]


def fake_kiss(monkeypatch, factory):
    from kiss_icp import datasets
    monkeypatch.setattr(datasets, "dataset_factory", lambda name, folder, **kwargs: factory(folder, **kwargs))


def test_loaders_of_kiss_icp_are_wrapped_and_silenced(tmp_path, monkeypatch, capsys):
    fake_kiss(monkeypatch, FakeLoader)
    data = open_dataset(tmp_path, "rosbag")
    for index in (0, 1, 1, 2, 0):
        np.testing.assert_allclose(data.scan(index).points[0], POINTS[0] + index)
    assert data.scan(2).time_ns == 1_700_000_000_400_000_000 and data.scan(2).name == "000002"
    for _ in range(2):
        assert [scan.points[0, 0] - POINTS[0, 0] for scan in data] == pytest.approx([0, 1, 2])
    assert data[-1].name == "000002" and "no scan -4" in message(data.__getitem__, -4)
    np.testing.assert_allclose(data.world_from_sensor(), pose.identity(3))
    assert len(data) == 3 and data.truth(0) is None and "rosbag" in data.note
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("said, error, kind, found", [
    ("x is not installed, run \"pip install x\"", SystemExit(1), InstallError, "pip install x"),
    ("Multiple topics\n--topic /a\n--topic /b", SystemExit(1), DataError, "--sequence /a --sequence /b"),
    ("", SystemExit(1), DataError, "SystemExit"),
    ("", ModuleNotFoundError("No module", name="nuscenes"), InstallError, "pip install nuscenes"),
    ("noise", AssertionError("expects a PCAP\nreally"), DataError, "AssertionError: expects a PCAP"),
])
def test_a_failing_loader_of_kiss_icp_is_one_line(tmp_path, monkeypatch, capsys, said, error, kind, found):
    def fail(folder, **_):
        sys.stdout.write(said)
        raise error

    fake_kiss(monkeypatch, fail)
    with pytest.raises(kind) as caught:
        open_dataset(tmp_path, "mulran")
    assert found in str(caught.value) and "\n" not in str(caught.value)
    assert capsys.readouterr().out == ""


def test_loaders_of_kiss_icp_for_real(tmp_path):
    write_bin(tmp_path / "0.bin")
    np.testing.assert_allclose(open_dataset(tmp_path, "generic").scan(0).points, POINTS)
    assert "needs a sequence" in message(open_dataset, tmp_path, "helipr")
    assert "'mulran' failed" in message(open_dataset, tmp_path, "mulran")
    (tmp_path / "drive.mcap").touch()
    assert guess_loader(tmp_path / "drive.mcap") == "mcap"


def test_an_odd_item_of_a_kiss_icp_loader(tmp_path, monkeypatch):
    class Flat(FakeLoader):
        def __getitem__(self, index):
            return np.zeros((4, 2))

    fake_kiss(monkeypatch, Flat)
    assert "gave an array (4, 2) for scan 0" in message(open_dataset(tmp_path, "mulran").scan, 0)


# --- the shared recordings ---

@needs_shared
@pytest.mark.parametrize("folder, loader, scans, has_truth, has_poses", [
    ("kitti_tracked_0005_from_000", "kitti_raw", 6, True, True),
    ("kitti_tracked_0005_from_040", "kitti_raw", 6, True, True),
    ("kitti_raw_0048", "kitti_raw", 8, False, True),
    ("kitti_odometry_00_start", "kitti", 6, False, True),
    ("kitti_odometry_00_pair_094", "kitti", 2, False, True),
    ("kitti_odometry_00_pair_198", "kitti", 2, False, True),
    ("argoverse2", "argoverse2", 2, True, True),
    ("moosmann_durlacher_tor", "range_images", 52, False, True),
    ("ouster_os1_128", "folder", 3, False, True),
    ("mrpt_hdl32_vlp16", "folder", 5, False, False),
    ("opensceneflow_test_pair", "folder", 2, False, False),
    ("small_gicp_pair", "folder", 2, False, False),
])
def test_every_shared_folder_opens(folder, loader, scans, has_truth, has_poses):
    data = open_dataset(SHARED / folder)
    assert (data.loader, len(data)) == (loader, scans)
    source, target = data.scan(0), data.scan(1)
    assert len(source) > 15_000 and np.isfinite(source.points).all(axis=1).sum() > 15_000
    assert 0.09e9 < target.time_ns - source.time_ns < 0.11e9
    poses, truth = data.world_from_sensor(), data.truth(0)
    assert (truth is not None) == has_truth and (poses is not None) == has_poses
    if has_poses:
        assert poses.shape == (scans, 4, 4)
        assert pose.translation_distance(poses[0], poses[1]) < 1.0
    if has_truth:
        assert len(truth.flow) == len(source) and truth.is_dynamic.any()
        ego_flow = pose.apply(truth.ego_motion, source.points) - source.points
        still = truth.valid & ~truth.is_dynamic & (np.linalg.norm(source.points, axis=1) < 50)
        assert np.median(np.linalg.norm(truth.flow - ego_flow, axis=1)[still]) < 0.01
        assert (truth.object_id[truth.is_dynamic & truth.valid] >= 0).mean() > 0.9


@pytest.mark.parametrize("given", [None, b"scan.bin", 3, np.zeros((4, 3))])
def test_what_is_no_path_is_told_in_one_line(given):
    for read in (read_scan, open_dataset):
        found = rf"{read.__name__}: of type {type(given).__name__}; expected a path"
        with pytest.raises(InputError, match=found):
            read(given)


def test_an_organised_cloud_says_how_to_save_it(tmp_path):
    np.save(tmp_path / "scan.npy", np.ones((4, 5, 3)))
    with pytest.raises(DataError, match=r"array\.reshape\(-1, array\.shape\[2\]\)"):
        read_scan(tmp_path / "scan.npy")


def test_the_number_of_a_scan_is_whole(tmp_path):
    np.save(tmp_path / "scan.npy", np.ones((4, 3)))
    dataset = open_dataset(tmp_path)
    assert len(dataset.scan(np.int64(0)).points) == 4
    with pytest.raises(InputError, match=r"scan 0\.0; expected the number of a scan"):
        dataset.scan(0.0)
