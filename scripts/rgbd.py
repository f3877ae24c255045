"""RGB-D figures: the paper's pairs, drift over real sequences, rendered rooms, times; Markdown tables.

    python scripts/rgbd.py --pairs DATA/rgbd_joint_vo_sf_pairs
    python scripts/rgbd.py --drift DATA/rgbd_tum_fr1_desk9 DATA/rgbd_open3d5
    python scripts/rgbd.py --rooms 8
    python scripts/rgbd.py --exposures 4
    python scripts/rgbd.py --likeness DATA/rgbd_open3d5 DATA/rgbd_joint_vo_sf_pairs/*/
    python scripts/rgbd.py --times DATA/rgbd_joint_vo_sf_pairs

Settings by --config and --set. Every row is made by the methods that the command line offers.
"""

import argparse
import statistics
import time
from pathlib import Path

import numba
import numpy as np

from lidarflow import config as settings
from lidarflow import pose, rgbd_methods, rgbd_metrics, synthetic
from lidarflow.datasets import tum
from lidarflow.datasets.rgbd_folders import RgbdFolder, open_rgbd
from lidarflow.errors import DataError
from lidarflow.rgbd import pyramid
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdPair, RgbdResult
from lidarflow.settings import updated

ROOT = Path(__file__).resolve().parent.parent
PAPER = settings.load(ROOT / "configs" / "rgbd" / "jaimez2017.toml", kind=RgbdConfig)
# Jaimez et al. 2017, Table III: photometric and geometric residual.
TABLE_3 = {"two_people_walking": (0.0284, 0.0360), "robot": (0.0251, 0.0643),
           "cleaning_whiteboard": (0.0214, 0.0377)}
CLOCK_NS = 20_000_000      # by which the TUM camera's clock is behind that of the poses
ROOMS = {"living_room": (synthetic.living_room, 4), "passing_wardrobe": (synthetic.passing_wardrobe, 19)}
FIRST_SEED = 100           # the tests look at 1 and a few more; nothing was chosen by looking at these
REPETITIONS, WARM_UP = 25, 3
EXPOSURES = ((1.0, 0.0), (1.05, 0.0), (1.3, 0.0), (0.75, 0.0), (1.0, 0.1), (1.3, 0.1), (0.7, -0.05))


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def pair_of(folder: RgbdFolder) -> RgbdPair:
    return RgbdPair(folder.frame(0), folder.frame(1), folder.camera)


def pairs_table(data: Path, config: RgbdConfig) -> str:
    """Residuals after warping beside the paper's Table III."""
    rows = []
    for name, (photometric, geometric_m) in TABLE_3.items():
        pair = pair_of(open_rgbd(data / name))
        found = {label: (result := rgbd_methods.estimate_flow(method, pair, chosen),
                         rgbd_metrics.warp_scores(pair, result))
                 for label, method, chosen in (("ours", "ours", config), ("paper", "ours", PAPER),
                                               ("open3d", "open3d", config))}
        ours, scores = found["ours"]
        moving, occluded = 100 * ours.is_dynamic[ours.valid].mean(), 100 * scores.after.occluded
        rows.append([name.replace("_", " "), both(scores.before), f"{photometric:.4f} / {geometric_m:.4f}",
                     both(scores.after), both(found["paper"][1].after), both(scores.by_odometry),
                     both(found["open3d"][1].after), f"{occluded:.1f} %", f"{moving:.0f} %"])
    return table(["photometric / geometric [m]", "before", "paper", "ours", "ours, its settings",
                  "our odometry", "Open3D odometry", "occluded", "moving"], rows)


def both(found: rgbd_metrics.Residuals) -> str:
    return f"{found.photometric:.4f} / {found.geometric_m:.4f}"


def steps_of(method: str, folder: RgbdFolder, config: RgbdConfig) -> tuple[np.ndarray, float]:
    """Odometry (N, 4, 4) of a folder's pairs, and the mean share of pixels held to be moving."""
    estimator = rgbd_methods.estimator(method, folder.camera, config)
    results = [estimator.step(folder.frame(index)) for index in range(len(folder))][1:]
    return (np.stack([result.odometry for result in results]),
            float(np.mean([result.is_dynamic[result.valid].mean() for result in results])))


def drift_table(folders: list[Path], config: RgbdConfig) -> str:
    """Drift against given poses, beside Open3D's; with the poses' clock moved where it can be."""
    rows = []
    for path in folders:
        folder = open_rgbd(path)
        frames = [folder.frame(index) for index in range(len(folder))]
        times_ns = np.array([frame.time_ns for frame in frames])
        depth = [rgbd_metrics.depth_statistics(frame.depth) for frame in frames]
        given = {"": folder.world_from_camera()}
        if (path / "groundtruth.txt").is_file():
            poses = tum.read_poses(path / "groundtruth.txt")
            given[", poses 20 ms earlier"] = tum.poses_at(times_ns - CLOCK_NS, *poses)
        full = updated(config, {"images": {"width": folder.camera.width}})
        for name, method, chosen in (("ours", "ours", config), ("Open3D", "open3d", config),
                                     ("Open3D, full size", "open3d", full)):
            steps, moving = steps_of(method, folder, chosen)
            for label, true in given.items():
                found = rgbd_metrics.drift(pose.trajectory(steps), true, times_ns)
                rows.append([
                    path.name + label, name, str(found.frames), f"{1000 * found.per_frame_m:.2f}",
                    f"{found.per_frame_deg:.3f}", second(100 * found.per_second_m),
                    second(found.per_second_deg), f"{100 * moving:.1f} %",
                    f"{100 * np.mean([d.valid for d in depth]):.0f} %",
                    f"{np.mean([d.mean_m for d in depth]):.2f}"])
    return table(["sequence", "method", "steps", "mm a frame", "deg a frame", "cm/s", "deg/s", "held moving",
                  "with depth", "mean depth [m]"], rows)


def second(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "-"


def rooms_table(count: int, config: RgbdConfig) -> str:
    """Errors in `count` rendered rooms of each kind, whose truth is known: median and worst pair."""
    camera = Camera.from_field_of_view(320, 240)
    plain = updated(config, {"segmentation": {"enabled": False}})
    ways = {"ours": ("ours", config), "ours, no segmentation": ("ours", plain),
            "ours, the paper's settings": ("ours", PAPER), "Open3D odometry": ("open3d", config)}
    rows = []
    for room, (make, frames) in ROOMS.items():
        scores = {name: [] for name in ways}
        for seed in range(FIRST_SEED, FIRST_SEED + count):
            rng = np.random.default_rng(seed)
            sequence = synthetic.rgbd_sequence(make(rng), synthetic.RgbdSensor(camera), frames, rng)
            for name, (method, chosen) in ways.items():
                estimator = rgbd_methods.estimator(method, camera, chosen)
                results = [estimator.step(frame) for frame, _ in sequence][1:]
                scores[name] += [rgbd_metrics.score(result, truth)
                                 for result, (_, truth) in zip(results, sequence[:-1], strict=True)]
        for name, found in scores.items():
            rows.append([room.replace("_", " "), name, str(len(found)),
                         spread(found, "odometry_error_m", max, 1000, 1),
                         spread(found, "odometry_error_deg", max, 1, 3), spread(found, "iou", min, 1, 2),
                         spread(found, "wrong", max, 100, 1), spread(found, "epe_static_m", max, 1000, 1),
                         spread(found, "epe_moving_m", max, 1000, 1)])
    return table(["room", "method", "pairs", "odometry [mm]", "[deg]", "moving IoU", "wrongly segmented [%]",
                  "static EPE [mm]", "moving EPE [mm]"], rows)


def spread(scores: list[rgbd_metrics.RgbdScores], name: str, worst, factor: float, digits: int) -> str:
    values = [factor * value for value in (getattr(score, name) for score in scores) if np.isfinite(value)]
    return f"{statistics.median(values):.{digits}f} / {worst(values):.{digits}f}" if values else "-"


def exposures_table(count: int, config: RgbdConfig) -> str:
    """Errors in `count` rendered rooms of each kind where the second image has another gain and offset."""
    camera = Camera.from_field_of_view(320, 240)
    left = updated(config, {"images": {"max_exposure_change": 1.0}})
    rows = []
    for room, (make, frames) in ROOMS.items():
        pairs = []
        for seed in range(FIRST_SEED, FIRST_SEED + count):
            rng = np.random.default_rng(seed)
            sequence = synthetic.rgbd_sequence(make(rng), synthetic.RgbdSensor(camera), frames, rng)
            pairs += [(sequence[k][0], sequence[k + 1][0], sequence[k][1]) for k in range(0, frames - 1, 3)]
        for gain, offset in EXPOSURES:
            for name, chosen in (("undone", config), ("left", left)):
                found, refused = [], 0
                for source, target, truth in pairs:
                    pair = RgbdPair(source, exposed(target, gain, offset), camera)
                    try:
                        result = rgbd_methods.estimate_flow("ours", pair, chosen)
                        found.append(rgbd_metrics.score(result, truth))
                    except DataError:
                        refused += 1
                rows.append([room.replace("_", " "), f"{gain:g} I {offset:+g}", name, f"{len(pairs)}",
                             f"{refused}", spread(found, "odometry_error_m", max, 1000, 1),
                             spread(found, "odometry_error_deg", max, 1, 3), spread(found, "iou", min, 1, 2),
                             spread(found, "epe_m", max, 1000, 1)])
    return table(["room", "second image", "exposure", "pairs", "refused", "odometry [mm]", "[deg]",
                  "moving IoU", "EPE [mm]"], rows)


def exposed(frame: RgbdFrame, gain: float, offset: float) -> RgbdFrame:
    """The frame as a sensor of 256 greys has it in another exposure."""
    greys = np.round(255.0 * np.clip(gain * frame.intensity + offset, 0.0, 1.0)).astype(np.float32)
    return RgbdFrame(greys / np.float32(255.0), frame.depth, frame.time_ns, frame.name)


def likeness_table(folders: list[Path], config: RgbdConfig) -> str:
    """How many pairs are refused: consecutive frames of each folder, and frames of one and of another."""
    opened = [open_rgbd(path) for path in folders]
    small = [[pyramid.at_working_size(folder.frame(k), folder.camera, config.images)
              for k in range(len(folder))] for folder in opened]
    pairs = {"consecutive": [(frames[k][0], frames[k + 1][0], frames[k][1])
                             for frames in small for k in range(len(frames) - 1)],
             "of two folders": [(a[i][0], b[j][0], a[i][1]) for a in small for b in small if a is not b
                                for i in (0, len(a) // 2, -1) for j in (0, -1)]}
    rows = []
    for name, of_kind in pairs.items():
        reasons = []
        for source, target, camera in of_kind:
            try:
                rgbd_methods.estimate_flow("ours", RgbdPair(source, target, camera), config)
            except DataError as error:
                reasons.append("likeness" if "brightness" in str(error) else "overlap")
        rows.append([name, str(len(of_kind)), str(reasons.count("overlap")), str(reasons.count("likeness"))])
    return table(["frames", "pairs", "refused for their overlap", "for their likeness"], rows)


def times_table(data: Path, config: RgbdConfig) -> str:
    """Median milliseconds of a pair at the working size, images in memory, methods in turn."""
    ways = list(rgbd_methods.METHODS)
    rows = []
    for name in TABLE_3:
        pair = pair_of(open_rgbd(data / name))
        source, camera = pyramid.at_working_size(pair.source, pair.camera, config.images)
        target, _ = pyramid.at_working_size(pair.target, pair.camera, config.images)
        small = RgbdPair(source, target, camera)
        measured: dict[str, list[tuple[float, RgbdResult]]] = {way: [] for way in ways}
        for round_ in range(WARM_UP + REPETITIONS):
            for way in ways:
                begin = time.perf_counter()
                result = rgbd_methods.estimate_flow(way, small, config)
                if round_ >= WARM_UP:
                    measured[way].append((time.perf_counter() - begin, result))
        for way, runs in measured.items():
            stages = {stage: statistics.median(1000 * result.seconds.get(stage, 0.0) for _, result in runs)
                      for stage in runs[0][1].seconds}
            rows.append([name.replace("_", " "), way, f"{camera.width}x{camera.height}",
                         f"{1000 * statistics.median(seconds for seconds, _ in runs):.1f}",
                         ", ".join(f"{stage} {ms:.1f}" for stage, ms in stages.items())])
    heading = f"ms, median of {REPETITIONS}, {numba.get_num_threads()} threads"
    return table(["pair", "method", "images", heading, "stages (of the last step)"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--pairs", type=Path)
    parser.add_argument("--drift", type=Path, nargs="+")
    parser.add_argument("--rooms", type=int, metavar="COUNT")
    parser.add_argument("--exposures", type=int, metavar="COUNT")
    parser.add_argument("--likeness", type=Path, nargs="+")
    parser.add_argument("--times", type=Path)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    options = parser.parse_args()
    config = settings.load(options.config, tuple(options.overrides), RgbdConfig)
    for wanted, make in ((options.pairs, pairs_table), (options.drift, drift_table),
                         (options.rooms, rooms_table), (options.exposures, exposures_table),
                         (options.likeness, likeness_table), (options.times, times_table)):
        if wanted:
            print(make(wanted, config), "\n")


if __name__ == "__main__":
    main()
