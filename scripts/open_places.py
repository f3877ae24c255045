"""Ego-motion where little but a road is seen, and one car that drives along, on generated scans.

    python scripts/open_places.py [--seeds N] [--pairs N]

Pieces of single rings on the road are as wide as ranges are noisy, and planes fitted to them say that the
sensor rests; so does a car beside it that is as fast as the sensor, 4 m/s. "off" are pairs that are wrong by
more than 0.05 m.
"""

import numpy as np
from generated_pairs import CONFIG, along, options

from lidarflow import pose, synthetic
from lidarflow.lidar import ego

SENSORS = {
    "HDL-32E": synthetic.hdl32e(), "HDL-64E": synthetic.hdl64e(),
    "HDL-32E, 900 columns": synthetic.hdl32e(columns=900),
    "HDL-64E, 1000 columns": synthetic.hdl64e(columns=1000),
}
SPEEDS_M_PER_S = (2.0, 4.0, 8.0)     # of the car
OFF_M = 0.05


def errors_m(sensor: synthetic.Sensor, speed_m_per_s: float, seed: int, pairs: int) -> np.ndarray:
    """How far (N, 2) the ego-motion of each pair is off, by itself and along the sequence."""
    last, off = None, []
    for source, target, motion in along(
            synthetic.one_car(speed_m_per_s, np.random.default_rng(seed)), sensor, pairs, 0):
        alone, last = (ego.find(source, target, guess, CONFIG.ego) for guess in (None, last))
        off.append([pose.translation_distance(found, motion) for found in (alone, last)])
    return np.array(off)


def main() -> None:
    wanted = options(__doc__, pairs=4)
    print("| sensor | car m/s | pairs | off, by themselves | off, in sequence | median m |")
    print("|---|---|---|---|---|---|")
    for name, sensor in SENSORS.items():
        for speed in SPEEDS_M_PER_S:
            off_m = np.concatenate(
                [errors_m(sensor, speed, seed, wanted.pairs) for seed in range(wanted.seeds)])
            alone, in_sequence = (off_m > OFF_M).sum(axis=0)
            print(f"| {name} | {speed:g} | {len(off_m)} | {alone} | {in_sequence} "
                  f"| {np.median(off_m[:, 1]):.3f} |")


if __name__ == "__main__":
    main()
