"""Reports out of metrics.json: the dataclasses that were written, made again from plain values."""

import types
import typing
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

# What JSON cannot say: null is infinite here, unknown everywhere else.
_INFINITE = {"high_m"}
_NOT_WRITTEN = {"seconds": dict, "doubt": str, "buckets": type(None)}


def rebuilt(kind: Any, value: Any, name: str) -> Any:
    """`value`, as json.loads gives it, as the type `kind`; null numbers are NaN.

    Raises ValueError, which says where, for what cannot be one.
    """
    origin, parameters = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        wanted = next(part for part in parameters if part is not type(None))
        return None if value is None else rebuilt(wanted, value, name)
    if is_dataclass(kind):
        return _rebuilt_dataclass(kind, value, name)
    if origin is tuple:
        _check(isinstance(value, list), name, "a list")
        return tuple(rebuilt(parameters[0], part, f"{name}[{k}]") for k, part in enumerate(value))
    if origin is dict:
        _check(isinstance(value, dict), name, "an object")
        return {key: rebuilt(parameters[1], part, f"{name}.{key}") for key, part in value.items()}
    if kind is float:
        if value is None:
            return np.inf if name.rpartition(".")[2] in _INFINITE else np.nan
        _check(type(value) in (int, float), name, "a number")
        return float(value)
    _check(type(value) is kind, name, kind.__name__)
    return value


def _rebuilt_dataclass(kind: type, value: Any, name: str) -> Any:
    _check(isinstance(value, dict), name, "an object")
    hints = typing.get_type_hints(kind)
    found = {}
    for field in fields(kind):
        if field.name in value:
            found[field.name] = rebuilt(hints[field.name], value[field.name], f"{name}.{field.name}")
        elif field.name in _NOT_WRITTEN:
            found[field.name] = _NOT_WRITTEN[field.name]()
        else:
            raise ValueError(f"{name}.{field.name} is missing")
    return kind(**found)


def _check(fits: bool, name: str, expected: str) -> None:
    if not fits:
        raise ValueError(f"{name}: expected {expected}")
