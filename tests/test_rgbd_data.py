"""RGB-D images, cameras and folders from disk, and what is said of those that cannot be used."""

import json
import os
import warnings
from dataclasses import asdict

import numpy as np
import pytest
from PIL import Image
from rgbd_worlds import QVGA, copied, frames
from shared_data import SHARED, needs_shared

from lidarflow import pose, synthetic
from lidarflow.datasets import rgbd_folders, rgbd_images, tum
from lidarflow.datasets.rgbd_folders import CameraChoice, open_rgbd
from lidarflow.errors import ConfigError, DataError, LidarflowError
from lidarflow.rgbd import RgbdEstimator, estimate_flow
from lidarflow.rgbd_methods import Open3dOdometry
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdPair

MS = 1_000_000
CAMERA = "width = 8\nheight = 6\nfx = 7.5\nfy = 7\ncx = 3.5\ncy = 2.5\n"


@pytest.fixture
def images(tmp_path):
    """A colour and a depth image of 8x6 pixels; the depth of pixel (row, column) is 1 + 0.1 column metres."""
    color = np.zeros((6, 8, 3), np.uint8)
    color[..., 0], color[2, 3] = 255, (10, 200, 30)
    depth = np.repeat(5000 + 500 * np.arange(8, dtype=np.uint16)[None], 6, axis=0)
    depth[0, 0] = 0
    Image.fromarray(color).save(tmp_path / "color.png")
    Image.fromarray(depth).save(tmp_path / "depth.png")
    return tmp_path / "color.png", tmp_path / "depth.png"


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Four rendered frames as a TUM folder."""
    place = tmp_path_factory.mktemp("tum") / "room"
    synthetic.write_tum(place, frames(), QVGA)
    return place


# Images

def test_a_frame_is_luma_and_metres(images):
    frame = rgbd_images.read_frame(*images)
    assert frame.intensity[0, 0] == pytest.approx(0.299)
    assert frame.intensity[2, 3] == pytest.approx((0.299 * 10 + 0.587 * 200 + 0.114 * 30) / 255)
    np.testing.assert_allclose(frame.depth[1], 1.0 + 0.1 * np.arange(8), rtol=1e-6)
    assert frame.depth[0, 0] == 0 and frame.depth.dtype == np.float32 and frame.name == "color"
    assert rgbd_images.read_frame(*images, depth_scale=1000.0).depth[1, 2] == pytest.approx(6.0)


@pytest.mark.parametrize(("mode", "suffix"), [("RGBA", "png"), ("L", "png"), ("P", "png"), ("RGB", "jpg")])
def test_colour_may_have_any_8_bit_form(images, tmp_path, mode, suffix):
    file = tmp_path / f"other.{suffix}"
    Image.open(images[0]).convert(mode).save(file)
    found = rgbd_images.read_color(file)
    assert found.shape == (6, 8, 3) and found.dtype == np.uint8
    if mode == "RGBA":
        np.testing.assert_array_equal(found, np.asarray(Image.open(images[0])))


def test_images_that_are_no_frame(images, tmp_path):
    color, depth = images
    Image.fromarray(np.zeros((6, 8), np.uint16)).save(tmp_path / "black.png")
    Image.fromarray(np.full((6, 8), 9, np.uint8)).save(tmp_path / "shallow.png")
    Image.fromarray(np.full((6, 9), 900, np.uint16)).save(tmp_path / "wide.png")
    Image.fromarray(np.ones((6, 8), np.float32)).save(tmp_path / "float.tiff")
    (tmp_path / "text.png").write_text("no image")
    for pair, found in (((depth, color), "swapped"), ((color, color), "swapped"), ((depth, depth), "swapped"),
                        ((color, tmp_path / "black.png"), "no pixel has depth"),
                        ((color, tmp_path / "shallow.png"), "8-bit image"),
                        ((color, tmp_path / "wide.png"), "9x6 pixels, but .* has 8x6"),
                        ((color, tmp_path / "float.tiff"), "mode F"),
                        ((color, tmp_path / "text.png"), r"readable image \(cannot identify image file\)"),
                        ((color, tmp_path / "none.png"), "no such file"), ((tmp_path, depth), "is a folder")):
        with pytest.raises(DataError, match=found):
            rgbd_images.read_frame(*pair)
    for scale in (0.0, -5.0, np.nan, np.inf):
        with pytest.raises(DataError, match="--depth-scale"):
            rgbd_images.read_frame(color, depth, scale)


@pytest.mark.parametrize("which", [0, 1])
def test_a_truncated_png_is_refused_wherever_it_ends(tmp_path, which):
    frame = frames()[0][0]
    for name, image in (("color", frame.color), ("depth", (frame.depth * 5000).astype(np.uint16))):
        Image.fromarray(image).save(tmp_path / f"{name}.png")
    files = tmp_path / "color.png", tmp_path / "depth.png"
    whole = files[which].read_bytes()
    for size in (0, 7, 20, 33, 60, len(whole) // 2, len(whole) - 40):
        files[which].write_bytes(whole[:size])
        with pytest.raises(DataError, match=files[which].name):
            rgbd_images.read_frame(*files)


def test_an_image_that_says_it_is_huge_is_not_unpacked(tmp_path):
    Image.fromarray(np.zeros((2, 2), np.uint8)).save(tmp_path / "small.png")
    lying = bytearray((tmp_path / "small.png").read_bytes())
    for size in (20_000, 2_000_000):
        lying[16:24] = size.to_bytes(4, "big") * 2
        (tmp_path / "small.png").write_bytes(lying)
        with pytest.raises(DataError, match=r"small.png"):
            rgbd_images.read_color(tmp_path / "small.png")


# Cameras

def test_a_camera_file(tmp_path):
    file = tmp_path / "camera.toml"
    file.write_text(CAMERA)
    assert rgbd_images.read_camera(file) == Camera(8, 6, 7.5, 7.0, 3.5, 2.5)
    for text, found in ((CAMERA + "fz = 1", "unknown fz"), ("width = 8", "lacks height, fx"),
                        (CAMERA.replace("7.5", "'7.5'"), "fx is '7.5'"),
                        (CAMERA.replace("width = 8", "width = 8.0"), "width is 8.0"),
                        (CAMERA.replace("height = 6", "height = true"), "height is True"),
                        (CAMERA.replace("7.5", "-1"), "positive focal"),
                        (CAMERA.replace("7.5", "inf"), "finite"),
                        (CAMERA.replace("width = 8", "width = 0"), "width is 0; expected a positive")):
        file.write_text(text)
        with pytest.raises(DataError, match=found):
            rgbd_images.read_camera(file)
    file.write_text("fx: 3")
    with pytest.raises(ConfigError, match="not valid TOML"):
        rgbd_images.read_camera(file)
    with pytest.raises(ConfigError, match="no such camera file"):
        rgbd_images.read_camera(tmp_path / "none.toml")


def test_the_camera_is_what_the_user_says_else_what_the_folder_says_else_nominal(images, tmp_path):
    color, _ = images
    choose = rgbd_folders.choose_camera
    camera, origin = choose(color, CameraChoice(), tmp_path)
    assert camera == Camera.from_field_of_view(8, 6) and "nominal" in origin
    assert (camera.cx, camera.cy) == (3.5, 2.5)
    assert 2 * np.degrees(np.arctan(4 / camera.fx)) == pytest.approx(62.5)
    (tmp_path / "camera.toml").write_text(CAMERA)
    assert choose(color, CameraChoice(), tmp_path)[0].fx == 7.5
    assert choose(color, CameraChoice(), None)[0] == camera
    assert choose(color, CameraChoice(intrinsics=(5, 6, 3, 2)), tmp_path)[0] == Camera(8, 6, 5, 6, 3, 2)
    (tmp_path / "other.toml").write_text(CAMERA.replace("7.5", "9.5"))
    assert choose(color, CameraChoice(tmp_path / "other.toml"), tmp_path)[0].fx == 9.5
    with pytest.raises(DataError, match="both are given"):
        choose(color, CameraChoice(tmp_path / "other.toml", (5, 6, 3, 2)), tmp_path)
    with pytest.raises(DataError, match="--intrinsics"):
        choose(color, CameraChoice(intrinsics=(0, 6, 3, 2)))
    (tmp_path / "other.toml").write_text(CAMERA.replace("width = 8", "width = 16"))
    with pytest.raises(DataError, match=r"16x6 pixels, but .*color.png has 8x6"):
        choose(color, CameraChoice(tmp_path / "other.toml"), tmp_path)


@pytest.mark.parametrize(("name", "fx"), [
    ("rgbd_dataset_freiburg1_desk", 517.3), ("freiburg2_xyz", 520.9), ("fr3_walking_xyz", 535.4),
    ("rgbd_tum_fr1_desk9", 517.3), ("fr12", None), ("freiburg4", None), ("afr1", None), ("room", None)])
def test_freiburg_cameras_are_guessed_from_the_name(tmp_path, name, fx):
    image = tmp_path / "image.png"
    Image.fromarray(np.zeros((480, 640), np.uint8)).save(image)
    camera, origin = rgbd_folders.choose_camera(image, CameraChoice(), tmp_path / name)
    assert camera.fx == pytest.approx(fx or Camera.from_field_of_view(640, 480).fx)
    assert ("guessed" in origin) == (fx is not None)


# Association and poses in time

def test_association_takes_the_nearest_first_and_each_image_once():
    first = np.array([0, 30, 60, 100, 200]) * MS
    second = np.array([18, 25, 62, 81, 121, 180]) * MS
    # 60-62 (2), 30-25 (5), 0-18 (18), 100-81 (19), 200-180 (20); 121 stays alone.
    np.testing.assert_array_equal(tum.associate(first, second), [[0, 0], [1, 1], [2, 2], [3, 3], [4, 5]])
    # 10 is nearer to 12 than 0 is, so 0 has nothing left within 20 ms but 18.
    np.testing.assert_array_equal(tum.associate(np.array([0, 10]) * MS, np.array([12, 18]) * MS),
                                  [[0, 1], [1, 0]])
    assert tum.associate(first, second + 1000 * MS).shape == (0, 2)
    assert tum.associate(np.array([0]), np.array([20 * MS + 1])).shape == (0, 2)


def test_how_near_two_lists_of_times_come():
    def least(first, second):
        return tum.least_apart_ns(np.array(first), np.array(second))

    assert least([0, 100], [40, 170]) == 40 and least([5], [1]) == 4
    assert least([5], [7, 9]) == 2 and least([5, 20], [1]) == 4


def test_poses_are_interpolated_between_neighbours_and_unknown_elsewhere():
    rng = np.random.default_rng(2)
    known_ns = np.array([0, 10, 20, 400]) * MS
    poses = pose.exp(rng.normal(scale=0.2, size=(4, 6)))
    found = tum.poses_at(np.array([-5, 0, 14, 20, 100, 400, 401]) * MS, known_ns, poses)
    assert np.isnan(found[[0, 4, 6]]).all()
    np.testing.assert_array_equal(found[[1, 3, 5]], poses[[0, 2, 3]])
    np.testing.assert_allclose(found[2], pose.interpolate(poses[1], poses[2], 0.4), atol=1e-12)


# Folders

def test_a_written_folder_reads_back(folder):
    found = open_rgbd(folder)
    assert len(found) == 4 and found.layout == "tum" and found.name == "tum room"
    assert found.camera == QVGA and "camera.toml" in str(found.notes) and "pixel/5000" in str(found.notes)
    for k, (frame, truth) in enumerate(frames()):
        read = found.frame(k)
        np.testing.assert_array_equal(read.color, frame.color)
        np.testing.assert_allclose(read.intensity, frame.intensity, atol=1e-6)
        np.testing.assert_allclose(read.depth, frame.depth, atol=1.01e-4)
        assert read.time_ns == pytest.approx(frame.time_ns, abs=1000) and read.name == f"{k / 30:.6f}"
        if truth is None:
            assert found.truth(k) is None
        else:
            np.testing.assert_array_equal(found.truth(k).flow, truth.flow)
    poses = found.world_from_camera()
    np.testing.assert_allclose(pose.inverse(poses[1]) @ poses[0], frames()[0][1].odometry, atol=1e-7)


def test_frames_are_iterated_and_indexed(folder):
    opened = open_rgbd(folder)
    names = [opened.frame(k).name for k in range(4)]
    assert [frame.name for frame in opened] == names and opened[-1].name == names[3]
    np.testing.assert_array_equal(opened[1].depth, opened.frame(1).depth)
    for ask, index in ((opened.frame, 4), (opened.frame, -1), (opened.__getitem__, -5)):
        with pytest.raises(IndexError) as caught:
            ask(index)
        assert isinstance(caught.value, DataError)
        assert str(caught.value) == f"{opened.name}: no frame {index}; there are 4, from 0 on"


def test_images_that_are_listed_but_missing_are_passed_over(folder, tmp_path):
    place = copied(folder, tmp_path / "part")
    for kind in ("rgb", "depth"):
        with (place / f"{kind}.txt").open("a") as file:
            file.write(f"7.000000 {kind}/7.000000.png\n8.000000 {kind}/8.000000.png\n")
    found = open_rgbd(place)
    assert len(found) == 4 and "2 of 6 images in rgb.txt are missing" in str(found.notes)


def test_depth_that_is_late_is_found_and_colour_without_depth_is_left_out(folder, tmp_path):
    place = copied(folder, tmp_path / "late")
    rows = [row.split() for row in (place / "depth.txt").read_text().splitlines()[2:]]
    late = "".join(f"{float(stamp) + 0.012:.6f} {name}\n" for stamp, name in rows[:1] + rows[2:])
    (place / "depth.txt").write_text(late)
    found = open_rgbd(place)
    assert len(found) == 3 and "1 of 4 colour images have no depth within 20 ms" in str(found.notes)
    assert [found.frame(k).name for k in range(3)] == ["0.000000", "0.066667", "0.100000"]
    np.testing.assert_allclose(found.frame(1).depth, frames()[2][0].depth, atol=1.01e-4)


def test_folders_that_are_no_sequence(folder, tmp_path):
    for name, change, said in (
        ("far", lambda p: (p / "depth.txt").write_text("5.0 depth/0.000000.png\n6.0 depth/0.033333.png\n"),
         "within 20 ms of each other .4 and 2 images, the nearest 4.900 s apart"),
        ("gone", lambda p: (p / "rgb.txt").write_text("0.0 rgb/a.png\n"), "none of the 1 images"),
        ("bare", lambda p: (p / "rgb.txt").write_text("# nothing\n"), "lists no image"),
        ("half", lambda p: (p / "depth.txt").unlink(), "only one of rgb.txt and depth.txt"),
        ("words", lambda p: (p / "rgb.txt").write_text("now rgb/a.png\n"), "got 'now rgb/a.png'"),
        ("times", lambda p: (p / "rgb.txt").write_text("nan rgb/a.png\n"), "seconds filename"),
        ("short", lambda p: (p / "groundtruth.txt").write_text("0.0 1 2 3\n"), "8 finite numbers"),
        ("zero", lambda p: (p / "groundtruth.txt").write_text("0.0 1 2 3 0 0 0 0\n"), "unit length")):
        place = copied(folder, tmp_path / name)
        change(place)
        with pytest.raises(DataError, match=said):
            open_rgbd(place)
    (tmp_path / "empty").mkdir()
    for place, said in ((tmp_path / "empty", "expected rgb.txt"), (tmp_path / "nowhere", "no such folder"),
                        (folder / "rgb.txt", "is a file")):
        with pytest.raises(DataError, match=said):
            open_rgbd(place)


def test_truth_of_another_size_is_refused(folder, tmp_path):
    place = copied(folder, tmp_path / "odd")
    (place / "truth").unlink()
    (place / "truth").mkdir()
    truth = frames()[0][1]
    np.savez(place / "truth" / "0.000000.npz", flow=truth.flow[:-1], valid=truth.valid[:-1],
             is_dynamic=truth.is_dynamic[:-1], odometry=truth.odometry)
    with pytest.raises(DataError, match="320x239"):
        open_rgbd(place).truth(0)
    np.savez(place / "truth" / "0.000000.npz", flow=truth.flow, valid=truth.valid, odometry=truth.odometry,
             is_dynamic=truth.is_dynamic.astype(int))
    with pytest.raises(DataError, match=r"0\.000000\.npz: 'is_dynamic': expected dtype bool, got int64"):
        open_rgbd(place).truth(0)
    assert open_rgbd(place).truth(1) is None


def write_images(place, color_name, depth_name, scale=1000):
    """Three frames of the room under names with a number, depth in pixels of 1/scale metre."""
    for k in range(3):
        frame = frames()[k][0]
        files = place / color_name.format(k), place / depth_name.format(k)
        for file, image in zip(files, (frame.color, (frame.depth * scale).astype(np.uint16)), strict=True):
            file.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(image).save(file)


def test_color_and_depth_folders_as_open3d_has_them(tmp_path):
    write_images(tmp_path, "color/{:05d}.jpg", "depth/{:05d}.png")
    poses = pose.exp(np.random.default_rng(1).normal(scale=0.1, size=(3, 6)))
    log = "".join(f"{k} {k} {k + 1}\n" + "".join(" ".join(f"{v:.12f}" for v in row) + "\n" for row in motion)
                  for k, motion in enumerate(poses))
    (tmp_path / "trajectory.log").write_text(log)
    found = open_rgbd(tmp_path)
    assert len(found) == 3 and "pixel/1000" in str(found.notes) and "30 frames a second" in str(found.notes)
    np.testing.assert_allclose(found.frame(2).depth, frames()[2][0].depth, atol=1.1e-3)
    np.testing.assert_allclose(found.world_from_camera(), poses, atol=1e-10)
    np.testing.assert_allclose(open_rgbd(tmp_path, depth_scale=500.0).frame(0).depth,
                               2.0 * found.frame(0).depth, rtol=1e-6)
    (tmp_path / "trajectory.log").write_text(log + "9 9 10\n")
    found = open_rgbd(tmp_path)
    assert found.world_from_camera() is None and "trajectory.log has 16 lines" in str(found.notes)
    (tmp_path / "trajectory.log").write_text(log.replace(".", ".9"))
    with pytest.raises(DataError, match="rigid"):
        open_rgbd(tmp_path)
    os.rename(tmp_path / "depth" / "00001.png", tmp_path / "depth" / "00007.png")
    with pytest.raises(DataError, match="color/00001"):
        open_rgbd(tmp_path)
    (tmp_path / "depth" / "00007.png").unlink()
    with pytest.raises(DataError, match="3 images in color and 2 in depth"):
        open_rgbd(tmp_path)


def test_numbered_images_in_one_folder(tmp_path):
    write_images(tmp_path, "color{}.png", "depth{}.png", scale=5000)
    (tmp_path / "colormap.png").touch()
    found = open_rgbd(tmp_path)
    assert len(found) == 3 and "pixel/5000" in str(found.notes) and found.camera == QVGA
    np.testing.assert_allclose(found.frame(1).depth, frames()[1][0].depth, atol=2.1e-4)
    (tmp_path / "color_01.png").write_bytes((tmp_path / "color1.png").read_bytes())
    with pytest.raises(DataError, match=r"color1\.png and color_01\.png have one number"):
        open_rgbd(tmp_path)
    (tmp_path / "color_01.png").unlink()
    (tmp_path / "depth1.png").unlink()
    with pytest.raises(DataError, match="3 images named color<number> and 2 named depth<number>"):
        open_rgbd(tmp_path)


def test_images_whose_results_would_share_a_file_are_refused(images, tmp_path):
    for image in images:
        for name in ("1.png", "1.jpg"):
            (tmp_path / image.stem).mkdir(exist_ok=True)
            (tmp_path / image.stem / name).write_bytes(image.read_bytes())
    with pytest.raises(DataError, match=r"1\.jpg and 1\.png: .* rename one of them"):
        open_rgbd(tmp_path)


def test_an_image_of_another_size_in_the_middle(tmp_path):
    write_images(tmp_path, "color{}.png", "depth{}.png")
    for kind in ("color", "depth"):
        image = Image.open(tmp_path / f"{kind}1.png")
        image.crop((0, 0, 300, 240)).save(tmp_path / f"{kind}1.png")
    with pytest.raises(DataError, match=r"320x240 pixels, but .*color1.png has 300x240"):
        open_rgbd(tmp_path).frame(1)


@needs_shared
@pytest.mark.parametrize(("name", "count", "metres"), [
    ("rgbd_tum_fr1_desk9", 9, (0.5, 1.5)), ("rgbd_open3d5", 5, (1.5, 2.2)),
    ("rgbd_joint_vo_sf_pairs/two_people_walking", 2, (1.0, 2.5)),
    ("rgbd_joint_vo_sf_pairs/robot", 2, (1.5, 4.0)),
    ("rgbd_joint_vo_sf_pairs/cleaning_whiteboard", 2, (1.0, 3.0))])
def test_real_folders(name, count, metres):
    found = open_rgbd(SHARED / name)
    assert len(found) == count
    for k in range(count):
        depth = found.frame(k).depth
        assert depth.shape == (480, 640) and metres[0] < np.median(depth[depth > 0]) < metres[1]
    poses = found.world_from_camera()
    if poses is not None:
        steps_m = pose.translation_distance(poses[:-1], poses[1:])
        assert np.isfinite(steps_m).all() and (steps_m < 0.04).all()


# What programs hand over.

GREY, METRES = np.full((12, 16), 0.5, np.float32), np.ones((12, 16), np.float32)
COLOR = np.zeros((12, 16, 3), np.uint8)
WIDE = Camera.from_field_of_view(16, 12)


def a_frame():
    return RgbdFrame(GREY, METRES)


@pytest.mark.parametrize("made, said", [
    (lambda: RgbdFrame(GREY.tolist(), METRES), "intensity: expected a numpy array, got list; pass floats"),
    (lambda: RgbdFrame(COLOR[..., 0], METRES), "intensity: .* got uint8; pass .* grey / 255"),
    (lambda: RgbdFrame(GREY * 3, METRES), "intensity: up to 1.5; pass .* grey / 255"),
    (lambda: RgbdFrame(np.ma.masked_greater(GREY, 0), METRES), "intensity: expected no mask, got 192 masked"),
    (lambda: RgbdFrame(GREY, METRES.astype(np.uint16)), "depth: .* got uint16; pass metres .* pixels / 5000"),
    (lambda: RgbdFrame(GREY, METRES * np.nan), "depth: must be finite .* 0 where there is no reading"),
    (lambda: RgbdFrame(GREY, METRES.astype(float) * 1e300), "depth: must be finite"),
    (lambda: RgbdFrame(GREY, METRES[:3]), r"depth: expected shape \(12, 16\), got \(3, 16\)"),
    (lambda: RgbdFrame(GREY, METRES, color=COLOR.astype(np.uint16)), "color: of uint16; pass RGB"),
    (lambda: RgbdFrame.from_color(COLOR.astype(np.uint16), METRES), "color: of uint16; pass RGB"),
    (lambda: RgbdFrame.from_color(COLOR / 255, METRES), "color: .* got float64; pass RGB"),
    (lambda: RgbdFrame.from_color(COLOR.tolist(), METRES), "color: expected a numpy array"),
    (lambda: RgbdFrame.from_color(COLOR[..., 0], METRES), "color: .* pass RGB"),
    (lambda: Camera("16", 12, 10, 10, 8, 6), "width is '16'; expected a positive whole number"),
    (lambda: Camera(16, 12.0, 10, 10, 8, 6), "height is 12.0; expected"),
    (lambda: Camera(0, 12, 10, 10, 8, 6), "width is 0; expected"),
    (lambda: Camera(16, 12, None, 10, 8, 6), "fx is None; expected a finite number"),
    (lambda: Camera(16, 12, 10, 10, np.nan, 6), "cx is nan; expected a finite number"),
    (lambda: Camera(16, 12, 10, -1, 8, 6), "positive focal lengths"),
    (lambda: Camera.from_field_of_view(16, 12, 0), "0 degrees wide; expected more than 0"),
    (lambda: RgbdPair(GREY, METRES, WIDE), r"source: of type ndarray; expected RgbdFrame.from_color"),
    (lambda: RgbdPair(a_frame(), a_frame(), None), "camera: of type NoneType; expected Camera"),
    (lambda: RgbdPair(a_frame(), a_frame(), WIDE.scaled(8, 6)), "expected 8x6 pixels as the camera has"),
    (lambda: estimate_flow((a_frame(), a_frame())), "pair: of type tuple; expected RgbdPair"),
    (lambda: RgbdEstimator("camera.toml"), "camera: of type str; expected Camera"),
    (lambda: Open3dOdometry("camera.toml"), "camera: of type str; expected Camera"),
    (lambda: RgbdEstimator(WIDE).step((GREY, METRES)), "frame: of type tuple; expected RgbdFrame")])
def test_what_is_no_frame_or_camera_is_refused(made, said):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(LidarflowError, match=said) as caught:
            made()
    assert isinstance(caught.value, ValueError)


def test_masked_depth_is_no_reading():
    depth = np.ma.masked_array(METRES, mask=False)
    depth[3] = np.ma.masked
    frame = RgbdFrame(GREY, depth)
    assert type(frame.depth) is np.ndarray
    np.testing.assert_array_equal(frame.depth, METRES * (np.arange(12) != 3)[:, None])


def test_numbers_of_numpy_make_a_camera_that_files_can_hold():
    camera = Camera(np.int64(16), np.int32(12), np.float32(10), 10, np.float64(8), 6)
    assert camera == Camera(16, 12, 10.0, 10.0, 8.0, 6.0)
    assert json.loads(json.dumps(asdict(camera)))["width"] == 16
