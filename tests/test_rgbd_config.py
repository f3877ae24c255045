"""The RGB-D settings go through the same machinery as the LiDAR settings."""

from dataclasses import fields

import pytest
from shared_data import ROOT

from lidarflow.config import load
from lidarflow.errors import ConfigError
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.settings import describe, to_dict, updated

FILES = sorted((ROOT / "configs" / "rgbd").glob("*.toml"))


def test_overrides_change_the_rgbd_settings():
    changed = load(None, ("clusters.count=24", "segmentation.enabled=false"), RgbdConfig)
    assert isinstance(changed, RgbdConfig)
    assert changed.clusters.count == 24 and changed.segmentation.enabled is False
    assert load(kind=RgbdConfig) == RgbdConfig()
    assert updated(RgbdConfig(), to_dict(changed)) == changed


@pytest.mark.parametrize(("override", "message"), [
    ("clusters.cuont=24", r"unknown setting 'clusters\.cuont' - did you mean 'count'\?"),
    ("mesh.max_edge_m=1", "unknown section 'mesh'"),
    ("clusters.count=0", r"clusters\.count: expected 1 \.\. 200, got 0"),
    ("alignment.damping=0", r"alignment\.damping: expected ≥ 1e-06, got 0\.0"),
])
def test_mistakes_are_named(override, message):
    with pytest.raises(ConfigError, match=message):
        load(None, (override,), RgbdConfig)


def test_every_setting_has_an_effect_and_keeps_its_own_limits():
    rows = describe(RgbdConfig)
    assert len(rows) == sum(len(fields(section.default_factory)) for section in fields(RgbdConfig)) > 30
    for key, _, allowed, effect in rows:
        section, name = key.split(".")
        value = getattr(getattr(RgbdConfig(), section), name)
        assert len(effect) > 10 and (isinstance(value, bool) or allowed), key
        assert updated(RgbdConfig(), {section: {name: value}}) == RgbdConfig()


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_the_files_of_settings_load_and_change_something(file):
    assert load(file, kind=RgbdConfig) != RgbdConfig()
