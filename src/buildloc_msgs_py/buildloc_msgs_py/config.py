"""Config dataclasses with ranges: the one place where a parameter's default and bounds are stated."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, TypeVar

from buildloc_msgs_py.errors import BuildlocError

ConfigT = TypeVar("ConfigT")


class ConfigError(BuildlocError):
    """A parameter is unknown, of the wrong type or out of its range."""


def param(default: Any, doc: str, low: float | None = None, high: float | None = None) -> Any:
    """A dataclass field with a description and an inclusive range."""
    return dataclasses.field(default=default, metadata={"doc": doc, "low": low, "high": high})


def check(config: Any) -> None:
    """Raise ConfigError naming parameter, value and range for the first value out of range."""
    for field in dataclasses.fields(config):
        low, high = field.metadata.get("low"), field.metadata.get("high")
        if low is None and high is None:
            continue
        value = getattr(config, field.name)
        lower = -math.inf if low is None else low
        upper = math.inf if high is None else high
        if not lower <= value <= upper:
            raise ConfigError(f"parameter {field.name} = {value} is out of range [{lower:g}, {upper:g}]")


def from_mapping(cls: type[ConfigT], values: Mapping[str, Any]) -> ConfigT:
    """Build and check a config from names and values; refuses unknown names and wrong types."""
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    converted: dict[str, Any] = {}
    for name, value in values.items():
        if name not in fields:
            raise ConfigError(f"parameter {name} is unknown to {cls.__name__}; it has {', '.join(fields)}")
        kind = type(fields[name].default)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if kind is tuple and isinstance(value, list):
            value = tuple(value)
        if not isinstance(value, kind):
            raise ConfigError(f"parameter {name} = {value!r} is not a {kind.__name__}")
        converted[name] = value
    config = cls(**converted)
    check(config)
    return config
