"""PLY files (polygon format) with a cloud of vertices: ascii and binary."""

from pathlib import Path

import numpy as np

from lidarflow.datasets import rows
from lidarflow.errors import DataError

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
          "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
          "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def read(path: Path) -> np.ndarray:
    """Points (N, 3) float64 of the vertices, rows as in the file.

    Raises DataError where the file does not hold what its header declares.
    """
    content = path.read_bytes()
    if content[:3] != b"ply":
        raise DataError(f"{path}: does not start with 'ply'; the file is damaged or of another format")
    lines, body = rows.split_header(path, content, b"end_header")
    storage, count, properties = _parse(path, lines)
    names = [name for name, _ in properties]
    if storage == "ascii":
        return rows.from_text(path, body, count, len(names))[:, [names.index(axis) for axis in "xyz"]]
    row = np.dtype([(str(i), _ORDERS[storage] + kind) for i, (_, kind) in enumerate(properties)])
    table = rows.from_bytes(path, body, count, row)
    return np.stack([table[str(names.index(axis))] for axis in "xyz"], axis=1).astype(np.float64)


def _parse(path: Path, lines: list[str]) -> tuple[str, int, list[tuple[str, str]]]:
    """Storage, number of vertices, and their properties (name, type)."""
    storage, elements = "", []
    for words in (line.split() for line in lines):
        if words[:1] == ["format"] and len(words) > 1:
            storage = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            elements.append((words[1], words[2], []))
        elif words[:1] == ["property"] and len(words) > 2 and elements:
            elements[-1][2].append((words[-1], words[1]))
    if storage not in _ORDERS:
        raise DataError(f"{path}: format '{storage}'; expected {', '.join(_ORDERS)}")
    if not elements or elements[0][0] != "vertex":
        found = ", ".join(element[0] for element in elements) or "none"
        raise DataError(f"{path}: elements are {found}; expected 'vertex' as the first")
    _, count, properties = elements[0]
    names = [name for name, _ in properties]
    if any(axis not in names for axis in "xyz"):
        raise DataError(f"{path}: vertices have the properties '{' '.join(names)}'; "
                        "expected x, y and z among them")
    unknown = [kind for _, kind in properties if kind not in _TYPES]
    if unknown:
        raise DataError(f"{path}: a vertex property of type '{unknown[0]}'; expected plain numbers")
    return storage, rows.whole_number(path, count, "vertex count"), [(n, _TYPES[k]) for n, k in properties]
