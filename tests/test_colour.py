import colorsys

import numpy as np
import pytest

from lidarflow import colour

DT_S = 0.1


def hue(rgb) -> float:
    return colorsys.rgb_to_hsv(*(np.asarray(rgb) / 255.0))[0]


def saturation(rgb) -> float:
    return colorsys.rgb_to_hsv(*(np.asarray(rgb) / 255.0))[1]


def colour_of(velocity, is_dynamic=True):
    residual_flow = np.array([velocity], float) * DT_S
    return colour.motion_colours(residual_flow, np.array([is_dynamic]), DT_S)[0]


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 135, 200, 290])
def test_hue_is_the_direction_in_the_ground_plane(angle_deg):
    angle = np.radians(angle_deg)
    forth = (8 * np.cos(angle), 8 * np.sin(angle), 0)
    assert hue(colour_of(forth)) == pytest.approx(angle_deg / 360, abs=0.01)
    opposite = abs(hue(colour_of(forth)) - hue(colour_of(-np.array(forth))))
    assert opposite == pytest.approx(0.5, abs=0.01)


def test_forward_is_red_and_height_does_not_change_the_hue():
    np.testing.assert_array_equal(colour_of((10, 0, 0)), (255, 0, 0))
    np.testing.assert_array_equal(colour_of((10, 0, 0)), colour_of((10, 0, 3)))


def test_saturation_and_brightness_grow_with_speed_and_slow_motion_is_visible():
    speeds_m_per_s = [0.5, 2, 5, 10]
    colours = [colour_of((0, speed, 0)) for speed in speeds_m_per_s]
    saturations = [saturation(rgb) for rgb in colours]
    assert saturations == sorted(saturations)
    assert saturations[0] == pytest.approx(0.55, abs=0.01) and saturations[-1] == 1.0
    assert [max(rgb) for rgb in colours] == sorted(max(rgb) for rgb in colours)
    assert colours[0].max() > 2 * colour.STATIC_GREY
    np.testing.assert_array_equal(colour_of((0, 10, 0)), colour_of((0, 40, 0)))


def test_static_and_unknown_points_are_dark_grey():
    grey = (colour.STATIC_GREY,) * 3
    np.testing.assert_array_equal(colour_of((9, 0, 0), is_dynamic=False), grey)
    np.testing.assert_array_equal(colour_of((np.nan, 0, 0)), grey)
    assert colour.motion_colours(np.empty((0, 3)), np.empty(0, bool), DT_S).shape == (0, 3)


def test_static_shade_rises_with_height_and_survives_nan():
    shade = colour.static_shade(np.array([[0, 0, -2.0], [0, 0, 1.0], [0, 0, 9.0], [np.nan] * 3]))
    assert shade.dtype == np.uint8 and (shade == shade[:, :1]).all()
    assert shade[0, 0] < shade[1, 0] < shade[2, 0] < 150
    assert shade[3, 0] == shade[0, 0]


def test_wheel_shows_the_colours_of_motion():
    size_px, full_speed_m_per_s = 301, 8.0
    picture = colour.wheel(size_px, full_speed_m_per_s)
    assert picture.shape == (size_px, size_px, 3) and picture.dtype == np.uint8
    np.testing.assert_array_equal(picture[0, 0], colour.BACKGROUND)
    centre, radius = (size_px - 1) / 2, colour.WHEEL_RADIUS * size_px
    for forward, left in ((0.8, 0.0), (-0.8, 0.0), (0.0, 0.7), (0.0, -0.7), (0.2, 0.1)):
        row, column = round(centre - forward * radius), round(centre - left * radius)
        velocity = np.array([[centre - row, centre - column, 0]]) / radius * full_speed_m_per_s
        expected = colour.motion_colours(velocity, np.array([True]), 1.0, full_speed_m_per_s)[0]
        np.testing.assert_array_equal(picture[row, column], expected)


def test_moving_objects_are_separate_groups_with_their_mean_motion():
    rng = np.random.default_rng(5)
    car = rng.uniform(-1, 1, (200, 3)) + (10, 5, 0)
    walker = rng.uniform(-0.2, 0.2, (30, 3)) + (4, -3, 0)
    stray, unknown = np.array([[30.0, 30, 0]]), np.full((1, 3), np.nan)
    points = np.concatenate([walker, car, stray, unknown])
    residual_flow = np.concatenate([np.tile([0, 0.1, 0], (30, 1)), np.tile([0.8, 0, 0], (202, 1))])
    tops, moved = colour.moving_objects(points, residual_flow, np.ones(len(points), bool))
    np.testing.assert_allclose(moved, [[0.8, 0, 0], [0, 0.1, 0]])
    np.testing.assert_allclose(tops[:, :2], [car[:, :2].mean(axis=0), walker[:, :2].mean(axis=0)])
    np.testing.assert_allclose(tops[:, 2], [car[:, 2].max(), walker[:, 2].max()])


def test_nothing_moves():
    tops, moved = colour.moving_objects(np.zeros((5, 3)), np.zeros((5, 3)), np.zeros(5, bool))
    assert tops.shape == moved.shape == (0, 3)
