"""The scripts behind RESULTS.md still run, and print figures of the size that they should have."""

import re
import subprocess
import sys

import pytest
from shared_data import ROOT, with_paths

pytestmark = pytest.mark.slow


def printed(script, *words):
    """What a script prints; it must end well."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / f"{script}.py"), *map(str, words)], capture_output=True,
        text=True, timeout=600, cwd=ROOT, env=with_paths(), check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def row(text, name):
    """The cells of the table's row that begins with `name`."""
    line = next(line for line in text.splitlines() if line.startswith(f"| {name} |"))
    return [cell.strip() for cell in line.strip("| ").split("|")][1:]


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    folder = tmp_path_factory.mktemp("street") / "street3"
    assert "3 scans of a hdl32e, seed 3" in printed(
        "make_street", folder, "--seed", 3, "--sensor", "hdl32e", "--scans", 3)
    return folder


def test_front_end(street):
    found = row(printed("front_end", street, "--n-scans", 2), "kitti 00 000000")
    assert found[0] == "grid" and float(found[1]) > 0.5 and int(found[2]) > 500 and float(found[3]) > 0.6


def test_evaluate(street):
    found = printed("evaluate", street)
    assert float(row(found, "static")[0]) < 0.02 and row(found, "pairs") == ["2"]
    assert float(row(found, "whole pair")[0]) > 0.0


def test_compare_solvers(street):
    found = row(printed("compare_solvers", street, "--config", "defaults"), "kitti 00 000000")
    assert found[0] == "defaults" and abs(float(found[5].removesuffix("%"))) < 0.1 and float(found[6]) < 5.0


def test_benchmark(street):
    found = printed("benchmark", street, "--pairs", 1)
    assert all(float(row(found, name)[0]) > 0.0 for name in ("ours", "KISS-ICP", "small_gicp GICP"))
    assert re.search(r"peak memory \d", found)


def test_baseline_variants(street):
    found = printed("baseline_variants", street, "--n-scans", 2)
    assert found.count("\n| ") > 5


def test_open_places():
    found = printed("open_places", "--seeds", 1, "--pairs", 1)
    assert found.count("\n") == 14 and "| HDL-32E | 8 | 1 | 0 | 0 | 0.0" in found


def test_far_apart():
    found = printed("far_apart", "--seeds", 1, "--pairs", 1)
    assert found.count("\n") == 12 and "| 8.0 m | 1 | " in found and "| 69° | 1 | 1 | 0 | " in found


def test_ego_guesses(street):
    found = printed("ego_guesses", street)
    name, pairs, median_m, *_ = row(found, "street3")
    assert (name, pairs) == ("last motion", "1") and float(median_m) < 0.5
    *_, from_kiss_icp = (line.split(" | ") for line in found.splitlines() if line.startswith("| street3"))
    assert from_kiss_icp[1] == "registered from KISS-ICP" and float(from_kiss_icp[4]) < 2e-3


def test_where_time_goes(street):
    found = printed("where_time_goes", street, "--pairs", 1, "--top", 3)
    names = re.findall(r"^\| (.+?) \| \d+ \|$", found, re.MULTILINE)
    spent_ms = {name: float(row(found, name)[0]) for name in names}
    whole_ms = spent_ms.pop("whole pair")
    assert len(spent_ms) == 6 and spent_ms["Patchwork++"] > 0.0
    assert abs(sum(spent_ms.values()) - whole_ms) <= 0.5 * (len(spent_ms) + 1)     # each is rounded


def test_soak(street):
    found = printed("soak", street, "--rounds", 2, "--scans", 3)
    assert "results: equal" in found and "growth after round 2: none" in found


def test_tables_of_the_paper(street):
    found = row(printed("reproduce_tables", "--moving", street, "--n-scans", 2), "street3")
    assert found[0] == "1" and 0.5 < float(found[2].split(" ")[0]) <= 1.0


def test_human_motion():
    found = printed("human_motion", "--scans", 2, "--distances", 6, "--motions", "arms_up_down")
    cells = [line.split(" | ") for line in found.splitlines() if line.startswith("| arms_up_down")]
    means = {method: float(mean_m) for _, method, _, mean_m, *_ in cells}
    assert means["truth"] == 0.0 and 0.0 < means["defaults"] < 0.02
