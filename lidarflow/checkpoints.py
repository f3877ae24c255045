"""What a run keeps of every finished pair until it is complete, so that resuming it makes no difference.

A checkpoint is an .npz file with the whole answer of a pair in full accuracy and the tracks after it, bound
to the pair's points by a digest, and to what came before by the stretch of scans that it lies in. It is
written aside like all results and holds plain arrays only. What does not depend on the sensor serves
rgbd_checkpoints.py too.
"""

import contextlib
import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from lidarflow import io, pose
from lidarflow.checks import check
from lidarflow.datasets.arrays import ERRORS, MissingArray, from_npz
from lidarflow.errors import DataError
from lidarflow.lidar.tracking import Track, Tracks
from lidarflow.types import FlowResult, MovingObject, Scan, ScanPair, SolveStats

_PLAIN = ("valid", "in_graph", "is_dynamic", "ego_motion", "match_source", "match_target", "is_ground",
          "object_id", "std_m")
_OF_OBJECTS = {"motion": (4, 4), "velocity": (3,), "box_centre": (3,), "box_size": (3,), "box_yaw": (),
               "points": ()}
_NAMES = ("digest", "stretch", *_PLAIN, "flow", "motion_table", "motion_row", "object_ids",
          *(f"object_{name}" for name in _OF_OBJECTS), "track_ids", "track_missed", "track_took_s",
          "track_over_ground", "track_counts", "track_points", "notes")


@dataclass(frozen=True, slots=True)
class Stretch:
    """Scans in a row without a gap: all that a pair takes over from what was before lies in its stretch.

    first    int   index of its first scan
    next_id  int   the first number that no object had before it
    """

    first: int
    next_id: int

    def row(self) -> np.ndarray:
        """As (2,) int64."""
        return np.array([self.first, self.next_id], np.int64)


class CheckpointFiles:
    """The checkpoints in a run folder, one per pair, by the index of its source scan."""

    def __init__(self, run_dir: Path):
        self.folder = Path(run_dir) / io.RESUME_FOLDER

    def found(self) -> frozenset[int]:
        """Indices of the pairs that are kept."""
        return frozenset(int(file.stem) for file in self.folder.glob("*.npz") if file.stem.isdigit())

    def stretch(self, index: int) -> Stretch:
        """The stretch that the pair at `index` was computed in; DataError where its file is damaged."""
        return stretch_of(self.file(index))

    def put(self, index: int, content: bytes) -> None:
        """Keep the bytes of the checkpoint of the pair at `index`."""
        with io.written_aside(self.file(index)) as aside:
            aside.write_bytes(content)

    def remove(self) -> None:
        """Let go of all of them: the run is complete, or begins anew."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def file(self, index: int) -> Path:
        """Where the checkpoint of the pair at `index` is."""
        return self.folder / f"{index:06d}.npz"


class Checkpoints(CheckpointFiles):
    """The checkpoints of a LiDAR run."""

    def save(
        self, index: int, pair: ScanPair, result: FlowResult, tracks: Tracks, stretch: Stretch
    ) -> None:
        """Keep the answer of the pair at `index`, and the tracks after it."""
        self.put(index, packed(pair, result, tracks, stretch))

    def load(self, index: int, pair: ScanPair) -> tuple[FlowResult, Tracks]:
        """The answer of the pair at `index`, and the tracks after it.

        Raises DataError where the file is damaged, or was made of other points than the pair's.
        """
        return unpacked(self.file(index), pair)


def packed(pair: ScanPair, result: FlowResult, tracks: Tracks, stretch: Stretch) -> bytes:
    """A pair's answer and the tracks after it as the bytes of an .npz file; equal input gives equal bytes."""
    motion_table, motion_row = _distinct(result.motions)
    arrays = {name: getattr(result, name) for name in _PLAIN} | {
        "digest": np.array(_digest(pair)), "stretch": stretch.row(),
        "motion_table": motion_table, "motion_row": motion_row,
        # Most methods' flow follows from the motions to the last digit, and is not kept twice.
        "flow": result.flow if not _follows(pair.source, result) else np.empty((0, 3)),
        "object_ids": np.array([found.id for found in result.objects], np.int64),
        "track_ids": np.array([track.id for track in tracks.followed], np.int64),
        "track_missed": np.array([track.missed for track in tracks.followed], np.int64),
        "track_took_s": np.array([track.took_s for track in tracks.followed], float),
        "track_over_ground": np.array([track.over_ground for track in tracks.followed]).reshape(-1, 4, 4),
        "track_counts": np.array([len(track.points) for track in tracks.followed], np.int64),
        "track_points": np.concatenate([np.empty((0, 3)), *(track.points for track in tracks.followed)]),
        # Infinite and unknown numbers have to survive, which is why this is Python's own kind of JSON.
        "notes": np.array(json.dumps({"stats": asdict(result.stats), "seconds": result.seconds,
                                      "doubt": result.doubt, "next_id": tracks.next_id}))}
    for name, shape in _OF_OBJECTS.items():
        arrays[f"object_{name}"] = np.array(
            [getattr(found, name) for found in result.objects], float).reshape(-1, *shape)
    return io.archive(arrays)


def unpacked(file: Path, pair: ScanPair) -> tuple[FlowResult, Tracks]:
    """The answer and the tracks in a checkpoint file; DataError where it is damaged or of another pair."""
    arrays = read_bound(file, _NAMES, _digest(pair), (pair.source.name, pair.target.name))
    with naming_damage(file):
        notes = json.loads(str(arrays["notes"]))
        check("motion_row", arrays["motion_row"], (len(pair.source),), "i")
        check("motion_table", arrays["motion_table"], (None, 4, 4), "f")
        motions = arrays["motion_table"][arrays["motion_row"]]
        result = FlowResult(
            flow=arrays["flow"] if len(arrays["flow"]) else pose.apply(motions, pair.source.points)
            - pair.source.points,
            motions=motions, stats=SolveStats(**notes["stats"]), seconds=notes["seconds"],
            objects=_objects(arrays), doubt=str(notes["doubt"]),
            **{name: arrays[name] for name in _PLAIN})
        return result, Tracks(_tracks(arrays), notes["next_id"])


def read_bound(
    file: Path, names: tuple[str, ...], digest: str, pair: tuple[str, str],
) -> dict[str, np.ndarray]:
    """The arrays of a checkpoint; DataError where it is damaged, or made of a pair with another digest."""
    arrays = read_arrays(file, names)
    if str(arrays["digest"]) != digest:
        raise DataError(f"{file}: was made of other data than {pair[0]} and {pair[1]} are now; the data "
                        "changed, run again without --resume")
    return arrays


def stretch_of(file: Path) -> Stretch:
    """The stretch of scans that the pair of a checkpoint lies in; DataError where the file is damaged."""
    row = read_arrays(file, ("stretch",))["stretch"]
    with naming_damage(file):
        check("stretch", row, (2,), "i")
    return Stretch(*row.tolist())


def read_arrays(file: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Arrays of a checkpoint by their `names`; DataError where it is damaged, or of another layout."""
    try:
        with naming_damage(file):
            return from_npz(file, names)
    except MissingArray as error:
        raise DataError(f"{file}: {error}, as checkpoints of another version do; run again without --resume "
                        "to begin anew") from None


@contextlib.contextmanager
def naming_damage(file: Path) -> Iterator[None]:
    """DataError, which names the checkpoint, for what arrays that make no sense raise."""
    try:
        yield
    except (*ERRORS, IndexError) as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{file}: damaged ({reason}); delete it and resume again") from None


def digest_of(parts: Iterable[tuple[str, np.ndarray | None]]) -> str:
    """A digest of texts and the arrays that belong to them."""
    digest = hashlib.blake2b(digest_size=16)
    for text, array in parts:
        digest.update(text.encode("utf-8", "surrogateescape"))
        if array is not None:
            digest.update(array.tobytes())
    return digest.hexdigest()


@dataclass(slots=True)
class Numbers:
    """Numbers of objects in a whole run for those in a part of it: known ones, else the next that is free."""

    known: dict[int, int]
    next_id: int

    def of(self, number: int) -> int:
        """The whole run's number of what the part calls `number`."""
        if number not in self.known:
            self.known[number], self.next_id = self.next_id, self.next_id + 1
        return self.known[number]


def numbers_of(file: Path) -> np.ndarray:
    """The number (N,) of the moving object that each point of a checkpoint is on, -1 = none."""
    return read_arrays(file, ("object_id",))["object_id"]


def renumbered(file: Path, numbers: Numbers, stretch: Stretch) -> dict[str, np.ndarray]:
    """What is in a checkpoint, in the whole run's stretch and numbers of objects; tracks without one go."""
    arrays = read_arrays(file, _NAMES) | {"stretch": stretch.row()}
    arrays["object_ids"] = np.array([numbers.of(old) for old in arrays["object_ids"].tolist()], np.int64)
    old, row = np.unique(arrays["object_id"], return_inverse=True)
    new = [numbers.of(number) if number >= 0 else -1 for number in old.tolist()]
    arrays["object_id"] = np.array(new, np.int32)[row.reshape(-1)]
    is_known = np.isin(arrays["track_ids"], list(numbers.known))
    arrays["track_points"] = arrays["track_points"][np.repeat(is_known, arrays["track_counts"])]
    for name in ("track_ids", "track_missed", "track_took_s", "track_over_ground", "track_counts"):
        arrays[name] = arrays[name][is_known]
    arrays["track_ids"] = np.array([numbers.of(old) for old in arrays["track_ids"].tolist()], np.int64)
    notes = json.loads(str(arrays["notes"]))
    arrays["notes"] = np.array(json.dumps({**notes, "next_id": numbers.next_id}))
    return arrays


def _distinct(motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Motions (U, 4, 4) that differ in any bit, and which row (N,) of them each of `motions` (N, 4, 4) is."""
    words = np.ascontiguousarray(motions).reshape(-1, 16).view(np.dtype((np.void, 128))).reshape(-1)
    _, first, row = np.unique(words, return_index=True, return_inverse=True)
    return motions[first], row.astype(np.int32).reshape(-1)


def _follows(source: Scan, result: FlowResult) -> bool:
    flow = pose.apply(result.motions, source.points) - source.points
    return len(flow) > 0 and flow.tobytes() == np.ascontiguousarray(result.flow).tobytes()


def _digest(pair: ScanPair) -> str:
    return digest_of((f"{scan.name} {scan.time_ns} {len(scan)} ", scan.points)
                     for scan in (pair.source, pair.target))


def _objects(arrays: dict[str, np.ndarray]) -> tuple[MovingObject, ...]:
    columns = [arrays[f"object_{name}"] for name in _OF_OBJECTS]
    return tuple(
        MovingObject(int(number), motion, velocity, centre, size, float(yaw), int(points))
        for number, motion, velocity, centre, size, yaw, points in zip(
            arrays["object_ids"], *columns, strict=True))


def _tracks(arrays: dict[str, np.ndarray]) -> tuple[Track, ...]:
    clouds = np.split(arrays["track_points"], np.cumsum(arrays["track_counts"])[:-1])
    return tuple(
        Track(int(number), points, over_ground, float(took_s), int(missed))
        for number, points, over_ground, took_s, missed in zip(
            arrays["track_ids"], clouds[:len(arrays["track_ids"])], arrays["track_over_ground"],
            arrays["track_took_s"], arrays["track_missed"], strict=True))
