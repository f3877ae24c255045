"""Ego-motion without a guess between generated scans that lie far apart, or of a sensor that was turned.

    python scripts/far_apart.py [--seeds N] [--pairs N]

The sensor drives along a street at 8 m/s; turns are about the vertical, between scans 0.1 s apart. "off" are
pairs that are wrong by more than 0.05 m or 0.01 rad: from rest alone, and with the search from all around.
"""

import time
from collections.abc import Iterator

import numpy as np
from generated_pairs import CONFIG, Pair, along, options

from lidarflow import pose, synthetic
from lidarflow.errors import DataError
from lidarflow.lidar import ego

GAPS_S = (0.1, 0.5, 1.0, 1.5)
TURNS_RAD = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2)
OFF_M, OFF_RAD = 0.05, 0.01


def apart(gap_s: float, seeds: int, pairs: int) -> Iterator[Pair]:
    """Scans so long apart, and the motion between them."""
    for seed in range(seeds):
        street = synthetic.street(np.random.default_rng(seed))
        yield from along(street, synthetic.hdl64e(columns=500), pairs, 1, gap_s)


def turned(turn_rad: float, seeds: int, pairs: int) -> Iterator[Pair]:
    """Scans 0.1 s apart of a sensor that is turned meanwhile."""
    turn = pose.from_yaw(turn_rad)
    for source, target, motion in apart(0.1, seeds, pairs):
        yield source, ego.Thinned.of(pose.apply(turn, target.points), CONFIG), turn @ motion


def is_off(source: ego.Thinned, target: ego.Thinned, motion: np.ndarray, search) -> bool:
    """Whether a search misses the motion (4, 4), or refuses the scans."""
    try:
        found = search(source, target)
    except DataError:
        return True
    return bool(pose.translation_distance(found, motion) > OFF_M
                or pose.rotation_distance(found, motion) > OFF_RAD)


def row(pairs: list[Pair]) -> str:
    """How many pairs there are, how many are off, and the seconds that the longest search takes."""
    off, longest_s = np.zeros(2, int), 0.0
    for source, target, motion in pairs:
        off[0] += is_off(source, target, motion, ego.register)
        begin = time.perf_counter()
        off[1] += is_off(source, target, motion, lambda a, b: ego.find(a, b, None, CONFIG.ego))
        longest_s = max(longest_s, time.perf_counter() - begin)
    return f"{len(pairs)} | {off[0]} | {off[1]} | {longest_s:.2f} |"


def main() -> None:
    wanted = options(__doc__, pairs=2)
    print("| between scans | pairs | off, from rest | off, as found | longest s |")
    print("|---|---|---|---|---|")
    for gap_s in GAPS_S:
        print(f"| {8.0 * gap_s:.1f} m | {row(list(apart(gap_s, wanted.seeds, wanted.pairs)))}")
    for turn_rad in TURNS_RAD:
        print(f"| {np.rad2deg(turn_rad):.0f}° | {row(list(turned(turn_rad, wanted.seeds, wanted.pairs)))}")


if __name__ == "__main__":
    main()
