"""How settings are declared, read, overridden, checked and described, whatever they are of.

Settings are a frozen dataclass whose fields are sections; fields of a section are declared by `setting`. An
unknown key is an error that names the nearest known one.
"""

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

import numpy as np

from lidarflow.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# A frozen dataclass whose fields are sections, such as Config or RgbdConfig.
Settings = TypeVar("Settings", bound="DataclassInstance")
_TOO_LARGE = 2**63


def setting(default: Any, effect: str, *, low: float | None = None, high: float | None = None,
            choices: tuple[str, ...] | None = None, below: str | None = None) -> Any:
    """A dataclass field with its effect in words and the values it may take, `below` another's here."""
    return field(default=default, metadata={"effect": effect, "low": low, "high": high, "choices": choices,
                                            "below": below})


def updated(config: Settings, changes: dict, origin: str = "settings") -> Settings:
    """A copy of `config` with nested `changes` {section: {name: value}}, each of them checked."""
    sections = {f.name for f in fields(config)}
    for section, values in changes.items():
        if section not in sections:
            raise ConfigError(f"{origin}: unknown section '{section}'{_nearest(section, sections)}")
        if not isinstance(values, dict):
            raise ConfigError(f"{origin}: '{section}' is a section, write it as [{section}]")
        current = getattr(config, section)
        kinds = get_type_hints(type(current))
        checked = {name: _check(current, kinds, section, name, value, origin)
                   for name, value in values.items()}
        config = replace(config, **{section: replace(current, **checked)})
    return config


def to_dict(config: Settings) -> dict:
    """Nested plain values, ready for TOML or JSON."""
    return asdict(config)


def describe(kind: "type[DataclassInstance]") -> list[tuple[str, str, str, str]]:
    """Rows (key, default, allowed, effect) for every setting of a `kind`."""
    rows = []
    for section in fields(kind):
        defaults = getattr(kind(), section.name)
        for f in fields(defaults):
            meta = f.metadata
            allowed = " | ".join(meta["choices"]) if meta["choices"] else _range_text(meta)
            rows.append((f"{section.name}.{f.name}", str(f.default), allowed, meta["effect"]))
    return rows


def read_toml(file: Path, what: str = "settings") -> dict:
    """The content of a TOML file, which messages call a file of `what`; ConfigError if it cannot be read."""
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such {what} file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read ({error})") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: not valid TOML ({error})") from None


def parse_override(override: str) -> dict:
    """{section: {name: value}} of "section.name=value"; ConfigError for anything else."""
    key, equals, text = override.partition("=")
    section, dot, name = key.strip().partition(".")
    if not equals or not dot:
        raise ConfigError(f"--set {override}: expected section.name=value, e.g. mesh.max_edge_m=0.5")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        value = text.strip()
    return {section: {name: value}}


def check_together(config: Any) -> None:
    """ConfigError where settings that are right one by one contradict each other."""
    for section in fields(config):
        values = getattr(config, section.name)
        for f in fields(values):
            value, name = getattr(values, f.name), f.metadata["below"]
            if name is not None and value >= getattr(values, name):
                raise ConfigError(f"settings: {section.name}.{f.name}: expected less than {name}, which is "
                                  f"{getattr(values, name)!r}, got {value!r}")


def _check(
    section_config: Any, kinds: dict[str, type], section: str, name: str, value: Any, origin: str
) -> Any:
    """`value` converted to the setting's type, or a ConfigError that says what was expected."""
    known = {f.name: f for f in fields(section_config)}
    if name not in known:
        raise ConfigError(f"{origin}: unknown setting '{section}.{name}'{_nearest(name, known)}")
    kind, meta = kinds[name], known[name].metadata
    key = f"{origin}: {section}.{name}"
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, int) and abs(value) >= _TOO_LARGE:
        raise ConfigError(f"{key}: the number is too large")
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ConfigError(f"{key}: expected {kind.__name__}, got {value!r}")
    if meta["choices"] and value not in meta["choices"]:
        raise ConfigError(f"{key}: expected one of {', '.join(meta['choices'])}, got {value!r}")
    if kind in (int, float):
        low, high = meta["low"], meta["high"]
        if value != value or (low is not None and value < low) or (high is not None and value > high):
            raise ConfigError(f"{key}: expected {_range_text(meta)}, got {value!r}")
    return value


def _range_text(meta: Mapping[str, Any]) -> str:
    low, high = meta["low"], meta["high"]
    if low is None:
        return ""
    return f"≥ {low:g}" if high is None else f"{low:g} .. {high:g}"


def _nearest(name: str, known) -> str:
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" - did you mean '{close[0]}'?" if close else f"; known are {', '.join(sorted(known))}"
