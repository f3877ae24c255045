"""The rendered RGB-D camera: its truth holds in its own images, and its flaws are those of real sensors."""

import numpy as np
import pytest
from PIL import Image
from rgbd_worlds import HALF_FRAMES, PERFECT, QVGA, SENSOR, frames, moving_share, pair
from scipy import ndimage

from lidarflow import pose, synthetic
from lidarflow.errors import DataError
from lidarflow.synthetic.texture import SHORTEST_M, random_texture


def warped(found, truth, image, order):
    """Values of the target's `image` where the truth takes each pixel, which pixels stay inside, their depth.

    order  0 = the nearest pixel's value, 1 = bilinear
    """
    points = QVGA.points(found.source.depth) + truth.flow
    with np.errstate(divide="ignore", invalid="ignore"):
        u = QVGA.fx * points[..., 0] / points[..., 2] + QVGA.cx
        v = QVGA.fy * points[..., 1] / points[..., 2] + QVGA.cy
    inside = truth.valid & (u > 0) & (u < QVGA.width - 1) & (v > 0) & (v < QVGA.height - 1)
    values = ndimage.map_coordinates(image, [v[inside], u[inside]], order=order)
    return values, inside, points[..., 2][inside]


@pytest.mark.parametrize("name", ["living_room", "passing_wardrobe"])
@pytest.mark.parametrize("moving", [False, True])
def test_the_true_flow_leads_to_the_same_surface_in_the_next_frame(name, moving):
    found, truth = pair(name, sensor=PERFECT)
    there, inside, expected = warped(found, truth, found.target.depth, 0)
    rows = (truth.is_dynamic[inside] == moving) & (there > 0)
    off_m = np.abs(there - expected)[rows]
    assert rows.sum() > 3000
    assert np.median(off_m) < 0.005 and (off_m < 0.03).mean() > 0.95


@pytest.mark.parametrize("moving", [False, True])
def test_the_texture_moves_with_what_carries_it(moving):
    found, truth = pair(sensor=PERFECT, index=1)
    there, inside, expected = warped(found, truth, found.target.intensity, 1)
    depth, _, _ = warped(found, truth, found.target.depth, 0)
    rows = (truth.is_dynamic[inside] == moving) & (np.abs(depth - expected) < 0.02)
    here = found.source.intensity[inside]
    unmoved = np.abs(found.target.intensity[inside] - here)[rows].mean()
    assert np.abs(there - here)[rows].mean() < 0.4 * unmoved


def test_odometry_is_the_motion_of_the_camera_and_what_stands_still_follows_it():
    found, truth = pair()
    points = QVGA.points(found.source.depth).astype(float)
    still = truth.valid & ~truth.is_dynamic
    expected = pose.apply(truth.odometry, points[still]) - points[still]
    np.testing.assert_allclose(truth.flow[still], expected, atol=4e-3)     # 0.1 m/s counts as still
    rotation, translation = np.split(pose.log(truth.odometry), 2)
    assert 0.001 < np.linalg.norm(translation) < 0.02 and np.degrees(np.linalg.norm(rotation)) < 1.0
    assert (truth.flow[~truth.valid] == 0).all()


def test_box_and_person_move_at_their_speeds():
    _, truth = pair(sensor=PERFECT)
    found, _ = pair(sensor=PERFECT)
    points = QVGA.points(found.source.depth).astype(float)
    by_itself = np.linalg.norm(truth.flow - (pose.apply(truth.odometry, points) - points), axis=-1) * 30.0
    left = np.arange(320) < 160
    box = np.median(by_itself[truth.is_dynamic & truth.valid & left])
    person = np.median(by_itself[truth.is_dynamic & truth.valid & ~left])
    assert box == pytest.approx(np.hypot(0.45, 0.8), abs=0.02)
    assert person == pytest.approx(1.2, abs=0.3)


def test_the_wardrobe_moves_in_until_it_hides_half_of_the_room():
    shares = [moving_share(truth) for _, truth in frames("passing_wardrobe", count=HALF_FRAMES)[:-1]]
    assert shares[0] < 0.15 and 0.45 < shares[-1] < 0.65 and (np.diff(shares) > 0).all()


def test_depth_noise_grows_with_the_square_of_the_depth():
    true = frames(sensor=PERFECT)[0][0].depth
    noise = (frames()[0][0].depth - true) / np.maximum(true, 0.1) ** 2
    for low, high in ((0.8, 2.2), (2.2, 3.5), (3.5, 4.8)):
        rows = (true > low) & (true < high) & (frames()[0][0].depth > 0)
        assert rows.sum() > 1000
        assert noise[rows].std() == pytest.approx(SENSOR.depth_noise_per_m, rel=0.1)
        assert abs(noise[rows].mean()) < 2e-4


def test_depth_is_lost_where_a_projector_does_not_reach_far_away_and_on_dark_things():
    perfect = frames("living_room", sensor=PERFECT)[0][0]
    shadow = perfect.depth == 0
    before = np.where(shadow, np.nan, perfect.depth)
    nearer_beside = np.zeros_like(shadow)     # a shadow begins at something nearer on its right
    for shift in range(1, 12):
        nearer_beside[:, :-shift] |= before[:, shift:] < 2.6
    assert 0.005 < shadow.mean() < 0.1
    assert nearer_beside[shadow & (np.arange(320) < 300)].mean() > 0.5
    for frame, truth in frames():
        assert 0.8 < (frame.depth > 0).mean() < 0.99
        assert frame.depth.max() < SENSOR.max_depth_m + 0.2
        if truth is not None:
            np.testing.assert_array_equal(truth.valid, frame.depth > 0)
    dark = (perfect.color.mean(axis=2) < 255 * SENSOR.dark_level - 3) & (perfect.depth > 0)
    assert dark.sum() > 200 and (frames()[0][0].depth[dark] == 0).mean() > 0.7


def test_equal_seeds_give_equal_frames():
    again = frames.__wrapped__()
    for (first, truth), (second, same) in zip(frames(), again, strict=True):
        for name in ("intensity", "depth", "color"):
            np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
        assert (truth is None and same is None) or (truth.flow == same.flow).all()
    other = frames(seed=2)[0][0]
    assert (other.color != frames()[0][0].color).mean() > 0.5


def test_texture_is_noise_of_unit_variance_without_waves_shorter_than_its_band():
    rng = np.random.default_rng(4)
    texture = random_texture((0.5, 0.4, 0.3), rng)
    line = np.zeros((4096, 3))
    line[:, 1] = np.arange(4096) * 0.005
    places = rng.uniform(-50, 50, (20000, 3))
    assert texture.noise(places).std() == pytest.approx(1.0, abs=0.1)
    power = np.abs(np.fft.rfft(texture.noise(line) * np.hanning(4096))) ** 2
    waves_per_m = np.fft.rfftfreq(4096, 0.005)
    assert power[waves_per_m > 1.1 / SHORTEST_M].sum() < 1e-4 * power.sum()
    colours = texture.colours(places)
    assert colours.min() >= 0 and colours.max() <= 1 and colours.mean(axis=1).std() > 0.1


def test_a_written_folder_holds_images_times_poses_camera_and_truth(tmp_path):
    sequence = frames()
    synthetic.write_tum(tmp_path / "tum", sequence, QVGA)
    stamps = ["0.000000", "0.033333", "0.066667", "0.100000"]
    for kind in ("rgb", "depth"):
        rows = [row.split() for row in (tmp_path / "tum" / f"{kind}.txt").read_text().splitlines()[2:]]
        assert rows == [[stamp, f"{kind}/{stamp}.png"] for stamp in stamps]
    color = np.asarray(Image.open(tmp_path / "tum" / "rgb" / "0.033333.png"))
    depth = np.asarray(Image.open(tmp_path / "tum" / "depth" / "0.033333.png"))
    np.testing.assert_array_equal(color, sequence[1][0].color)
    np.testing.assert_allclose(depth / 5000.0, sequence[1][0].depth, atol=1.01e-4)
    poses = np.loadtxt(tmp_path / "tum" / "groundtruth.txt")
    motions = pose.from_translation_quaternion(poses[:, 1:])
    for k, (_, truth) in enumerate(sequence[:-1]):
        np.testing.assert_allclose(pose.inverse(motions[k + 1]) @ motions[k], truth.odometry, atol=1e-7)
    with pytest.raises(DataError, match="not an empty folder"):
        synthetic.write_tum(tmp_path / "tum", sequence, QVGA)
