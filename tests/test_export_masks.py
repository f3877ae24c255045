"""`lidarflow export --format av2-v1 --masks`: the sweeps and points that Argoverse 2's challenge counts."""

import io as streams
import zipfile

import numpy as np
import pytest
from argoverse_log import TIMES, write_log
from command_line import rests
from run_folders import flows, write_run

from lidarflow import export
from lidarflow.datasets import open_dataset
from lidarflow.datasets.argoverse2 import read_columns
from lidarflow.export.argoverse2 import COLUMNS

pyarrow = pytest.importorskip("pyarrow")
feather = pytest.importorskip("pyarrow.feather")

pytestmark = pytest.mark.usefixtures("in_tmp_path")

LOG, OTHER_LOG = "7fab", "8abc"
POINTS = 8
FIRST, SECOND = f"{LOG}/{TIMES[0]}.feather", f"{LOG}/{TIMES[1]}.feather"
SOME = np.array([True, False, False, True, True, False, True, False])


@pytest.fixture
def run(tmp_path):
    """A run over a generated log of Argoverse 2: three sweeps, two pairs."""
    write_log(tmp_path / "av2")
    return write_run(tmp_path / "run", open_dataset(tmp_path / "av2"), (0, 1, 2))


def packed(mask, column="mask"):
    """A mask as the bytes of its .feather file."""
    content = streams.BytesIO()
    feather.write_feather(pyarrow.table({column: mask}), content)
    return content.getvalue()


def write_masks(file, members):
    """The archive of the challenge: a mask by its name, or the bytes of a damaged one."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, mask in members.items():
            archive.writestr(name, mask if isinstance(mask, bytes) else packed(mask))
    return file


def test_only_counted_sweeps_and_points_are_written(lidarflow, run, tmp_path):
    masks = write_masks(tmp_path / "masks.zip", {
        "README.txt": b"", f"{LOG}/": b"", SECOND: SOME, f"{OTHER_LOG}/{TIMES[0]}.feather": ~SOME})
    out = lidarflow.ok("export", run, "--format", "av2-v1", "--masks", masks, "--out", "sub")
    assert f"written    sub/{SECOND}\n" in out
    assert [file for file in tmp_path.glob("sub/**/*") if file.is_file()] == [tmp_path / "sub" / SECOND]
    columns = read_columns(tmp_path / "sub" / SECOND, (*COLUMNS, "is_dynamic"))
    found = flows(run)[1]
    assert {len(column) for column in columns.values()} == {SOME.sum()} and len(found.flow) == POINTS
    stored = np.stack([columns[name] for name in COLUMNS], axis=1)
    np.testing.assert_array_equal(stored, found.flow[SOME].astype(np.float16))
    np.testing.assert_array_equal(columns["is_dynamic"], found.is_dynamic[SOME])


def test_masks_of_everything_change_nothing(run, tmp_path):
    masks = write_masks(tmp_path / "masks.zip", dict.fromkeys((FIRST, SECOND), np.ones(POINTS, bool)))
    plain, masked = (
        [file.read_bytes() for file in export.export(run, "av2-v1", tmp_path / place, masks=given)]
        for place, given in (("a", None), ("b", masks)))
    assert plain == masked and len(plain) == 2


def test_a_sweep_of_which_nothing_counts_has_no_rows(run, tmp_path):
    masks = write_masks(tmp_path / "masks.zip", {FIRST: np.zeros(POINTS, bool)})
    file, = export.export(run, "av2-v1", tmp_path / "out", masks=masks)
    assert len(read_columns(file, ("is_dynamic",))["is_dynamic"]) == 0


@pytest.mark.parametrize("members, said", [
    ({f"{OTHER_LOG}/{TIMES[0]}.feather": SOME}, "no masks of the log 7fab; expected 7fab/<time_ns>.feather"),
    ({FIRST: SOME, f"{LOG}/{TIMES[2]}.feather": SOME, f"{LOG}/1.feather": SOME},
     "run: no flow of 2 of the 3 sweeps that masks.zip counts, 1 is the first; run over the whole log"),
    ({FIRST: SOME[:5]}, f"masks.zip: {FIRST}: 5 rows of bool; expected bool, a row for each of the 8 points"),
    ({FIRST: SOME.astype(np.int8)}, f"{FIRST}: 8 rows of int8; expected bool"),
    ({FIRST: packed(SOME, "is_close")}, f"{FIRST}: lacks the columns mask; it has is_close"),
    ({FIRST: packed(SOME)[:90]}, f"{FIRST}: not a readable .feather table"),
    ({FIRST: b""}, f"{FIRST}: not a readable .feather table")])
def test_masks_that_do_not_fit(lidarflow, run, tmp_path, members, said):
    write_masks(tmp_path / "masks.zip", members)
    assert said in lidarflow.complaint("export", "run", "--format", "av2-v1", "--masks", "masks.zip")
    assert not [file for file in tmp_path.glob("run-av2-v1/**/*") if file.is_file()] and not rests(tmp_path)


def test_what_is_no_archive(lidarflow, run, tmp_path):
    (tmp_path / "masks.zip").write_bytes(b"PK\x03\x04 and then nothing")
    for name, said in (("masks.zip", ""), ("av2", "(Is a directory)"),
                       ("nowhere.zip", "(No such file or directory)")):
        heard = lidarflow.complaint("export", "run", "--format", "av2-v1", "--masks", name)
        assert f"--masks {name}: not a readable archive {said}" in heard


def test_an_archive_that_announces_more_than_it_holds(lidarflow, run, tmp_path):
    file = write_masks(tmp_path / "masks.zip", {FIRST: SOME})
    content = bytearray(file.read_bytes())
    entry = content.index(b"PK\x01\x02")
    content[entry + 24:entry + 28] = (0xfffffff0).to_bytes(4, "little")     # the size once unpacked
    file.write_bytes(content)
    assert "damaged" in lidarflow.complaint("export", "run", "--format", "av2-v1", "--masks", file)


@pytest.mark.parametrize("name", [name for name in export.FORMATS if name not in export.MASKED_FORMATS])
def test_other_formats_have_every_point(lidarflow, run, tmp_path, name):
    write_masks(tmp_path / "masks.zip", {FIRST: SOME})
    said = lidarflow.complaint("export", "run", "--format", name, "--masks", "masks.zip")
    assert f"--masks masks.zip: {name} takes none" in said


def test_the_official_package_takes_our_files(run, tmp_path):
    archive = pytest.importorskip("av2.evaluation.scene_flow.make_submission_archive")
    evaluation = pytest.importorskip("av2.evaluation.scene_flow.eval")
    import pandas as pd
    out, truth = tmp_path / "sub", tmp_path / "truth" / LOG
    masks = write_masks(tmp_path / "masks.zip", {FIRST: SOME, SECOND: ~SOME})
    truth.mkdir(parents=True)
    files = list(export.export(run, "av2-v1", out, masks=masks))
    for file, found, mask in zip(files, flows(run), (SOME, ~SOME), strict=True):
        n = int(mask.sum())
        # One centimetre off along x: the mean error that the package must find.
        flow = found.flow[mask].astype(np.float64) + (0.01, 0.0, 0.0)
        pd.DataFrame({
            "category_indices": np.zeros(n, np.uint8), "is_dynamic": found.is_dynamic[mask],
            "is_valid": np.ones(n, bool), "is_close": np.ones(n, bool),
            **dict(zip(COLUMNS, flow.T.astype(np.float32), strict=True))}).to_feather(truth / file.name)
    archive.validate(out, masks)
    scores = evaluation.evaluate(str(tmp_path / "truth"), str(out))
    errors = {name: value for name, value in scores.items() if name.startswith("EPE") and np.isfinite(value)}
    assert errors and all(abs(value - 0.01) < 0.002 for value in errors.values()), scores
    assert scores["Dynamic IoU"] == 1.0
