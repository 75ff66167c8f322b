"""Configurations as plain values, as JSON holds them, and back."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fleetjax.config import Config, all_fields, get_value, validate
from fleetjax.field import KINDS, OF_HUMANS, OF_LINKS, Field
from fleetjax.io.files import expect

# Fields that came later; their defaults are what was done before.
_LATER = ("allocation", "temperature", "human_model", "link_model", *OF_HUMANS, *OF_LINKS)
_LARGEST = 2**31 - 1  # traced integers are i32


def to_plain(config: Config) -> dict[str, Any]:
    """Return fields and parameters as plain Python values; the shortest decimal that stands for each f32."""

    def plain(value: Any, kind: type) -> Any:
        if kind is tuple:
            return list(value)
        if isinstance(value, tuple):  # one for each human
            return [plain(one, kind) for one in value]
        return float(str(np.float32(value))) if kind is float else kind(value)

    return {name: plain(get_value(config, name), field.kind) for name, field in all_fields(config.algorithm).items()}


def from_plain(fields: Mapping[str, Any]) -> Config:
    """Return the configuration that plain values stand for.

    Raises:
        ValueError: if they are not those of a configuration.
    """
    known = all_fields(fields.get("algorithm", ""))
    fields = {name: known[name].default for name in _LATER if name in known} | dict(fields)
    for problem, names in (("unknown", set(fields) - set(known)), ("missing", set(known) - set(fields))):
        expect(not names, f"{problem} fields: {', '.join(sorted(names))} (another version of fleetjax?)")
    for name, value in fields.items():
        expect(_fits_field(value, known[name]), f"{name} = {value!r} must be {KINDS[known[name].kind]}")
    config = Config().replace(**{**fields, "human_capacity": 0})
    if fields["human_capacity"] not in (0, config.human_capacity):  # it was asked for, and does not follow from the others
        config = config.replace(human_capacity=fields["human_capacity"])
    validate(config)
    return config


def _is_int(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST


def _fits_field(value: Any, field: Field) -> bool:
    if field.per_human and isinstance(value, list):
        return all(fits(one, field.kind) for one in value)
    return fits(value, field.kind)


def fits(value: Any, kind: type) -> bool:
    """Return whether a plain value is of the kind of a field."""
    if kind is tuple:
        return isinstance(value, list) and all(map(_is_int, value))
    if kind is float:
        return _is_int(value) or (isinstance(value, float) and math.isfinite(value))
    return _is_int(value) if kind is int else isinstance(value, kind)
