"""Settings: who overrides whom, and that no mistake passes silently."""

from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest
from shared_data import ROOT

from lidarflow.config import Config, given, load
from lidarflow.errors import ConfigError
from lidarflow.pipeline import FlowEstimator, estimate_flow
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.settings import describe, read_toml, to_dict, updated

FILES = ([(Config, file) for file in sorted((ROOT / "configs").glob("*.toml"))]
         + [(RgbdConfig, file) for file in sorted((ROOT / "configs" / "rgbd").glob("*.toml"))])


def toml(tmp_path, text: str):
    file = tmp_path / "mine.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_nothing_given_means_the_defaults():
    assert load() == Config()
    assert Config().solver.truncation_m**2 == pytest.approx(0.05)


def test_a_file_overrides_defaults_and_an_override_the_file(tmp_path):
    file = toml(tmp_path, "[mesh]\nmax_edge_m = 0.6\nmethod = 'grid'\n[shot]\nmin_neighbours = 12\n")
    from_file = load(file)
    assert from_file.mesh.max_edge_m == 0.6 and from_file.mesh.method == "grid"
    assert from_file.shot.min_neighbours == 12
    assert from_file.mesh.max_edge_rings == Config().mesh.max_edge_rings
    both = load(file, ("mesh.max_edge_m=0.7", "mesh.max_edge_m=0.8"))
    assert both.mesh.max_edge_m == 0.8 and both.mesh.method == "grid"
    assert Config().mesh.max_edge_m != 0.6


def test_overrides_are_read_like_toml_and_bare_words_are_text():
    config = load(None, ("ego.refine=false", "mesh.method = tangent", "graph.start='ego'",
                         "shot.radius_m=2", "solver.relative_tolerance=1e-6"))
    assert config.ego.refine is False
    assert (config.mesh.method, config.graph.start) == ("tangent", "ego")
    assert config.shot.radius_m == 2.0 and isinstance(config.shot.radius_m, float)
    assert config.solver.relative_tolerance == 1e-6


@pytest.mark.parametrize(("override", "message"), [
    ("mesh.max_egde_m=0.5", r"unknown setting 'mesh\.max_egde_m' - did you mean 'max_edge_m'\?"),
    ("mehs.max_edge_m=0.5", r"unknown section 'mehs' - did you mean 'mesh'\?"),
    ("solver.zzz=1", r"unknown setting 'solver\.zzz'; known are data_weight, max_iterations"),
    ("zzzzzz.a=1", r"unknown section 'zzzzzz'; known are crispness"),
    ("mesh.max_edge_m='wide'", r"mesh\.max_edge_m: expected float, got 'wide'"),
    ("mesh.max_edge_m=true", r"mesh\.max_edge_m: expected float, got True"),
    ("shot.min_neighbours=true", r"shot\.min_neighbours: expected int, got True"),
    ("shot.min_neighbours=7.5", r"shot\.min_neighbours: expected int, got 7\.5"),
    ("ego.refine=1", r"ego\.refine: expected bool, got 1"),
    ("mesh.method=3", r"mesh\.method: expected str, got 3"),
    ("mesh.method=grdi", r"mesh\.method: expected one of auto, grid, tangent, got 'grdi'"),
    ("mesh.max_edge_m=0", r"mesh\.max_edge_m: expected ≥ 0\.01, got 0\.0"),
    ("mesh.max_edge_m=-1", r"mesh\.max_edge_m: expected ≥ 0\.01, got -1\.0"),
    ("matching.max_ratio=1.2", r"matching\.max_ratio: expected 0\.1 \.\. 1, got 1\.2"),
    ("shot.min_neighbours=4", r"shot\.min_neighbours: expected ≥ 5, got 4"),
    ("mesh.max_edge_m=nan", r"mesh\.max_edge_m: expected ≥ 0\.01, got nan"),
    ("mesh.max_edge_m=[1]", r"mesh\.max_edge_m: expected float, got \[1\]"),
    ("max_edge_m=1", r"expected section\.name=value, e\.g\. mesh\.max_edge_m=0\.5"),
    ("mesh.max_edge_m", r"expected section\.name=value"),
])
def test_a_mistake_in_an_override_says_what_was_expected(override, message):
    with pytest.raises(ConfigError, match=message) as caught:
        load(None, (override,))
    assert "--set" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("text", "message"), [
    ("[mesh]\nmax_edge_m = ", "not valid TOML"),
    ("[mesh]\nmax_edge_m = 1\nmax_edge_m = 2\n", "not valid TOML"),
    ("mesh = 3\n", r"'mesh' is a section, write it as \[mesh\]"),
    ("[mesh]\nmax_egde_m = 1\n", "did you mean 'max_edge_m'"),
    ("[viewer]\nopen = true\n", "unknown section 'viewer'"),
    ("[mesh]\nmax_edge_m = nan\n", "got nan"),
    ("[mesh.max_edge_m]\nvalue = 1\n", "expected float"),
])
def test_a_mistake_in_a_file_names_the_file(tmp_path, text, message):
    file = toml(tmp_path, text)
    with pytest.raises(ConfigError, match=message) as caught:
        load(file)
    assert str(file) in str(caught.value)


def test_limits_that_leave_no_range_are_refused_wherever_they_come_from(tmp_path):
    file = toml(tmp_path, "[preparation]\nmin_range_m = 100.0\n")
    message = r"preparation\.min_range_m: expected less than max_range_m, which is 80\.0, got 100\.0"
    for origin in ((file, ()), (None, ("preparation.min_range_m=100",))):
        with pytest.raises(ConfigError, match=message):
            load(*origin)
    with pytest.raises(ConfigError, match=r"which is 5\.0, got 5\.0"):
        load(None, ("preparation.max_range_m=5", "preparation.min_range_m=5"))
    assert load(file, ("preparation.max_range_m=200",)).preparation.min_range_m == 100.0


@pytest.mark.parametrize(("section", "value", "message"), [
    ("solver", replace(Config().solver, method="quick"), r"solver\.method: expected one of fast, gtsam"),
    ("refine", replace(Config().refine, rounds=1.5), r"refine\.rounds: expected int, got 1\.5"),
    ("preparation", replace(Config().preparation, min_range_m=90.0), r"min_range_m: expected less than"),
    ("mesh", None, "'mesh' is a section"),
])
def test_settings_made_by_hand_are_checked_where_they_are_given(section, value, message):
    by_hand = replace(Config(), **{section: value})
    scans = np.zeros((2, 10, 3))
    for use in (lambda: FlowEstimator(by_hand), lambda: estimate_flow((scans[0], scans[1]), by_hand)):
        with pytest.raises(ConfigError, match=message) as caught:
            use()
        assert str(caught.value).startswith("settings: ")


def test_settings_made_by_hand_may_hold_whole_numbers_and_numpy_ones():
    by_hand = replace(Config(), refine=replace(Config().refine, rounds=np.int64(3), reach_m=np.float32(0.5)),
                      solver=replace(Config().solver, data_weight=2))
    found = given(by_hand, Config)
    assert found.refine.rounds == 3 and type(found.refine.rounds) is int
    assert found.refine.reach_m == 0.5 and type(found.solver.data_weight) is float
    assert given(Config(), Config) == Config() == given(None, Config)


def test_files_that_cannot_be_read_are_errors_too(tmp_path):
    with pytest.raises(ConfigError, match="no such settings file"):
        load(tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path)
    (tmp_path / "latin.toml").write_bytes("[mesh] # \xe9\n".encode("latin-1"))
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path / "latin.toml")


def test_settings_are_frozen_and_updates_are_copies():
    config = Config()
    with pytest.raises(FrozenInstanceError):
        config.mesh.max_edge_m = 1.0
    changed = updated(config, {"mesh": {"max_edge_m": 1}})
    assert changed.mesh.max_edge_m == 1.0 and config.mesh.max_edge_m == Config().mesh.max_edge_m
    assert updated(config, {}) == config


def test_plain_values_give_the_same_settings_back():
    config = load(None, ("mesh.method=tangent", "ego.refine=false", "solver.data_weight=2.5"))
    assert updated(Config(), to_dict(config)) == config
    assert updated(Config(), to_dict(Config())) == Config()


def test_every_setting_is_described_with_an_effect_and_keeps_its_own_limits():
    rows = describe(Config)
    expected = [f"{section.name}.{f.name}" for section in fields(Config)
                for f in fields(section.default_factory)]
    assert [key for key, *_ in rows] == expected and len(expected) > 30
    for key, default, allowed, effect in rows:
        assert len(effect) > 10, key
        assert default != "", key
        section, name = key.split(".")
        value = getattr(getattr(Config(), section), name)
        assert isinstance(value, bool) or allowed, key
        assert getattr(getattr(updated(Config(), {section: {name: value}}), section), name) == value


@pytest.mark.parametrize("file", sorted((ROOT / "configs").glob("*.toml")), ids=lambda file: file.stem)
def test_the_files_of_settings_load_and_change_something(file):
    assert load(file) != Config()


@pytest.mark.parametrize(("kind", "file"), FILES, ids=[file.stem for _, file in FILES])
def test_the_files_of_settings_hold_differences_only(kind, file):
    defaults = to_dict(kind())
    for section, values in read_toml(file).items():
        for name, value in values.items():
            assert value != defaults[section][name], f"{section}.{name} is the default"
