import io

import numpy as np
import pytest
from PIL import Image

from lidarflow import colour, pose, preview
from lidarflow.types import FlowResult, Scan, ScanPair, SolveStats

MOVER = slice(0, 60)


def street():
    """A flat street with one block that drives forward at 8 m/s, 10 m ahead and 12 m to the left."""
    rng = np.random.default_rng(2)
    block = rng.uniform(-1, 1, (60, 3)) + (10, 12, 0)
    ground = np.column_stack([rng.uniform(-35, 35, (3000, 2)), np.full(3000, -1.7)])
    points = np.concatenate([block, ground, np.full((2, 3), np.nan)])
    is_dynamic = np.zeros(len(points), bool)
    is_dynamic[MOVER] = True
    ego_motion = pose.from_yaw(0.02, (-0.5, 0, 0))
    flow = pose.apply(ego_motion, points) - points
    flow[MOVER] += (0.8, 0, 0)
    stats = SolveStats("none", 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, {})
    motions = pose.identity(len(points))
    valid = np.isfinite(points).all(axis=1)
    target = Scan(points + flow, time_ns=200_000_000, name="000001")
    pair = ScanPair(Scan(points, time_ns=100_000_000, name="000000"), target)
    return pair, FlowResult(flow, motions, valid, valid, is_dynamic, ego_motion, stats)


def picture_of(size_px=600):
    pair, result = street()
    points = pair.source.points
    residual_flow = result.residual_flow(points)
    colours = colour.scene_colours(points, residual_flow, result.is_dynamic, pair.dt_s)
    return np.asarray(preview.bird_eye(points, colours, result.is_dynamic, residual_flow, size_px=size_px))


def test_the_mover_is_bright_where_it_is_and_in_the_colour_of_its_direction():
    picture = picture_of().astype(int)
    row, column = round(300 - 10 * 7.5), round(300 - 12 * 7.5)
    there = picture[row - 8: row + 9, column - 8: column + 9].reshape(-1, 3)
    red = (there[:, 0] > 200) & (there[:, 1] < 120) & (there[:, 2] < 120)
    assert red.sum() > 50
    elsewhere = picture[400:560, 200:400].reshape(-1, 3)
    assert elsewhere.max() < 150 and elsewhere.std(axis=1).max() < 5
    assert (elsewhere.sum(axis=1) > 3 * max(colour.BACKGROUND)).sum() > 20


def test_the_arrow_points_forward():
    picture = picture_of()
    column = round(300 - 12 * 7.5)
    ahead = picture[round(300 - 17 * 7.5): round(300 - 12 * 7.5), column - 4: column + 5]
    behind = picture[round(300 - 8 * 7.5): round(300 - 5 * 7.5), column - 4: column + 5]
    assert (ahead == 255).all(axis=-1).any()
    assert not (behind == 255).all(axis=-1).any()


def test_the_wheel_is_in_the_upper_right_corner():
    picture = picture_of()
    np.testing.assert_array_equal(picture[:150, 450:], colour.wheel(150))


@pytest.mark.parametrize("name", ["preview.png", "preview.png.part"])
def test_equal_input_gives_equal_bytes_under_any_name(tmp_path, name):
    preview.write_preview(tmp_path / name, *street())
    preview.write_preview(tmp_path / "again.png", *street())
    data = (tmp_path / name).read_bytes()
    assert data == (tmp_path / "again.png").read_bytes()
    assert Image.open(io.BytesIO(data)).format == "PNG"
    assert Image.open(io.BytesIO(data)).size == (1200, 1200)


def test_a_still_and_empty_scene_can_be_drawn():
    empty = np.empty((0, 3))
    picture = preview.bird_eye(empty, empty.astype(np.uint8), np.empty(0, bool), empty, size_px=200)
    assert picture.size == (200, 200)


def moving_block(x, y):
    """Points of a block around (x, y) that moves forward by 0.5 m in 0.1 s, and what is drawn of them."""
    points = np.random.default_rng(4).uniform(-1.5, 1.5, (400, 3)) + (x, y, 0)
    moved, is_dynamic = np.tile([0.5, 0.0, 0.0], (400, 1)), np.ones(400, bool)
    return points, colour.scene_colours(points, moved, is_dynamic, 0.1), is_dynamic, moved


@pytest.mark.parametrize(("x", "y"), [(-38.5, 34.0), (30.0, -30.0), (38.0, 30.0)],
                         ids=["scale bar", "legend", "caption"])
def test_nothing_hides_what_moves(x, y):
    block = moving_block(x, y)
    nowhere = np.zeros((0, 3)), np.zeros((0, 3))
    picture = np.asarray(preview.bird_eye(*block, size_px=600, caption="0" * 30, arrows=nowhere)).astype(int)
    column, row = np.floor(300 - block[0][:, [1, 0]].T * 7.5 - 0.5).astype(int)
    shown = picture[row, column]
    assert (shown == block[1][0]).all()


def test_an_object_far_away_is_in_the_picture():
    points, _, is_dynamic, moved = moving_block(10.0, -70.0)
    arrows = preview._arrows_of_groups(points, moved, is_dynamic, 0.1)
    near = np.random.default_rng(5).uniform(-20.0, 20.0, (5000, 3))
    assert preview.half_width(near) <= 40.0
    assert 70.0 < preview.half_width(near, arrows) < 90.0


def test_the_picture_says_how_long_arrows_are_if_there_are_any():
    block = moving_block(0.0, 20.0)
    text = np.s_[28:50, 10:250]
    none = np.zeros((0, 3)), np.zeros((0, 3))
    with_arrows, without = (np.asarray(preview.bird_eye(*block, size_px=600, arrows=arrows))[text]
                            for arrows in (None, none))
    assert with_arrows.max() > 120 > without.max()
