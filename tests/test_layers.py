"""The import order is a test: every module knows only what lies to its left."""

import ast
from pathlib import Path

import pytest
from shared_data import ROOT

PACKAGE = ROOT / "lidarflow"
LAYERS = [
    {"errors", "__version__"},
    {"aside", "open3d_import", "pose", "robust", "rows", "colour", "interrupts", "kernels", "silence",
     "stopwatch"},
    {"checks", "rgbd_colour", "first_use"},    # they use pose, colour, and kernels
    {"types", "rgbd_types"},
    {"settings"},
    {"config"},
    {"rgbd_config"},
    {"lidar", "rgbd", "solve", "datasets", "synthetic"},
    {"baselines"},
    {"pipeline", "rgbd_methods"},
    {"methods", "rerun_streams"},
    {"metrics", "rgbd_metrics", "io", "viewer", "preview", "rgbd_preview"},
    {"flow_files", "pair_reports", "provenance", "rgbd_io", "checkpoints", "trajectory", "run_folder"},
    {"rgbd_viewer", "rgbd_checkpoints", "resuming", "stepping"},
    {"runner", "cluster"},
    {"rgbd_runner"},
    {"evaluation", "compare", "export"},
    {"tables", "score_tables", "rgbd_tables", "demo", "terminal"},
    {"report"},
    {"rgbd_cli", "run_cli", "eval_cli", "export_cli"},
    {"cli"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
MODULES = sorted(file for file in PACKAGE.rglob("*.py"))
PUBLIC = {"config", "datasets", "errors", "pipeline", "types"}    # what the package offers as its own
PRINTS_OR_EXITS = {"print", "exit", "quit", "sys.exit", "os._exit"}
MOST_LINES, MOST_FUNCTION_LINES = 400, 60

every_module = pytest.mark.parametrize(
    "module", MODULES, ids=lambda module: module.relative_to(PACKAGE).as_posix())


def unit_of(module: Path) -> str:
    """The layer's name of a module: its top folder in the package, or its own name."""
    return module.relative_to(PACKAGE).parts[0].removesuffix(".py")


def parsed(module: Path) -> ast.Module:
    return ast.parse(module.read_text(encoding="utf-8"))


def imports(module: Path) -> set[str]:
    """Dotted names of all that a module imports anywhere; `from a import b` gives a.b."""
    package = ("lidarflow", *module.relative_to(PACKAGE).parts[:-1])
    found = set()
    for node in ast.walk(parsed(module)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = [*package[: len(package) - node.level + 1]] if node.level else []
            base = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{base}.{alias.name}" for alias in node.names}
    return found


def ours(module: Path) -> set[str]:
    """Names of the layers' members that a module imports from this package."""
    return {name.split(".")[1] for name in imports(module) if name.startswith("lidarflow.")}


def test_every_module_has_its_place():
    units = {unit_of(module) for module in MODULES} - {"__init__", "__main__"}
    assert units <= LEVEL.keys(), units - LEVEL.keys()


@every_module
def test_modules_import_only_from_layers_to_their_left(module):
    unit = unit_of(module)
    if unit in ("__init__", "__main__"):
        assert ours(module) <= {"cli", *PUBLIC}
        return
    for other in ours(module) - {unit}:
        assert LEVEL[other] < LEVEL[unit], f"{unit} imports {other}"


@every_module
def test_heavy_or_replaceable_packages_have_one_door(module):
    name = module.relative_to(PACKAGE).as_posix()
    doors = {"gtsam": {"solve/gtsam_lm.py"}, "rerun": {"rerun_streams.py"},
             "open3d": {"open3d_import.py"}}
    for package in {imported.split(".")[0] for imported in imports(module)} & doors.keys():
        assert name in doors[package], f"{name} imports {package}"


def test_the_doors_are_found():
    assert "gtsam" in imports(PACKAGE / "solve" / "gtsam_lm.py")
    assert "rerun" in imports(PACKAGE / "rerun_streams.py")
    assert ours(PACKAGE / "lidar" / "mesh.py") >= {"config", "errors", "kernels", "lidar"}


@pytest.mark.parametrize("module", sorted((PACKAGE / "kernels").glob("*.py")), ids=lambda module: module.stem)
def test_kernels_know_nothing_of_ours_but_kernels(module):
    assert ours(module) <= {"kernels"}


@every_module
def test_only_the_command_line_prints_and_exits(module):
    if module.name in ("cli.py", "rgbd_cli.py", "run_cli.py", "eval_cli.py", "export_cli.py"):
        return
    for node in ast.walk(parsed(module)):
        if isinstance(node, ast.Call):
            call = ast.unparse(node.func)
            assert call not in PRINTS_OR_EXITS, f"line {node.lineno}: {call}"
        if isinstance(node, ast.Raise) and node.exc is not None:
            assert not ast.unparse(node.exc).startswith("SystemExit"), f"line {node.lineno}"


@every_module
def test_files_and_functions_stay_short(module):
    assert len(module.read_text(encoding="utf-8").splitlines()) < MOST_LINES
    for node in ast.walk(parsed(module)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = node.end_lineno - node.lineno + 1
            assert length < MOST_FUNCTION_LINES, f"{node.name} has {length} lines"
