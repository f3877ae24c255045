"""Mutated files for every reader: run as a program, it reads so many and reports what went wrong.

    python tests/fuzzing.py COUNT SEED FOLDER

A reader may refuse a file with LidarflowError or return something; it may not raise anything else, take long,
or allocate far more than the file can hold. The file being read is FOLDER/now_*, so that it is there after a
crash.
"""

import json
import re
import resource
import signal
import sys
import time
import tracemalloc
import warnings
from dataclasses import asdict
from pathlib import Path

import numpy as np
from cloud_files import POINTS, WRITERS
from PIL import Image

from lidarflow import config, evaluation, flow_files, io, pose, provenance, rgbd_io
from lidarflow.checkpoints import Stretch, packed, unpacked
from lidarflow.config import Config
from lidarflow.datasets import (
    argoverse2,
    argoverse2_map,
    kitti_labels,
    range_images,
    rgbd_images,
    tables,
    tum,
)
from lidarflow.datasets.base import read_truth
from lidarflow.datasets.clouds import read_points
from lidarflow.errors import LidarflowError
from lidarflow.lidar.tracking import Track, Tracks
from lidarflow.report import reading
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdResult
from lidarflow.types import FlowResult, MovingObject, Scan, ScanPair, SolveStats

SECONDS = 5.0
# Deflate packs a thousandfold at most; decoders and Python's own texts need room of their own.
MOST_TIMES, MOST_TIMES_PACKED, ROOM_BYTES = 200, 2200, 8 << 20
PACKED = (".npz", ".png", ".jpg", ".feather")
MOST_ADDRESS_SPACE = 4 << 30     # beyond what the process has before it begins
_NUMBERS = [b"1000000000000", b"-1", b"0", b"99999999999999999999", b"1e308", b"-1e400", b"nan", b"inf",
            b"x", b"9" * 5000, b"4294967296", b""]
_WORDS = [np.array(value, kind).tobytes() for value, kind in (
    (10**12, "<u8"), (2**64 - 1, "<u8"), (2**63 - 1, "<i8"), (2**32 - 1, "<u4"), (2**31 - 1, "<i4"),
    (0, "<u8"), (0, "<u4"), (np.nan, "<f4"), (np.inf, "<f8"), (1e300, "<f8"), (-3e38, "<f4"), (10**12, ">u8"),
    (2**31 - 1, ">i4"))]
STATS = SolveStats("fast", 4, 3, 3, 1, 1, 5, 2, 2.5, 0.5, 0.5, 0.25, 3, {"converged": 1})


def some_pair():
    """Two scans, a result with an object, and a track."""
    rng = np.random.default_rng(2)
    points = rng.normal(size=(40, 3)) * 10
    motions = np.tile(pose.from_yaw(0.1, (1, 2, 0)), (40, 1, 1))
    found = MovingObject(3, motions[0], np.ones(3), np.zeros(3), np.ones(3), 0.5, 7)
    result = FlowResult(
        pose.apply(motions, points) - points, motions, *(rng.random((3, 40)) < 0.5), motions[0], STATS,
        {"solver": 0.1}, points[:4], points[4:8], objects=(found,),
        object_id=np.arange(-1, 39, dtype=np.int32))
    tracks = Tracks((Track(3, points[:9], motions[0], 0.1, 1),), 4)
    return ScanPair(Scan(points, 0, "0"), Scan(points + 1, 10**8, "1")), result, tracks


def corpus(folder):
    """(a good file, what reads it) for every kind of file that is read."""
    pair, result, tracks = some_pair()
    made = []

    def add(name, write, read):
        file = folder / name
        write(file)
        read(file)      # good as it is
        made.append((file.name, file.read_bytes(), read))

    def text(content):
        return lambda file: file.write_text(content)

    for name, write in WRITERS.items():
        add(name, write, read_points)
    _add_archives(add, pair, result, tracks)
    _add_tables(add, text)
    _add_images(add, text, folder)
    add("settings.toml", lambda file: io.write_toml(file, Config()), config.load)
    add("rgbd.toml", lambda file: io.write_toml(file, RgbdConfig()),
        lambda file: config.load(file, (), RgbdConfig))
    add("camera.toml", text("width = 320\nheight = 240\nfx = 300.0\nfy = 300.0\ncx = 160\ncy = 120\n"),
        rgbd_images.read_camera)
    described = {"data": "/data", "loader": "kitti", "sequence": "00", "kitti_correction": "auto",
                 "scans": [0, 1, 2], "skipped": [1]}
    add(io.SOURCE_FILE, text(json.dumps(described)),
        lambda file: provenance.read(_renamed(file, io.SOURCE_FILE)))
    report = {"crispness_sigma_m": 0.1, "truth": "flow", "mean": {"a": 1.0}, "std": {"a": 0.1}, "pairs": [
        {"frame": "0", "points": 9, "graph_points": 4, "moving_points": 1, "objects": 0, "matches": None,
         "alignment": {"before": 0.1, "by_ego": 0.2, "after": 0.3, "sigma_m": 0.1}, "scores": None,
         "truth": "none", "stats": asdict(STATS), "valid_share": 0.5}]}
    add(io.METRICS_FILE, text(json.dumps(report)),
        lambda file: _read_figures(_renamed(file, io.METRICS_FILE)))
    return made


def _read_figures(run_dir):
    return reading.figures_of(reading.read_metrics(run_dir), run_dir)


def _renamed(file, name):
    """The folder of `file`, in which it has the name that readers of run folders look for."""
    (file.parent / "run").mkdir(exist_ok=True)
    (file.parent / "run" / name).write_bytes(file.read_bytes())
    return file.parent / "run"


def _add_archives(add, pair, result, tracks):
    points = pair.source.points
    add("flow.npz", lambda file: flow_files.save_flow(file, points, result, Config()),
        evaluation._read)
    add("checkpoint.npz", lambda file: file.write_bytes(packed(pair, result, tracks, Stretch(0, 0))),
        lambda file: unpacked(file, pair))
    truth = {"flow": result.flow, "valid": result.valid, "dynamic": result.is_dynamic,
             "track": result.object_id, "target_from_source": result.ego_motion}
    add("truth.npz", lambda file: np.savez_compressed(file, **truth), lambda file: read_truth(file, 40, "0"))
    add("rgbd.npz", _write_rgbd_flow, rgbd_io.load_flow)


def _write_rgbd_flow(file):
    height, width, count = 6, 8, 2
    image, camera = np.ones((height, width), np.float32), Camera.from_field_of_view(width, height)
    points = camera.points(image)
    motion = pose.from_yaw(0.1)
    result = RgbdResult(points * 0, points, image > 0, np.zeros((height, width), np.int32), np.zeros(count),
                        np.tile(motion, (count, 1, 1)), motion, image < 0, camera,
                        np.ones((count, 3), np.float32))
    rgbd_io.save_flow(file, RgbdFrame(image * 0.5, image), result, RgbdConfig(), {"method": "ours"})


def _add_tables(add, text):
    import pyarrow
    from pyarrow import feather

    sweep = pyarrow.table({axis: POINTS[:, k].astype("f2") for k, axis in enumerate("xyz")})
    add("sweep.feather", lambda file: feather.write_feather(sweep, file),
        lambda file: argoverse2.read_columns(file, ("x", "y", "z")))
    boxes = pyarrow.table({"timestamp_ns": [1, 2], "track_uuid": ["a", "b"], "category": ["BUS", "DOG"]})
    add("boxes.feather", lambda file: feather.write_feather(boxes, file, compression="uncompressed"),
        lambda file: argoverse2.read_columns(file, ("timestamp_ns", "track_uuid", "category")))
    row = "1 0 0 0.5 0 1 0 0.25 0 0 1 0\n"
    add("poses.txt", text(row * 3), tables.read_motions)
    add("indexed.txt", text("# frame\n0 " + row + "1 " + row), tables.read_indexed_motions)
    add("tum.txt", text("# t\n1.5 0 0 0 0 0 0 1\n2.5 1 0 0 0 0 0 1\n"), tum.read_poses)
    add("rgb.txt", text("1.5 rgb/1.png\n2.5 rgb/2.png\n"), tum.read_list)
    add("times.txt", text("0.0\n1.037e-01\n2.07e-01\n"), tables.read_seconds)
    add("dates.txt", text("2011-09-26 13:02:25.951199337\n"), tables.read_dates)
    add("calib.txt", text("P0: 1 0 0\nTr: " + row), lambda file: tables.motion_of_text(
        file, tables.read_named(file).get("Tr", "")))
    add("labels.txt", text("0 1 Car 0 0 -1.5 0 0 10 10 1.5 1.6 4.0 2.0 1.5 20.0 -1.5\n"
                           "0 -1 DontCare -1 -1 -10 219 188 245 218 -1000 -1000 -1000 -10 -1 -1 -1\n"),
        lambda file: kitti_labels.read_tracking(file, np.eye(4)))
    add("boxes.csv", text(",".join(kitti_labels.TABLE_COLUMNS) + "\n0,1,Car,1,2,3,4,2,1.5,0.1\n"),
        kitti_labels.read_table)
    add("tracklets.xml", text(
        "<boost><tracklets><item><objectType>Car</objectType><h>1.5</h><w>1.6</w><l>4</l><first_frame>0"
        "</first_frame><poses><item><tx>1</tx><ty>2</ty><tz>0</tz><rz>0.1</rz></item></poses></item>"
        "</tracklets></boost>"), kitti_labels.read_tracklets)
    add("objects.csv", text(",".join(io.OBJECT_COLUMNS) + "\n0,1,9" + ",1.0" * 11 + "\n"),
        reading._read_objects)
    add("height.npy", lambda file: np.save(file, np.ones((4, 5))), argoverse2_map._read_raster)
    add("map.json", text('{"R": [1, 0, 0, 1], "t": [1, 2], "s": 3.3}'), argoverse2_map._read_similarity)


def _add_images(add, text, folder):
    rng = np.random.default_rng(4)
    colours = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
    depth = rng.integers(1, 9000, (24, 32)).astype(np.uint16)
    for suffix in ("png", "jpg"):
        add(f"color.{suffix}", lambda file: Image.fromarray(colours).save(file), rgbd_images.read_color)
    add("depth.png", lambda file: Image.fromarray(depth).save(file), rgbd_images.read_depth)
    add("img.cfg", text("# w h\n32; 24; 180; -180; -2; 24\n"), range_images.read_directions)
    place = folder / "range"
    place.mkdir(exist_ok=True)
    (place / "img.cfg").write_text("32; 24; 180; -180; -2; 24\n")
    Image.fromarray(depth).save(place / "scan0.png")
    images = range_images.RangeImages(place)
    add("range.png", lambda file: Image.fromarray(depth).save(file), images._read)


def mutated(content, others, rng):
    """`content` with one to three kinds of damage, seldom that of another kind of file altogether."""
    for _ in range(rng.integers(1, 4)):
        change = _MUTATIONS[rng.integers(len(_MUTATIONS))]
        if content[:2] == b"PK" and rng.random() < 0.5:
            change = _other_array
        content = change(bytearray(content), others, rng)
    return bytes(content)


def _flip_bits(content, others, rng):
    for place in rng.integers(0, 8 * max(1, len(content)), rng.integers(1, 9)).tolist():
        if content:
            content[place // 8] ^= 1 << place % 8
    return content


def _truncate(content, others, rng):
    return content[:rng.integers(0, len(content) + 1)]


def _lie_in_text(content, others, rng):
    found = list(re.finditer(rb"-?\d+(\.\d+)?", bytes(content)))
    if found:
        match = found[rng.integers(len(found))]
        content[match.start():match.end()] = _NUMBERS[rng.integers(len(_NUMBERS))]
    return content


def _lie_in_bytes(content, others, rng):
    word = _WORDS[rng.integers(len(_WORDS))]
    at = int(rng.integers(0, len(content) + 1))
    at = at // 4 * 4 if rng.random() < 0.5 else at
    content[at:at + len(word)] = word
    return content


def _copy_part(content, others, rng):
    first, last = sorted(rng.integers(0, len(content) + 1, 2).tolist())
    at = int(rng.integers(0, len(content) + 1))
    content[at:at] = content[first:last] * int(rng.integers(1, 4))
    return content


def _cut_part(content, others, rng):
    first, last = sorted(rng.integers(0, len(content) + 1, 2).tolist())
    del content[first:last]
    return content


def _nest(content, others, rng):
    at = int(rng.integers(0, len(content) + 1))
    content[at:at] = [b"[", b'{"a":', b"<a>", b"a=[", b"\n"][rng.integers(5)] * 3000
    return content


def _other_file(content, others, rng):
    other = others[rng.integers(len(others))]
    return bytearray(other[:rng.integers(0, len(other) + 1)]) + content[rng.integers(0, len(content) + 1):]


def _other_array(content, others, rng):
    """In an archive, one array of another shape, type or size than its header says; checksums are right."""
    from io import BytesIO
    from zipfile import BadZipFile, ZipFile

    try:
        with ZipFile(BytesIO(content)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except (BadZipFile, NotImplementedError, ValueError, EOFError, OSError, RuntimeError, KeyError):
        return _flip_bits(content, others, rng)
    except Exception as error:      # zlib.error has no common base
        if type(error).__module__ != "zlib":
            raise
        return _flip_bits(content, others, rng)
    name = sorted(members)[rng.integers(len(members))] if members else "a.npy"
    if rng.random() < 0.5:
        values = [np.zeros(3), np.full((40, 3), np.nan), np.full(40, 1e300), np.array("nan"),
                  np.zeros((0, 3)), np.array(["a"] * 40), np.array([{}], object), np.full((4, 4), np.inf),
                  np.array(5), np.full(40, -(2**40)), np.array('{"solver": 1}'), np.array("[" * 3000),
                  np.zeros((40, 3, 2)), np.full(40, 2**31 - 1, np.int32), np.zeros((1, 10**6), bool)]
        made = BytesIO()
        np.save(made, values[rng.integers(len(values))], allow_pickle=True)
        members[name] = made.getvalue()
    else:
        members[name] = bytes(_lie_in_text(bytearray(members.get(name, b"")), others, rng))
    made = BytesIO()
    with ZipFile(made, "w", compression=8) as archive:
        for key, value in members.items():
            archive.writestr(key, value)
    return bytearray(made.getvalue())


_MUTATIONS = (_flip_bits, _truncate, _lie_in_text, _lie_in_text, _lie_in_bytes, _lie_in_bytes, _copy_part,
              _cut_part, _nest, _other_file, _other_array, _other_array)


class TooSlow(BaseException):
    """A file took longer than SECONDS."""


def _stop(*_):
    raise TooSlow


def complaint(read, file):
    """What is wrong with how `read` treats a file; None if it refuses it properly, or reads it."""
    allowed = MOST_TIMES_PACKED if file.suffix in PACKED else MOST_TIMES
    tracemalloc.reset_peak()
    before, begin = tracemalloc.get_traced_memory()[0], time.perf_counter()
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        read(file)
    except LidarflowError as error:
        if not str(error) or len(str(error)) > 20_000:
            return f"a message of {len(str(error))} characters"
    except (Exception, TooSlow) as error:
        return f"{type(error).__name__}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    peak = tracemalloc.get_traced_memory()[1] - before
    if peak > allowed * file.stat().st_size + ROOM_BYTES:
        return f"{peak >> 20} MiB for {file.stat().st_size} bytes"
    spent_s = time.perf_counter() - begin
    return f"{spent_s:.1f} s" if spent_s > SECONDS else None


def limit_address_space():
    """No more than MOST_ADDRESS_SPACE beyond what there is now: what tracemalloc does not see ends here."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        most = int(statm.read_text().split()[0]) * resource.getpagesize() + MOST_ADDRESS_SPACE
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def main(count, seed, folder):
    """Read `count` mutated files; one line of JSON for each that went wrong, and one with what was done."""
    warnings.simplefilter("ignore")
    kinds = corpus(folder)
    rng = np.random.default_rng(seed)
    contents = [content for _, content, _ in kinds]
    signal.signal(signal.SIGALRM, _stop)
    limit_address_space()
    tracemalloc.start()
    read_well = 0
    for number in range(count):
        name, content, read = kinds[number % len(kinds)]
        file = folder / f"now_{name}"
        file.write_bytes(mutated(content, contents, rng))
        wrong = complaint(read, file)
        if wrong is not None:
            kept = folder / f"wrong_{number}_{name}"
            kept.write_bytes(file.read_bytes())
            print(json.dumps({"number": number, "file": kept.name, "wrong": wrong}), flush=True)
        file.unlink()
        read_well += wrong is None
    print(json.dumps({"kinds": len(kinds), "files": count, "well": read_well}), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
