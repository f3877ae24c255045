"""Small rendered RGB-D sequences for tests, made once."""

import functools
from dataclasses import replace

import numpy as np

from lidarflow import synthetic
from lidarflow.rgbd_types import Camera, RgbdPair

QVGA = Camera.from_field_of_view(320, 240)
SENSOR = synthetic.RgbdSensor(QVGA)
PERFECT = replace(SENSOR, depth_noise_per_m=0.0, loss=0.0, dark_level=0.0, image_noise=0.0)
FRAMES = 4
HALF_FRAMES = 19     # then the wardrobe hides about half of the room
ROOMS = {"living_room": synthetic.living_room, "passing_wardrobe": synthetic.passing_wardrobe}


@functools.cache
def frames(name="living_room", count=FRAMES, seed=1, sensor=SENSOR):
    """(frame, truth) of a room by its name, 30 a second; the last truth is None."""
    rng = np.random.default_rng(seed)
    return synthetic.rgbd_sequence(ROOMS[name](rng), sensor, count, rng)


def pair(name="living_room", index=0, **options):
    """One pair of `frames`, and its truth."""
    sequence = frames(name, **options)
    (source, truth), (target, _) = sequence[index:index + 2]
    return RgbdPair(source, target, QVGA), truth


def moving_share(truth):
    """Share of the pixels with depth that move by themselves."""
    return truth.is_dynamic[truth.valid].mean()


def copied(folder, place):
    """A copy of a TUM folder's lists, its images linked."""
    place.mkdir()
    for entry in folder.iterdir():
        if entry.is_dir():
            (place / entry.name).symlink_to(entry)
        else:
            (place / entry.name).write_bytes(entry.read_bytes())
    return place
