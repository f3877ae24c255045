"""Tables I to III of Dewan et al. 2016, ours and the baselines beside the printed figures, as Markdown.

    python scripts/reproduce_tables.py [--static FOLDER…] [--moving FOLDER…] [--kitti KITTI] [--human]

Table I: t_e [m] and r_e [rad] of static scenes, mean ± standard deviation over pairs; Table II: crispness of
scenes with movers; Table III (--human): crispness and end-point error of the person in generated human
motion. --kitti takes sequences 03, 05, 06 (Table I) and 03, 04, 05, 06, 12 (Table II) of the odometry
data set as well. "dewan2016" is configs/dewan2016.toml, "ours" the defaults. All are scored on the same
points: returns above ground, in Table I those of them that stand still.
"""

import argparse
from itertools import product
from pathlib import Path

import human_motion
import numpy as np
from evaluate import table

from lidarflow import compare, runner
from lidarflow import config as settings
from lidarflow.datasets import Dataset, open_dataset

PAPER = Path(__file__).parent.parent / "configs" / "dewan2016.toml"
BASELINES = ["icp", "ransac_icp"]
TITLES = {"dewan2016": "dewan2016.toml", "ours": "ours", "icp": "icp", "ransac_icp": "ransac + icp"}
PRINTED_1 = {"03": ("0.22 / 0.02", "0.77", "0.38"), "05": ("0.21 / 0.02", "0.73", "0.26"),
             "06": ("0.50 / 0.04", "1.59", "0.65")}
PRINTED_2 = {"03": 0.91, "04": 0.87, "05": 0.93, "06": 0.89, "12": 0.81}
PRINTED_3 = {"arms_up_down": (0.98, 0.91), "arms_backwards": (0.97, 0.93), "bend_sidewards": (0.97, 0.94),
             "bend_forward": (0.89, 0.84)}
INTERVALS_S = (0.1, 0.3)


def compared(dataset: Dataset, n_scans: int) -> dict[str, list[dict[str, float]]]:
    """Figures of every pair by method: the paper's settings, the defaults, and the baselines."""
    frames = runner.choose_frames(dataset, 0, n_scans)
    paper = compare.compare(dataset, frames, ["ours"], settings.load(PAPER))
    found = compare.compare(dataset, frames, ["ours", *BASELINES], settings.Config())
    return {"dewan2016": paper.runs[0].figures} | {run.name: run.figures for run in found.runs}


def spread(figures: list[dict[str, float]], name: str) -> str:
    values = [row[name] for row in figures if name in row]
    return f"{np.mean(values):.3f} ± {np.std(values):.3f}" if values else "-"


def table_1(scenes: dict[str, Dataset], n_scans: int) -> str:
    rows = []
    for scene, dataset in scenes.items():
        found = compared(dataset, n_scans)
        for method, title in TITLES.items():
            rows.append([scene, title, str(len(found[method])), spread(found[method], "t_e_m"),
                         spread(found[method], "r_e_rad")])
        if scene in PRINTED_1:
            ours, icp, ransac = PRINTED_1[scene]
            rows.append([scene, f"printed: theirs {ours}, icp {icp}, icp + ransac {ransac}", "", "", ""])
    return table(["scene", "method", "pairs", "t_e [m]", "r_e [rad]"], rows)


def table_2(scenes: dict[str, Dataset], n_scans: int) -> str:
    rows = []
    for scene, dataset in scenes.items():
        found = compared(dataset, n_scans)
        printed = PRINTED_2.get(scene)
        rows.append([scene, str(len(found["ours"])),
                     *(spread(found[method], "crispness") for method in TITLES),
                     "-" if printed is None else f"{printed:.2f}"])
    return table(["scene", "pairs", *TITLES.values(), "printed"], rows)


def table_3(n_scans: int) -> str:
    """The person's points only, in every pair of the four motions seen from 6, 8 and 10 m."""
    config = settings.Config()
    names = {"dewan2016": "dewan2016.toml", "defaults": "ours", "icp": "icp", "ransac + icp": "ransac + icp",
             "truth": "truth"}
    rows = []
    for motion, interval_s in product(human_motion.MOTIONS, INTERVALS_S):
        scores: dict[str, list] = {}
        for seed, distance_m in enumerate((6.0, 8.0, 10.0)):
            sequence = human_motion.sequence_of(motion, seed, distance_m, n_scans, interval_s)
            found = human_motion.measure(sequence, config, interval_s)
            for name in names:
                scores.setdefault(name, []).extend(found[name])
        mean = {name: np.nanmean(values, axis=0) for name, values in scores.items()}
        ours, rival = PRINTED_3[motion]
        rows.append([motion, f"{interval_s:g}", str(len(scores["truth"])),
                     *(f"{mean[name][3]:.4f} / {mean[name][0]:.3f}" for name in names), f"{ours} / {rival}"])
    return table(["motion", "interval [s]", "pairs", *names.values(), "printed: theirs / icp + ransac"], rows)


def sequences(kitti: Path | None, numbers: dict) -> dict[str, Dataset]:
    return {} if kitti is None else {number: open_dataset(kitti, sequence=number) for number in numbers}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--static", type=Path, nargs="+", default=[])
    parser.add_argument("--moving", type=Path, nargs="+", default=[])
    parser.add_argument("--kitti", type=Path)
    parser.add_argument("--human", action="store_true")
    parser.add_argument("--n-scans", type=int, default=5)
    options = parser.parse_args()
    static = {folder.name: open_dataset(folder) for folder in options.static}
    moving = {folder.name: open_dataset(folder) for folder in options.moving}
    if static or options.kitti:
        print("Table I\n")
        print(table_1(static | sequences(options.kitti, PRINTED_1), options.n_scans), "\n", flush=True)
    if moving or options.kitti:
        print("Table II\n")
        print(table_2(moving | sequences(options.kitti, PRINTED_2), options.n_scans), "\n", flush=True)
    if options.human:
        print("Table III: crispness / mean end-point error [m] of the person\n")
        print(table_3(options.n_scans))


if __name__ == "__main__":
    main()
