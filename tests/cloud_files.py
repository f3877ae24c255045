"""Writers of small cloud files in every format, for tests that read them back."""

import numpy as np
import pytest

from lidarflow.errors import DataError

NAN = np.nan
POINTS = np.array([[1.0, 2.0, 3.0], [NAN, NAN, NAN], [4.5, -5.0, 6.25], [0.0, 0.0, 0.0], [7.0, 8.0, 9.5]])
PCD_HEADER = ("# .PCD v0.7\nVERSION 0.7\nFIELDS intensity x y z ring\nSIZE 4 4 4 4 2\nTYPE F F F F U\n"
              "COUNT 1 1 1 1 3\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {storage}\n")
PCD_ROW = np.dtype([("i", "<f4"), ("xyz", "<f4", 3), ("ring", "<u2", 3)])


def write_bin(file, points=POINTS):
    file.parent.mkdir(parents=True, exist_ok=True)
    np.column_stack([points, np.ones(len(points))]).astype("<f4").tofile(file)
    return file


def pcd_table(points=POINTS):
    table = np.zeros(len(points), PCD_ROW)
    table["i"], table["xyz"], table["ring"] = 0.5, points, 7
    return table


def write_pcd(file, storage, points=POINTS, declared=None):
    header = PCD_HEADER.format(n=declared or len(points), storage=storage).encode()
    table = pcd_table(points)
    if storage == "ascii":
        lines = [" ".join(str(v) for v in [0.5, *p, 7, 7, 7]) for p in points]
        body = ("\n".join(lines) + "\n").encode()
    elif storage == "binary":
        body = table.tobytes()
    else:
        full = table["i"].tobytes() + b"".join(table["xyz"][:, k].tobytes() for k in range(3))
        full += table["ring"].tobytes()
        packed = b"".join(bytes([len(part) - 1]) + part for part in
                          (full[i:i + 32] for i in range(0, len(full), 32)))
        body = np.array([len(packed), len(full)], "<u4").tobytes() + packed
    file.write_bytes(header + body)
    return file


def write_ply(file, storage, points=POINTS, declared=None, kind="double"):
    header = (f"ply\nformat {storage} 1.0\ncomment none\nelement vertex {declared or len(points)}\n"
              f"property uchar intensity\nproperty {kind} x\nproperty {kind} y\nproperty {kind} z\n"
              "element face 1\nproperty list uchar int vertex_indices\nend_header\n").encode()
    if storage == "ascii":
        body = "".join(f"3 {x} {y} {z}\n" for x, y, z in points).encode() + b"3 0 1 2\n"
    else:
        order = "<" if "little" in storage else ">"
        number = order + {"double": "f8", "float": "f4"}[kind]
        table = np.zeros(len(points), [("i", "u1"), ("xyz", number, 3)])
        table["xyz"] = points
        body = table.tobytes()
    file.write_bytes(header + body)
    return file


def write_numpy(file, points=POINTS):
    wide = np.column_stack([points, np.ones(len(points))]).astype(np.float32)
    if file.suffix == ".npz":
        np.savez(file, cloud=wide, label=np.zeros(len(points)))
    else:
        np.save(file, wide)
    return file


def write_text(file, points=POINTS):
    file.write_text("# x y z\n" + "".join(f"{x}, {y}, {z}, 9\n" for x, y, z in points))
    return file


def write_csv(file, points=POINTS):
    file.write_text("".join(f"{x},{y},{z},9\n" for x, y, z in points))
    return file


def write_named_csv(file, points=POINTS):
    file.write_text("time,Z,intensity,x,y\n" + "".join(f"12:0{k},{z},9,{x},{y}\n"
                                                       for k, (x, y, z) in enumerate(points)))
    return file


WRITERS = {
    "a.bin": write_bin, "a.npy": write_numpy, "a.npz": write_numpy, "a.xyz": write_text, "a.txt": write_text,
    "a.csv": write_csv, "named.csv": write_named_csv,
    "ascii.pcd": lambda f: write_pcd(f, "ascii"), "binary.pcd": lambda f: write_pcd(f, "binary"),
    "packed.PCD": lambda f: write_pcd(f, "binary_compressed"), "ascii.ply": lambda f: write_ply(f, "ascii"),
    "little.ply": lambda f: write_ply(f, "binary_little_endian"),
    "big.ply": lambda f: write_ply(f, "binary_big_endian", kind="float"),
}


def message(call, *args, **kwargs):
    """The text of the one-line DataError that `call` raises."""
    with pytest.raises(DataError) as caught:
        call(*args, **kwargs)
    assert "\n" not in str(caught.value)
    return str(caught.value)
