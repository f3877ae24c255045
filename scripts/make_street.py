"""Another generated street than the demo's, with its truth, in KITTI's layout: scenes nobody has tuned to.

    python scripts/make_street.py FOLDER --seed 7 [--sensor hdl64e|hdl32e] [--scans 4]
"""

import argparse
from pathlib import Path

import numpy as np

from lidarflow import synthetic

SENSORS = {"hdl64e": synthetic.hdl64e, "hdl32e": synthetic.hdl32e}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--sensor", choices=SENSORS, default="hdl64e")
    parser.add_argument("--scans", type=int, default=4)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    sequence = synthetic.scan_sequence(synthetic.street(rng), SENSORS[options.sensor](), options.scans, rng)
    synthetic.write_kitti(options.folder, sequence)
    print(f"{options.folder}: {options.scans} scans of a {options.sensor}, seed {options.seed}")


if __name__ == "__main__":
    main()
