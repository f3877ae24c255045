"""Scores, seconds per stage and peak memory of whole folders of scans, as Markdown tables.

    python scripts/evaluate.py FOLDER… [--config configs/dewan2016.toml] [--n-scans 3] [--json OUT.json]

Every folder is processed in a process of its own, so that its peak memory is its own. One pair is
processed beforehand, unmeasured, so that compiling is not counted. Rows are means over pairs.
"""

import argparse
import json
import multiprocessing
import resource
from pathlib import Path

import numpy as np

from lidarflow import config as settings
from lidarflow import pair_reports, pipeline, runner
from lidarflow.datasets import open_dataset

SCORES = {
    "epe_all_m": "all", "epe_static_m": "static", "epe_dynamic_m": "moving",
    "epe_dynamic_median_m": "moving, median",
    "dynamic_error_over_speed": "moving, error over speed", "strict_accuracy": "strict accuracy",
    "strict_accuracy_static": "strict, static", "strict_accuracy_dynamic": "strict, moving",
    "epe_foreground_dynamic_m": "foreground dynamic", "epe_foreground_static_m": "foreground static",
    "epe_background_static_m": "background static", "epe_three_way_m": "three-way",
    "dynamic_iou": "dynamic IoU", "bucketed_static_m": "bucketed static",
    "bucketed_dynamic": "bucketed moving", "graph_epe_static_m": "graph static",
    "graph_epe_dynamic_m": "graph moving", "graph_epe_dynamic_median_m": "graph moving, median",
    "t_e_m": "t_e [m]", "r_e_rad": "r_e [rad]", "ego_error_m": "ego [m]", "ego_error_deg": "ego [deg]",
    "movers_found": "movers found", "false_movers": "false movers",
    "crispness_before": "crispness before", "crispness_by_ego": "by ego-motion",
    "crispness_after": "after", "objects": "objects",
}
OF_THE_GRAPH = ("graph", "t_e", "r_e")   # scores that mean something for a graph of all points only


def evaluate(job: tuple[Path, int | None, settings.Config]) -> dict:
    """Mean scores and seconds per stage of one folder, and the process's peak memory in GB."""
    folder, n_scans, config = job
    dataset = open_dataset(folder, kitti_correction=config.preparation.kitti_correction)
    frames = runner.choose_frames(dataset, 0, n_scans)
    for _ in pipeline.run(dataset, frames[:2], pipeline.FlowEstimator(config)):
        pass
    results = pipeline.run(dataset, frames, pipeline.FlowEstimator(config))
    reports = pair_reports.without_poorer_truth([
        pair_reports.report_pair(dataset, index, pair, result, config)
        for index, (pair, result) in zip(frames, results, strict=False)
    ])
    stages = dict.fromkeys(stage for report in reports for stage in report.seconds)
    return {
        "folder": folder.name,
        "pairs": len(reports),
        "truth": pair_reports.truth_of([report.truth for report in reports]),
        "points": float(np.mean([report.points for report in reports])),
        "graph_points": float(np.mean([report.graph_points for report in reports])),
        "scores": pair_reports.mean_of(reports),
        "seconds": {s: float(np.mean([r.seconds.get(s, 0.0) for r in reports])) for s in stages},
        "peak_memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.3f}"


def score_table(found: list[dict], config: settings.Config) -> str:
    """Scores, one column per folder; those of the graph only where it holds all points."""
    rows = [["truth", *(f["truth"].partition(" ")[0] for f in found)],
            ["pairs", *(str(f["pairs"]) for f in found)],
            ["points", *(f"{f['points']:.0f}" for f in found)],
            ["graph points", *(f"{f['graph_points']:.0f}" for f in found)]]
    for name, title in SCORES.items():
        values = [f["scores"].get(name) for f in found]
        if config.objects.enabled and name.startswith(OF_THE_GRAPH):
            continue
        if any(value is not None for value in values):
            digits = (lambda v: "-" if v is None else f"{100 * v:.2f} %") if "movers" in name else number
            rows.append([title, *(digits(value) for value in values)])
    return table(["", *(f["folder"] for f in found)], rows)


def time_table(found: list[dict]) -> str:
    """Seconds per stage and pair, one column per folder."""
    stages = dict.fromkeys(stage for f in found for stage in f["seconds"])
    rows = [[stage, *(f"{f['seconds'].get(stage, 0.0):.2f}" for f in found)] for stage in stages]
    rows.append(["whole pair", *(f"{sum(f['seconds'].values()):.2f}" for f in found)])
    without = [sum(v for s, v in f["seconds"].items() if s != "solver") for f in found]
    rows.append(["all but the solver", *(f"{value:.2f}" for value in without)])
    rows.append(["peak memory [GB]", *(f"{f['peak_memory_gb']:.2f}" for f in found)])
    return table(["seconds per pair", *(f["folder"] for f in found)], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--config", type=Path)
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--n-scans", type=int)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    config = settings.load(options.config, tuple(options.overrides))
    jobs = [(folder, options.n_scans, config) for folder in options.folders]
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        found = list(pool.imap(evaluate, jobs))
    print(score_table(found, config), "\n")
    print(time_table(found))
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
