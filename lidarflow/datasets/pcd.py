"""PCD files (Point Cloud Library): ascii, binary and binary_compressed."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarflow.datasets import rows
from lidarflow.errors import DataError

MAX_COUNT = 4096
_SIZES = {"F": ("4", "8"), "I": ("1", "2", "4", "8"), "U": ("1", "2", "4", "8")}


@dataclass(frozen=True, slots=True)
class _Header:
    """Names, types and numbers of values of the fields; number of points; how they are stored."""

    names: list[str]
    types: list[np.dtype]
    counts: list[int]
    points: int
    storage: str


def read(path: Path) -> np.ndarray:
    """Points (N, 3) float64, rows as in the file; DataError where it does not hold what it declares."""
    lines, body = rows.split_header(path, path.read_bytes(), b"DATA")
    header = _parse(path, lines)
    if header.storage == "ascii":
        table = rows.from_text(path, body, header.points, sum(header.counts))
        first = dict(zip(header.names, np.cumsum([0, *header.counts[:-1]]), strict=True))
        return table[:, [first[axis] for axis in "xyz"]]
    if header.storage == "binary":
        names = [f"{i}" for i in range(len(header.names))]
        row = np.dtype([(n, t, (c,)) for n, t, c in zip(names, header.types, header.counts, strict=True)])
        table = rows.from_bytes(path, body, header.points, row)
        picked = [table[str(header.names.index(axis))][:, 0] for axis in "xyz"]
        return np.stack(picked, axis=1).astype(np.float64)
    return _from_compressed(path, body, header)


def _parse(path: Path, lines: list[str]) -> _Header:
    entries = {}
    for line in lines:
        words = line.split()
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    names = entries.get("FIELDS", entries.get("COLUMNS", []))
    absent = [axis for axis in "xyz" if axis not in names]
    if absent:
        raise DataError(f"{path}: the header names the fields '{' '.join(names)}'; "
                        "expected x, y and z among them")
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise DataError(f"{path}: {len(names)} FIELDS, but {len(sizes)} SIZE, {len(kinds)} TYPE and "
                        f"{len(counts)} COUNT entries; the header is damaged")
    types = [_type(path, kind, size) for kind, size in zip(kinds, sizes, strict=True)]
    counts = [rows.whole_number(path, count, "COUNT") for count in counts]
    if any(counts[names.index(axis)] != 1 for axis in "xyz") or max(counts) > MAX_COUNT:
        raise DataError(f"{path}: COUNT {' '.join(entries['COUNT'])}; expected 1 for x, y and z, "
                        f"and no more than {MAX_COUNT} for any field")
    storage = " ".join(entries["DATA"])
    if storage not in ("ascii", "binary", "binary_compressed"):
        raise DataError(f"{path}: DATA {storage}; expected ascii, binary or binary_compressed")
    return _Header(names, types, counts, _point_count(path, entries), storage)


def _type(path: Path, kind: str, size: str) -> np.dtype:
    if size not in _SIZES.get(kind, ()):
        raise DataError(f"{path}: a field of TYPE {kind} and SIZE {size}; expected F 4 8, I or U 1 2 4 8")
    return np.dtype(f"<{kind.lower()}{size}")


def _point_count(path: Path, entries: dict) -> int:
    counts = []
    for keys in (("POINTS",), ("WIDTH", "HEIGHT")):
        if all(len(entries.get(key, [])) == 1 for key in keys):
            numbers = [rows.whole_number(path, entries[key][0], key) for key in keys]
            counts.append(numbers[0] * (numbers[1] if len(numbers) > 1 else 1))
    if not counts:
        raise DataError(f"{path}: the header has neither POINTS nor WIDTH and HEIGHT")
    if min(counts) != max(counts):
        raise DataError(f"{path}: POINTS says {counts[0]}, WIDTH x HEIGHT {counts[1]}; the header is damaged")
    return counts[0]


def _from_compressed(path: Path, body: bytes, header: _Header) -> np.ndarray:
    """The columns lie one after the other, packed as a whole: packed size, full size, packed bytes."""
    column_bytes = [t.itemsize * c * header.points for t, c in zip(header.types, header.counts, strict=True)]
    if len(body) < 8:
        raise DataError(f"{path}: ends right after the header; the file is truncated")
    packed_size, full_size = np.frombuffer(body, dtype="<u4", count=2).tolist()
    if full_size != sum(column_bytes):
        raise DataError(f"{path}: header says {header.points} points ({sum(column_bytes)} bytes), the packed "
                        f"data {full_size} bytes; the file is damaged")
    if len(body) - 8 < packed_size:
        raise DataError(f"{path}: {packed_size} packed bytes announced, but only {len(body) - 8} follow; "
                        "the file is truncated")
    content = _unpack_lzf(body[8:8 + packed_size], full_size)
    if content is None:
        raise DataError(f"{path}: its packed points cannot be unpacked; the file is damaged")
    starts = np.cumsum([0, *column_bytes[:-1]])
    picked = [header.names.index(axis) for axis in "xyz"]
    columns = [np.frombuffer(content, header.types[i], header.points, int(starts[i])) for i in picked]
    return np.stack(columns, axis=1).astype(np.float64)


def _unpack_lzf(packed: bytes, full_size: int) -> bytes | None:
    """The `full_size` bytes that LZF packed, None where `packed` is not such a stream.

    A control byte below 32 announces control + 1 plain bytes; else its upper 3 bits (7: plus the next
    byte) + 2 bytes are repeated from its lower 5 bits and the next byte, + 1, back.
    """
    full, at = bytearray(), 0
    while at < len(packed) and len(full) <= full_size:
        control = packed[at]
        at += 1
        if control < 32:
            full += packed[at:at + control + 1]
            at += control + 1
            continue
        length, more = control >> 5, 2 if control >> 5 == 7 else 1
        if at + more > len(packed):
            return None
        length += 2 + (packed[at] if more == 2 else 0)
        start = len(full) - ((control & 31) << 8) - packed[at + more - 1] - 1
        at += more
        if start < 0:
            return None
        pattern = full[start:start + length]
        full += (pattern * (length // len(pattern) + 1))[:length]
    return bytes(full) if len(full) == full_size else None
