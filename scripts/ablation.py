"""What each part of the search for moving objects gives, and how much its settings matter.

    python scripts/ablation.py FOLDER… [--static FOLDER…] [--sensitivity] [--n-scans 3] [--json OUT.json]

FOLDERs have true flow; in those after --static nothing moves. Without --sensitivity, one part is left out a
row; with it, every setting of the search is halved and doubled in turn. Rows are means over all pairs, each
pair by itself: what comes before the search is done once.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np
from evaluate import table

from lidarflow import config as settings
from lidarflow import pair_reports, pipeline, runner
from lidarflow.datasets import Dataset, open_dataset
from lidarflow.types import ScanPair

LEFT_OUT = {
    "all parts (default)": (),
    "no objects, no ties: the graph alone": ("objects.enabled=false",),
    "paper's settings": None,
    "ties let nothing go": ("solver.tie_truncation=10",),
    "ties 100 times weaker": ("solver.tie_weight=1",),
    "no coherent shifts: only points left behind": ("objects.min_shift_m=100",),
    "motion not held along the ground": ("objects.along_ground=0",),
    "planes need not see the motion": ("objects.min_observability=0",),
    "matches need not agree": ("objects.min_matches=0", "objects.max_match_deviation=2"),
    "space left and taken not asked for": ("objects.min_unexplained=0",),
    "nothing need stand on the ground": ("objects.max_clearance_m=100",),
    "any gain of shape will do": ("objects.max_shape_ratio=1",),
}
COLUMNS = {
    "epe_static_m": "static [m]", "epe_dynamic_m": "moving [m]", "epe_dynamic_median_m": "median [m]",
    "movers_found": "found", "false_movers": "false",
}


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A pair whose features, ego-motion, mesh and matches are done, and where it comes from."""

    dataset: Dataset
    index: int
    pair: ScanPair


def cases(folders: list[Path], n_scans: int | None) -> list[Case]:
    """Every pair of the folders."""
    found, config = [], settings.Config()
    for folder in folders:
        dataset = open_dataset(folder, kitti_correction=config.preparation.kitti_correction)
        scans = [dataset.scan(frame) for frame in runner.choose_frames(dataset, 0, n_scans)]
        for index, pair in enumerate(pairwise(scans)):
            found.append(Case(dataset, index, ScanPair(*pair)))
    return found


def scores(with_truth: list[Case], static: list[Case], config: settings.Config) -> dict:
    """Means of COLUMNS over the pairs with truth, and how many objects a static pair has."""
    figures = [_figures(case, config) for case in with_truth]
    found = {}
    for name in COLUMNS:
        values = [row[name] for row in figures if np.isfinite(row.get(name, np.nan))]
        found[name] = float(np.mean(values)) if values else float("nan")
    objects = [_figures(case, config)["objects"] for case in static]
    return found | {"objects_in_static": float(np.mean(objects)) if objects else float("nan")}


def _figures(case: Case, config: settings.Config) -> dict[str, float]:
    result = pipeline.estimate_flow(case.pair, config)
    return pair_reports.figures_of(
        pair_reports.report_pair(case.dataset, case.index, case.pair, result, config))


def halved_and_doubled() -> Iterator[tuple[str, tuple[str, ...]]]:
    """A row for each numeric setting of objects and ties, halved and doubled, within its bounds."""
    yield "defaults", ()
    defaults = settings.Config()
    chosen = [("objects", f) for f in fields(defaults.objects)]
    chosen += [("solver", f) for f in fields(defaults.solver) if f.name.startswith("tie_")]
    for section, f in chosen:
        value = getattr(getattr(defaults, section), f.name)
        if isinstance(value, bool):
            continue
        for factor in (0.5, 2.0):
            low, high = f.metadata["low"], f.metadata["high"]
            changed = type(value)(np.clip(factor * value, low, np.inf if high is None else high))
            yield f"{section}.{f.name} {value:g} → {changed:g}", (f"{section}.{f.name}={changed!r}",)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--static", type=Path, nargs="+", default=[])
    parser.add_argument("--sensitivity", action="store_true")
    parser.add_argument("--paper", type=Path, default=Path("configs/dewan2016.toml"))
    parser.add_argument("--n-scans", type=int)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with_truth, static = cases(options.folders, options.n_scans), cases(options.static, options.n_scans)
    rows, kept = [], {}
    for title, overrides in halved_and_doubled() if options.sensitivity else LEFT_OUT.items():
        config = settings.load(options.paper) if overrides is None else settings.load(overrides=overrides)
        found = scores(with_truth, static, config)
        kept[title] = found
        values = [f"{100 * found[c]:.2f} %" if c in ("movers_found", "false_movers") else f"{found[c]:.4f}"
                  for c in COLUMNS]
        rows.append([title, *values, f"{found['objects_in_static']:.1f}"])
        print(" | ".join(rows[-1]), flush=True)
    print()
    print(table(["", *COLUMNS.values(), "objects in static pairs"], rows))
    if options.json:
        options.json.write_text(json.dumps(kept, indent=2) + "\n")


if __name__ == "__main__":
    main()
