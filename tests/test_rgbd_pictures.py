"""Pictures and recordings of RGB-D results: the right things in the right colours, and valid files."""

import io
import subprocess
import sys

import numpy as np
import pytest
import rerun as rr
from PIL import Image

from lidarflow import colour, pose, rerun_streams, rgbd_colour, rgbd_io, rgbd_preview, rgbd_viewer
from lidarflow.rgbd_metrics import Residuals, WarpScores
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdPair, RgbdResult

CAMERA = Camera.from_field_of_view(40, 30)
SHAPE = (30, 40)
BOX = np.s_[10:20, 5:15]          # moves to the right by 30 mm; the last row has no depth
SCORES = WarpScores(*(Residuals(1000, 0.1, 0.05 / k, 0.01) for k in (1, 2, 3)))


@pytest.fixture(autouse=True)
def mistakes_in_logging_raise():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def scene(count=1):
    """Pairs of a grey wall 2 m away with a box before it; the camera moves 10 mm forward a frame."""
    depth = np.full(SHAPE, 2.0, np.float32)
    depth[BOX], depth[-1] = 1.0, 0.0
    color = np.full((*SHAPE, 3), 120, np.uint8)
    points, valid = CAMERA.points(depth), depth > 0
    odometry = pose.from_translation((0.0, 0.0, -0.01))
    moves = np.zeros(SHAPE, bool)
    moves[BOX] = True
    flow = np.where(valid[..., None], np.float32([0.0, 0.0, -0.01]), np.float32(0.0))
    flow[BOX] += np.float32([0.03, 0.0, 0.0])
    label = np.where(valid, moves, -1).astype(np.int32)
    motions = np.stack([odometry, pose.from_translation((0.03, 0.0, 0.0)) @ odometry])
    result = RgbdResult(flow, points, valid, label, np.array([0.0, 1.2]), motions, odometry, moves, CAMERA,
                        np.array([[0, 0, 2.0], [-0.3, 0, 1.0]], np.float32))
    for k in range(count):
        frames = [RgbdFrame.from_color(color, depth, (k + j) * 33_333_333, f"{k + j:06d}") for j in (0, 1)]
        yield RgbdPair(*frames, CAMERA), result


# Colours

def test_segmentation_is_blue_where_static_red_where_moving_black_where_unknown():
    b = np.array([[0.0, 1.0, 2.0, np.nan, 0.5]], np.float32)
    found = rgbd_colour.segmentation_colours(b)[0]
    assert tuple(found[0]) == rgbd_colour.STATIC and tuple(found[1]) == tuple(found[2]) == rgbd_colour.MOVING
    assert tuple(found[3]) == (0, 0, 0) and found[0][2] > found[4][2] > found[1][2]
    dark, bright = (rgbd_colour.segmentation_colours(b, np.full((1, 5), level))[0, 1] for level in (0.0, 1.0))
    assert dark[0] < bright[0] == rgbd_colour.MOVING[0] and dark.argmax() == 0


def test_motion_is_coloured_by_its_direction_in_the_image_and_white_along_the_line_of_sight():
    directions = {"right": (1, 0, 0), "up": (0, -1, 0), "left": (-1, 0, 0), "down": (0, 1, 0),
                  "away": (0, 0, 1)}
    flow = 0.02 * np.array([list(directions.values())], float)
    colours = rgbd_colour.motion_colours(flow, np.ones((1, 5), bool), 0.02)[0]
    found = dict(zip(directions, colours, strict=True))
    assert tuple(found["right"]) == (255, 0, 0) and tuple(found["left"]) == (0, 255, 255)
    assert found["up"][1] == found["down"][2] == 255 and found["up"][2] == found["down"][1] == 0
    assert tuple(found["away"]) == (255, 255, 255)
    still = rgbd_colour.motion_colours(0.0 * flow, np.ones((1, 5), bool), 0.02)[0]
    assert (still == still[0, 0]).all()
    unknown = rgbd_colour.motion_colours(flow, np.zeros((1, 5), bool), 0.02)
    assert (unknown == 0).all()


def test_full_strength_fits_the_motion():
    flow, valid = np.zeros((20, 20, 3)), np.ones((20, 20), bool)
    assert rgbd_colour.full_strength_m(flow, valid) == 0.01
    flow[:10, :, 1] = 0.0421
    assert rgbd_colour.full_strength_m(flow, valid) == pytest.approx(0.045)
    flow[0, 0] = 9.0
    assert rgbd_colour.full_strength_m(flow, valid) == pytest.approx(0.045)
    assert rgbd_colour.full_strength_m(flow, ~valid) == 0.01


def test_depth_and_labels_are_black_where_there_is_none():
    depth = np.array([[0.0, 1.0, 1.5, 2.0, 9.0]])
    found = rgbd_colour.depth_colours(depth, 1.0, 2.0)[0].astype(int).sum(axis=1)
    assert found[0] == 0 and found[1] > found[2] > found[3] == found[4] > 0
    label = np.array([[-1, 0, 1, 2, 23]])
    colours = rgbd_colour.label_colours(label)[0]
    assert tuple(colours[0]) == (0, 0, 0) and len({tuple(c) for c in colours}) == 5
    assert rgbd_colour.label_colours(np.full((2, 2), -1)).max() == 0


def test_the_wheel_has_right_to_the_right_and_up_above():
    wheel = rgbd_colour.wheel(100, 0.03).astype(int)
    right, left = wheel[50, 80], wheel[50, 20]
    assert right[0] > 200 > max(right[1:]) and left[0] < 100
    assert tuple(wheel[0, 0]) == colour.BACKGROUND


# Picture

def panel(picture, column, row):
    """The image of a panel, at its own 40x30 pixels."""
    width, height, gap, caption = 520, 390, 6, 30
    left, top = gap + column * (width + gap), gap + row * (height + caption + gap) + caption
    return np.asarray(picture.crop((left, top, left + width, top + height)).resize((40, 30), Image.NEAREST))


def test_the_picture_shows_the_box_red_and_the_wall_blue():
    pair, result = next(scene())
    picture = rgbd_preview.picture(pair.source, result)
    np.testing.assert_array_equal(panel(picture, 0, 0), pair.source.color)
    segmentation = panel(picture, 0, 1).astype(int)
    assert (segmentation[BOX][..., 0] > 2 * segmentation[BOX][..., 2]).all()
    wall = segmentation[2:8]
    assert (wall[..., 2] > 2 * wall[..., 0]).all() and (segmentation[-1] == 0).all()
    own = panel(picture, 2, 1).astype(int)
    assert (own[BOX][..., 0] > 2 * own[BOX][..., 1]).all()             # to the right: red
    assert (np.ptp(own[2:8], axis=-1) == 0).all() and own[2:8].min() > 40    # still: grey
    depth = panel(picture, 1, 0).astype(int).sum(axis=-1)
    assert depth[BOX].min() > depth[2:8].max() > 0


@pytest.mark.parametrize("name", ["preview.png", "preview.png.part"])
def test_equal_input_gives_equal_bytes_under_any_name(tmp_path, name):
    pair, result = next(scene())
    for file in (name, "again.png"):
        rgbd_preview.write_preview(tmp_path / file, pair.source, result)
    data = (tmp_path / name).read_bytes()
    assert data == (tmp_path / "again.png").read_bytes()
    assert Image.open(io.BytesIO(data)).format == "PNG"


def test_a_frame_without_colours_or_depth_can_be_drawn():
    pair, result = next(scene())
    grey = RgbdFrame(pair.source.intensity, pair.source.depth)
    assert (panel(rgbd_preview.picture(grey, result), 0, 0) == 120).all()
    nothing = RgbdResult(
        np.zeros((*SHAPE, 3), np.float32), np.zeros((*SHAPE, 3), np.float32), np.zeros(SHAPE, bool),
        np.full(SHAPE, -1, np.int32), np.zeros(1), np.eye(4)[None], np.eye(4), np.zeros(SHAPE, bool), CAMERA,
        np.zeros((1, 3), np.float32))
    assert panel(rgbd_preview.picture(grey, nothing), 0, 1).max() == 0


# Recording

def printed(path, *options):
    done = subprocess.run([sys.executable, "-m", "rerun", "rrd", *options, str(path)], capture_output=True,
                          text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_a_recording_is_valid_and_holds_every_entity_and_its_blueprint(tmp_path):
    path, world_from_camera = tmp_path / "recording.rrd", np.eye(4)
    stream = rgbd_viewer.open_recording(path)
    for k, (pair, result) in enumerate(scene(count=2)):
        rgbd_viewer.log_pair(stream, k, pair, result, SCORES, world_from_camera)
        world_from_camera = world_from_camera @ pose.inverse(result.odometry)
    rerun_streams.close(stream)
    printed(path, "verify")
    text = printed(path, "print", "-v")
    for entity in (rgbd_viewer.POINTS, rgbd_viewer.ARROWS, rgbd_viewer.PHOTO, rgbd_viewer.DEPTH,
                   rgbd_viewer.CLUSTERS, rgbd_viewer.SEGMENTATION, rgbd_viewer.FLOW, rgbd_viewer.TRAJECTORY,
                   "residuals/before", "residuals/odometry", "residuals/flow"):
        assert f" /{entity} " in text, entity
    for kind in ("ViewBlueprint", "Pinhole", "DepthImage", "Transform3D", "Scalars"):
        assert kind in text


def test_a_flow_file_is_shown_as_its_pair_was(tmp_path):
    pair, result = next(scene())
    logged = Logged()
    rgbd_viewer.log_pair(logged, 0, pair, result, SCORES, np.eye(4))
    by_file = Logged()
    rgbd_viewer.log_file(by_file, rgbd_io.RgbdFlowFile(result, pair.source.color, {}, {}))
    assert by_file.by_entity.keys() == {name for name in logged.by_entity if not name.startswith("residuals")}
    assert by_file.timeline == [("frame", 0)] and by_file.blueprints == 1


class Logged:
    """A stream that keeps what is logged."""

    def __init__(self):
        self.by_entity, self.timeline, self.blueprints = {}, [], 0

    def log(self, entity, what, **_):
        self.by_entity[entity] = what

    def set_time(self, timeline, sequence=None, **_):
        if sequence is not None:
            self.timeline.append((timeline, sequence))

    def send_blueprint(self, _):
        self.blueprints += 1


def values(batch):
    return np.array(batch.as_arrow_array().to_pylist())


def test_points_are_coloured_by_their_own_motion_and_arrows_are_on_the_box():
    pair, result = next(scene())
    logged = Logged()
    rgbd_viewer.log_pair(logged, 0, pair, result, SCORES, np.eye(4))
    points = logged.by_entity[rgbd_viewer.POINTS]
    assert len(values(points.positions)) == result.valid.sum()
    rgba = values(points.colors).astype(np.uint32)
    red, green = rgba >> 24, (rgba >> 16) & 255
    on_box = result.is_dynamic[result.valid]
    assert (red[on_box] > 1.3 * green[on_box]).all() and (red[~on_box] == green[~on_box]).all()
    arrows = logged.by_entity[rgbd_viewer.ARROWS]
    np.testing.assert_allclose(values(arrows.vectors), np.tile((0.15, 0.0, 0.0), (100, 1)), atol=1e-6)
    assert (values(arrows.origins)[:, 2] == 1.0).all()


def test_the_trajectory_goes_where_the_camera_goes():
    pair, result = next(scene())
    logged = Logged()
    world_from_source = pose.from_yaw(0.3, (1.0, 2.0, 3.0))
    rgbd_viewer.log_pair(logged, 0, pair, result, SCORES, world_from_source)
    (stretch,) = logged.by_entity[rgbd_viewer.TRAJECTORY].strips.as_arrow_array().to_pylist()
    np.testing.assert_allclose(stretch, [[1.0, 2.0, 3.0], [1.0, 2.0, 3.01]], atol=1e-6)
