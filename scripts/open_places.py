"""Ego-motion where little but a road is seen, and one car that drives along, on generated scans.

    python scripts/open_places.py [--seeds N] [--pairs N]

Pieces of single rings on the road are as wide as ranges are noisy, and planes fitted to them say that the
sensor rests; so does a car beside it that is as fast as the sensor, 4 m/s. "off" are pairs that are wrong by
more than 0.05 m.
"""

import argparse

import numpy as np

from lidarflow import pose, synthetic
from lidarflow.config import Config
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
    config, rng = Config(), np.random.default_rng
    scans = synthetic.scan_sequence(
        synthetic.one_car(speed_m_per_s, rng(seed)), sensor, pairs + 1, rng(0))
    thinned, last, off = [ego.Thinned.of_scan(scan, config) for scan, _ in scans], None, []
    for source, target, (_, truth) in zip(thinned, thinned[1:], scans, strict=False):
        alone, last = (ego.find(source, target, guess, config.ego) for guess in (None, last))
        off.append([pose.translation_distance(found, truth.ego_motion) for found in (alone, last)])
    return np.array(off)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--pairs", type=int, default=4)
    options = parser.parse_args()
    print("| sensor | car m/s | pairs | off, by themselves | off, in sequence | median m |")
    print("|---|---|---|---|---|---|")
    for name, sensor in SENSORS.items():
        for speed in SPEEDS_M_PER_S:
            off_m = np.concatenate(
                [errors_m(sensor, speed, seed, options.pairs) for seed in range(options.seeds)])
            alone, along = (off_m > OFF_M).sum(axis=0)
            print(f"| {name} | {speed:g} | {len(off_m)} | {alone} | {along} | {np.median(off_m[:, 1]):.3f} |")


if __name__ == "__main__":
    main()
