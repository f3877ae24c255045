"""Reading cloud files: rows stay where the file has them, damaged files are one clear line."""

import numpy as np
import pytest
from cloud_files import (
    NAN,
    POINTS,
    WRITERS,
    message,
    write_bin,
    write_csv,
    write_named_csv,
    write_numpy,
    write_pcd,
    write_ply,
)
from command_line import drive

from lidarflow.datasets import guess_loader, open_dataset, read_points, read_scan
from lidarflow.datasets.kitti_correction import correct_vertical_angle


@pytest.mark.parametrize("name", WRITERS)
def test_rows_stay_where_the_file_has_them(tmp_path, name):
    points = read_points(WRITERS[name](tmp_path / name))
    assert points.dtype == np.float64 and points.flags.writeable
    np.testing.assert_array_equal(points, POINTS)


@pytest.mark.parametrize("name", ["out.pcd", "out.ply"])
@pytest.mark.parametrize("ascii", [True, False])
@pytest.mark.parametrize("compressed", [True, False])
def test_files_of_open3d_are_read_row_by_row(tmp_path, name, ascii, compressed):
    o3d = pytest.importorskip("open3d")
    points = np.random.default_rng(1).normal(size=(500, 3)).round(1)
    points[100] = NAN
    points[200:300] = 0.0     # long runs of equal bytes, which LZF packs
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    assert o3d.t.io.write_point_cloud(str(tmp_path / name), cloud, write_ascii=ascii, compressed=compressed)
    np.testing.assert_allclose(read_points(tmp_path / name), points, atol=1e-6)


def test_infinite_rows_become_nan(tmp_path):
    points = POINTS.copy()
    points[2, 1] = np.inf
    read = read_points(write_bin(tmp_path / "a.bin", points))
    assert np.isnan(read[2]).all() and len(read) == len(points)


def test_truncated_bin(tmp_path):
    file = tmp_path / "a.bin"
    file.write_bytes(b"\0" * 1003)
    assert "1003 bytes are not a multiple of 16" in message(read_points, file)


@pytest.mark.parametrize("columns", [3, 5, 6])
def test_a_bin_of_another_width_is_no_garbage(tmp_path, columns):
    rows = np.random.default_rng(0).uniform(-50, 50, (400, columns)).astype("<f4")     # 16 bytes divide them
    rows[:, 3:] = np.arange(columns - 3) + 7
    rows.tofile(tmp_path / "a.bin")
    said = message(read_points, tmp_path / "a.bin")
    assert f"of {100 * columns} points is no reflectance (0 to 65535)" in said and "as .npy" in said


@pytest.mark.parametrize("fourth", [0.0, 0.99, 255.0, 65535.0])
def test_whatever_a_sensor_calls_reflectance_is_read(tmp_path, fourth):
    rows = np.full((400, 4), fourth, "<f4")
    rows[:, :3] = np.random.default_rng(0).uniform(-50, 50, (400, 3))
    rows[3], rows[5, 3] = NAN, -1.0     # no return, and a damaged one
    rows.tofile(tmp_path / "a.bin")
    np.testing.assert_array_equal(read_points(tmp_path / "a.bin"), rows[:, :3])


@pytest.mark.parametrize("odd", [-1.0, NAN, np.inf, 1e9])
def test_no_sensor_has_such_reflectances(tmp_path, odd):
    rows = np.ones((400, 4), "<f4")
    rows[:5, 3] = odd
    rows.tofile(tmp_path / "a.bin")
    assert "fourth number of 5 of 400 points" in message(read_points, tmp_path / "a.bin")


def test_files_of_nuscenes_have_five_numbers_a_point(tmp_path):
    rows = np.column_stack([POINTS, np.full(5, 12.0), np.arange(5)]).astype("<f4")
    rows = np.tile(rows, (4, 1))
    rows.tofile(tmp_path / "a.pcd.bin")
    np.testing.assert_array_equal(read_points(tmp_path / "a.pcd.bin"), np.tile(POINTS, (4, 1)))
    rows[:, :4].tofile(tmp_path / "b.pcd.bin")
    assert "the fifth number of" in message(read_points, tmp_path / "b.pcd.bin")
    rows[:3, :4].tofile(tmp_path / "c.pcd.bin")
    assert "48 bytes are not a multiple of 20" in message(read_points, tmp_path / "c.pcd.bin")


@pytest.mark.parametrize("suffix", [".bin", ".pcd", ".ply", ".npy", ".npz", ".xyz", ".csv"])
def test_empty_file(tmp_path, suffix):
    file = tmp_path / f"a{suffix}"
    file.touch()
    assert "empty file (0 bytes)" in message(read_points, file)


@pytest.mark.parametrize("name", ["a.npy", "a.xyz", "a.npz", "a.csv", "b.csv"])
def test_a_cloud_without_points(tmp_path, name):
    file = tmp_path / name
    if file.suffix in (".xyz", ".csv"):
        file.write_text("x,y,z\n" if name == "b.csv" else "# nothing\n")
    else:
        write_numpy(file, POINTS[:0])
    assert "empty scan (0 points)" in message(read_points, file)


def test_a_cloud_without_a_finite_point(tmp_path):
    file = write_bin(tmp_path / "a.bin", np.full((4, 3), NAN))
    assert "empty scan (none of 4 points is finite)" in message(read_points, file)


def test_what_is_not_a_cloud_file(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"x")
    text = message(read_points, tmp_path / "a.jpg")
    assert "unknown kind of point cloud '.jpg'; known are .bin .pcd" in text
    assert "no such file" in message(read_points, tmp_path / "b.bin")
    assert "is a folder" in message(read_points, tmp_path)


@pytest.mark.parametrize("array, found", [
    (np.zeros((5, 2)), "(5, 2) of float64"),
    (np.zeros(9), "(9,) of float64"),
    (np.zeros((5, 3), complex), "complex128"),
    (np.array([["a", "b", "c"]]), "<U1"),
    (np.zeros((3, 500)), "(3, 500); expected a row (N, 3) for each point, this looks transposed"),
    (np.array([{}, []], dtype=object), "not a readable .npy array"),
])
def test_wrong_npy(tmp_path, array, found):
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    assert found in message(read_points, tmp_path / "a.npy")


def test_truncated_and_mislabelled_npy(tmp_path):
    file = write_numpy(tmp_path / "a.npy")
    file.write_bytes(file.read_bytes()[:-10])
    assert "not a readable .npy array" in message(read_points, file)
    write_numpy(tmp_path / "b.npz").rename(tmp_path / "b.npy")
    assert "rename it" in message(read_points, tmp_path / "b.npy")


def test_npz_prefers_points_and_refuses_a_choice(tmp_path):
    np.savez(tmp_path / "a.npz", points=POINTS, flow=POINTS + 1)
    np.testing.assert_array_equal(read_points(tmp_path / "a.npz"), POINTS)
    np.savez(tmp_path / "b.npz", one=POINTS, two=POINTS)
    assert "expected an array 'points' (N, 3)" in message(read_points, tmp_path / "b.npz")
    (tmp_path / "c.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:-30])
    assert "not an .npz archive, or a truncated one" in message(read_points, tmp_path / "c.npz")


@pytest.mark.parametrize("storage, found", [
    ("ascii", "header says 900000000 points, but 5 lines follow"),
    ("binary", "header says 900000000 points of 22 bytes, but only 110 bytes follow"),
    ("binary_compressed", "the file is damaged"),
])
def test_pcd_header_that_promises_too_much(tmp_path, storage, found):
    file = write_pcd(tmp_path / "a.pcd", storage, declared=900_000_000)
    assert found in message(read_points, file)


@pytest.mark.parametrize("old, new, found", [
    (b"FIELDS intensity x y z", b"FIELDS intensity a b c", "expected x, y and z among them"),
    (b"SIZE 4 4 4 4 2", b"SIZE 4 4 4 4", "5 FIELDS, but 4 SIZE"),
    (b"TYPE F F F F U", b"TYPE F F F Q U", "TYPE Q"),
    (b"COUNT 1 1 1 1 3", b"COUNT 1 1 1 1 99999999999", "no more than 4096"),
    (b"POINTS 5", b"POINTS 6", "POINTS says 6, WIDTH x HEIGHT 5"),
    (b"POINTS 5", b"POINTS -5", "POINTS '-5'"),
    (b"DATA ascii", b"DATA zipped", "DATA zipped; expected ascii"),
    (b"DATA ascii", b"", "no line 'DATA'"),
    (b"4.5 -5.0", b"4.5 abc", "expected lines of 7 numbers"),
    (b"4.5 -5.0 6.25", b"4.5", "expected lines of 7 numbers"),
])
def test_damaged_pcd(tmp_path, old, new, found):
    file = write_pcd(tmp_path / "a.pcd", "ascii")
    content = file.read_bytes()
    assert old in content
    file.write_bytes(content.replace(old, new))
    assert found in message(read_points, file)


def test_packed_pcd_that_cannot_be_unpacked(tmp_path):
    file = write_pcd(tmp_path / "a.pcd", "binary_compressed")
    content = file.read_bytes()
    start = content.index(b"compressed\n") + len(b"compressed\n") + 8
    file.write_bytes(content[:start] + b"\xff\xff\xff" + content[start + 3:])
    assert "cannot be unpacked" in message(read_points, file)
    file.write_bytes(content[:-5])
    assert "packed bytes announced" in message(read_points, file)


@pytest.mark.parametrize("storage", ["ascii", "binary_little_endian"])
def test_ply_header_that_promises_too_much(tmp_path, storage):
    file = write_ply(tmp_path / "a.ply", storage, declared=900_000_000)
    assert "header says 900000000 points" in message(read_points, file)


@pytest.mark.parametrize("old, new, found", [
    (b"ply\n", b"plx\n", "does not start with 'ply'"),
    (b"format ascii", b"format utf8", "format 'utf8'"),
    (b"element vertex 5\n", b"", "expected 'vertex' as the first"),
    (b"property double y\n", b"", "expected x, y and z among them"),
    (b"property uchar intensity", b"property list uchar int a", "expected plain numbers"),
    (b"end_header\n", b"", "no line 'end_header'"),
    (b"4.5 -5.0", b"4.5", "expected lines of 4 numbers"),
])
def test_damaged_ply(tmp_path, old, new, found):
    file = write_ply(tmp_path / "a.ply", "ascii")
    file.write_bytes(file.read_bytes().replace(old, new))
    assert found in message(read_points, file)


# --- tables of commas ---

ROWS = "1,2,3,0.5\n4.5,-5,6.25,1\n"
READ = np.array([[1.0, 2.0, 3.0], [4.5, -5.0, 6.25]])


@pytest.mark.parametrize("text", [
    ROWS, "# made by hand\n" + ROWS, "x,y,z,intensity\n" + ROWS, "X, Y ,Z,i\n" + ROWS, "# x,y,z,i\n" + ROWS,
    ROWS.replace("\n", "\r\n"), "//X,Y,Z,I\n" + ROWS, '\ufeff"x","y","z","i"\n' + ROWS,
    "\n\nx,y,z,i\n\n" + ROWS,
    "z,n,x,y\n3,a,1,2\n6.25,b,4.5,-5\n", 'name,x,y,z\n"a, b",1,2,3\n"c",4.5,-5,6.25\n',
    ",x,y,z\n0,1,2,3\n1,4.5,-5,6.25\n", ROWS.replace(",", ", "),
    "x,y,z,colour\n1,2,3,#ff0000\n4.5,-5,6.25,#0\n",
])
def test_tables_of_commas_are_read_by_name_or_by_place(tmp_path, text):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(read_scan(tmp_path / "a.csv").points, READ)


def test_what_is_not_finite_in_a_table_is_a_row_of_its_own(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n1,nan,3\n1,2,-inf\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv"), [[1, 2, 3], [NAN] * 3, [NAN] * 3])


@pytest.mark.parametrize("text, found", [
    ("a,b,c\n1,2,3\n", "its first line says a, b, c; expected numbers, or names of columns with x, y and z"),
    ("x;y;z\n1;2;3\n", "its first line says x;y;z; expected"),
    ("frame,x,y\n0,1,2\n", "x, y and z among them"),
    ("x,y,z,x\n1,2,3,4\n", "has 2 columns x; expected one of each name"),
    ("x,y,z,i\n1,2,3,4\n1,2,3\n", "row 2 has 3 columns, but the first line names 4; the file is truncated"),
    ("x,y,z\n1,2,\n", "expected rows of numbers x y z (could not convert string '' to float64"),
    ("x,y,z\n1,two,3\n", "expected rows of numbers x y z (could not convert string 'two'"),
    ("1,2,3\n1,two,3\n", "expected rows of numbers x y z (could not convert string 'two'"),
    ("1,2,3\n1,2\n", "expected rows of numbers x y z (the number of columns changed from 3 to 2"),
    ("1,2,3,4\n4,,5,6\n", "expected rows of numbers x y z (could not convert string ''"),
    ("1,,2,3\n4,,5,6\n", "its first line says 1, , 2, 3; expected numbers"),
    ("1,2\n3,4\n", "an array (2, 2) of float64; expected numbers (N, 3) or wider"),
    (",".join("1" * 40) + "\n" + ",".join("2" * 40) + "\n", "this looks transposed"),
])
def test_damaged_tables(tmp_path, text, found):
    (tmp_path / "a.csv").write_text(text)
    assert found in message(read_points, tmp_path / "a.csv")


def test_a_table_that_is_no_text(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe1,2,3\n")
    assert "expected rows of numbers x y z ('utf-8' codec" in message(read_points, tmp_path / "a.csv")


def test_tables_are_scans_where_there_are_no_others(tmp_path):
    for k in range(3):
        (tmp_path / f"{k}.csv").write_text(ROWS)
    (tmp_path / "boxes.csv").write_text("frame,track\n")
    data = open_dataset(tmp_path)
    assert data.loader == "folder" and [data.scan(k).name for k in range(len(data))] == ["0", "1", "2"]
    write_bin(tmp_path / "0.bin")
    assert [file.name for file in open_dataset(tmp_path).files] == ["0.bin"]
    (tmp_path / "0.bin").unlink()
    (tmp_path / "a.bag").touch()
    assert guess_loader(tmp_path) == "rosbag"


# --- the KITTI correction ---

def test_correction_raises_by_205_thousandths_of_a_degree_and_keeps_rows():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3)) * 20
    points[7], points[8], points[9], points[10] = NAN, 0.0, (0, 0, 5), (1, NAN, 2)
    before = points.copy()
    raised = correct_vertical_angle(points)
    np.testing.assert_array_equal(points, before)
    kept = [7, 8, 9, 10]
    np.testing.assert_array_equal(raised[kept], points[kept])
    others = np.setdiff1d(np.arange(50), kept)
    elevation = [np.degrees(np.arctan2(p[others, 2], np.hypot(p[others, 0], p[others, 1])))
                 for p in (points, raised)]
    np.testing.assert_allclose(elevation[1] - elevation[0], 0.205, atol=1e-9)
    np.testing.assert_allclose(*(np.linalg.norm(p[others], axis=1) for p in (points, raised)))


def test_a_single_bin_is_corrected_where_kitti_puts_it(tmp_path):
    inside = write_bin(tmp_path / "velodyne" / "7.bin")
    raw = write_bin(tmp_path / "velodyne_points" / "data" / "7.bin")
    outside = write_bin(tmp_path / "data" / "7.bin")
    raised = correct_vertical_angle(POINTS)
    np.testing.assert_allclose(read_scan(inside).points, raised)
    np.testing.assert_allclose(read_scan(raw).points, raised)
    np.testing.assert_allclose(read_scan(outside).points, POINTS)
    np.testing.assert_allclose(read_scan(inside, "off").points, POINTS)
    np.testing.assert_allclose(read_scan(outside, "on").points, raised)
    assert read_scan(inside).name == "7"


@pytest.mark.parametrize("named", [False, True])
def test_tables_of_commas_give_the_flow_of_any_other_cloud(lidarflow, tmp_path, named):
    write = write_named_csv if named else write_csv
    for k, (scan, _) in enumerate(drive()[:2]):
        write_numpy(tmp_path / f"{k}.npy", scan.points)
        write(tmp_path / f"{k}.csv", scan.points.astype(np.float32))
    for kind in ("npy", "csv"):
        lidarflow.ok("pair", tmp_path / f"0.{kind}", tmp_path / f"1.{kind}", "--method", "zero",
                     "--out", tmp_path / kind / "flow.npz")
    assert (tmp_path / "npy" / "flow.npz").read_bytes() == (tmp_path / "csv" / "flow.npz").read_bytes()
