# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Settings: dataclass fields with default, range, unit and description.

A node declares them as ROS parameters, the command line and the API read and check the same ones,
and `--help` and the reference pages list them::

    @dataclass(frozen=True)
    class SimulatorSettings:
        rate: float = setting(200.0, "Publish rate", unit="Hz", minimum=1.0)
        kind: str = live_setting("none", "Disturbance kind", choices=("none", "bias_step"))
        bias_step: BiasStep = settings_group(
            BiasStep, amplitude=live_setting(0.1, "Bias", unit="rad"), start=setting(0.0, "Start")
        )

The full name of the amplitude is then "bias_step.amplitude". A ``__post_init__`` that raises
ParameterError or ModelError checks fields against each other.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import Field, dataclass, field, fields, replace
from numbers import Integral
from typing import Any, TypeVar, get_args, get_type_hints

from tsobs_ros.errors import ModelError, ParameterError

T = TypeVar("T")

_KEY = "tsobs_ros.setting"
# Of each type: what ROS calls it, and one and several of it in words.
_TYPES: Mapping[type, tuple[str, str, str]] = {
    bool: ("bool", "true or false", "booleans"),
    int: ("integer", "an integer", "integers"),
    float: ("double", "a finite number", "numbers"),
    str: ("string", "a string", "strings"),
}


@dataclass(frozen=True)
class Setting:
    """A setting of a dataclass.

    Attributes:
        default: Value if the user gives none; must obey the rules below.
        summary: One line, without the unit.
        unit: SI unit, or "".
        minimum: Least accepted value, in `unit`; of each element of a tuple.
        maximum: Greatest accepted value, in `unit`; of each element of a tuple.
        choices: The only accepted values, if not empty; of each element of a tuple.
        live: Whether the value may be changed while a node runs.
        hidden: Whether help and reference leave it out, as users can hardly choose it.
        name: Its full name.
        type: Its type, or that of an element: bool, int, float or str.
        is_array: Whether it is a tuple.
    """

    default: Any
    summary: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: Sequence[Any] = ()
    live: bool = False
    hidden: bool = False
    name: str = ""
    type: Any = str
    is_array: bool = False

    @property
    def kind(self) -> str:
        """The name of the type in ROS, such as "double_array"."""
        return _TYPES[self.type][0] + "_array" * self.is_array

    @property
    def limits(self) -> str:
        """What is accepted, in words."""
        ends = (("at least", self.minimum), ("at most", self.maximum))
        limits = [f"{words} {end}" for words, end in ends if end is not None]
        return f"one of: {', '.join(self.choices)}" if self.choices else " and ".join(limits)

    @property
    def description(self) -> str:
        """The description with the unit."""
        return f"{self.summary} [{self.unit}]" if self.unit else self.summary

    def converted(self, value: Any) -> Any:
        """Return a value from YAML, a message or a caller in the setting's type.

        Raises:
            ParameterError: It is of another type, not finite or out of range.
        """
        if not self.is_array:
            elements: tuple[Any, ...] = (self._accepted(value),)
        elif value is None:  # rcl hands `name: []` over like this
            elements = ()
        elif isinstance(value, str | bytes) or not hasattr(value, "__len__"):
            elements = (None,)
        else:
            elements = tuple(map(self._accepted, list(value)))
        if None not in elements:
            return elements if self.is_array else elements[0]
        _, one, several = _TYPES[self.type]
        expected = f"a list of {several}" if self.is_array else one
        if self.limits:
            each = ", each " if self.is_array else " of "
            expected = self.limits if self.choices else f"{expected}{each}{self.limits}"
        unit = f" {self.unit}" if self.unit else ""
        hint = ""
        if self.is_array and isinstance(value, str) and value.lstrip().startswith("["):
            # ros2cli sends a list of mixed types as a string, and rcl refuses it in YAML.
            hint = "; lists must not mix types: write every number with a decimal point"
        raise ParameterError(
            f"parameter '{self.name}': expected {expected}{unit}, got {in_yaml(value)}{hint}"
        )

    def parsed(self, value: Any) -> Any:
        """Return a value, or its text as on the command line, in the setting's type."""
        if isinstance(value, str) and not self.is_array:
            with suppress(KeyError, ValueError):
                words = {"true": True, "false": False}
                value = words[value.lower()] if self.type is bool else self.type(value)
        return self.converted(value)

    def _accepted(self, value: Any) -> Any:
        """Return a value in the type of a setting or of its elements; None if it is refused."""
        if isinstance(value, bool) != (self.type is bool):
            return None
        if self.type in (int, float) and isinstance(value, Integral):
            value = self.type(value)
        if not isinstance(value, self.type) or (self.type is float and not math.isfinite(value)):
            return None
        if (self.minimum is not None and value < self.minimum) or (
            self.maximum is not None and value > self.maximum
        ):
            return None
        return self.type(value) if not self.choices or value in self.choices else None


def setting(default: T, description: str, **rules: Any) -> T:
    """Declare a dataclass field as a setting, of type bool, int, float, str or tuples of these.

    The rules are other attributes of `Setting`: `unit`, `minimum`, `maximum`, `choices`, `live` and
    `hidden`. The field is typed as the default so that annotations check.
    """
    return field(default=default, metadata={_KEY: Setting(default, description, **rules)})


def live_setting(default: T, description: str, **rules: Any) -> T:
    """Declare a setting that may be changed while a node runs: `setting` with `live`."""
    return setting(default, description, live=True, **rules)


def settings_group(make: Callable[..., T], **members: Any) -> T:
    """Declare a dataclass field that is itself a dataclass of settings.

    Args:
        make: The frozen dataclass. Its settings are named "<field>.<name>".
        **members: Those of its fields that are settings, each as a `setting`, if it does not
            declare them itself. The others keep their defaults.

    Returns:
        A dataclass field that holds an instance.
    """
    given = {name: item.default for name, item in members.items()}
    return field(default_factory=lambda: make(**given), metadata={_KEY: members})


def check_numbers(record: Any, name: str) -> None:
    """Refuse a record whose fields are settings, and of them a number that is not accepted.

    Args:
        record: An instance of a dataclass; fields that are no settings are not checked.
        name: What it is, for the error.

    Raises:
        ModelError: The first number that is not finite or out of range.
    """
    for item in fields(record):
        rule = item.metadata.get(_KEY)
        if isinstance(rule, Setting) and not isinstance(rule.default, bool | str):
            value = getattr(record, item.name)
            low = -math.inf if rule.minimum is None else rule.minimum
            high = math.inf if rule.maximum is None else rule.maximum
            if not (math.isfinite(value) and low <= value <= high):
                limits = f" of {rule.limits}" if rule.limits else ""
                raise ModelError(
                    f"{name} {item.name}: expected a finite number{limits}, got {value!r}"
                )


class Schema:
    """The settings of a dataclass and of its groups.

    Attributes:
        entries: The settings by their full names, in the order of the fields.
    """

    def __init__(
        self, make: Any, members: Mapping[str, Field[Any]] | None = None, prefix: str = ""
    ) -> None:
        self.entries: dict[str, Setting] = {}
        self._make, self._prefix = make, prefix
        self._parts: dict[str, Schema | Setting] = {}
        hints = get_type_hints(make)
        for name, item in (members or {item.name: item for item in fields(make)}).items():
            hint, own, full_name = hints[name], item.metadata[_KEY], f"{prefix}{name}"
            if isinstance(own, dict):
                group = Schema(hint, own, f"{full_name}.")
                self._parts[name] = group
                self.entries |= group.entries
            else:
                kind = (get_args(hint) or (hint,))[0]
                entry = replace(own, name=full_name, type=kind, is_array=hint is not kind)
                self._parts[name] = self.entries[full_name] = entry

    def build(self, values: Mapping[str, Any]) -> Any:
        """Return the dataclass made of values by their full names.

        Raises:
            ParameterError: The values contradict each other.
        """
        arguments = {
            name: part.build(values) if isinstance(part, Schema) else values[part.name]
            for name, part in self._parts.items()
        }
        try:
            return self._make(**arguments)
        except ModelError as error:
            where = f"parameters '{self._prefix}*': " if self._prefix else ""
            raise ParameterError(f"{where}{error}") from error

    def values_of(self, record: Any) -> dict[str, Any]:
        """Return the values of an instance by their full names."""
        values: dict[str, Any] = {}
        for name, part in self._parts.items():
            value = getattr(record, name)
            values |= part.values_of(value) if isinstance(part, Schema) else {part.name: value}
        return values


_SCHEMAS: dict[Any, Schema] = {}


def schema_of(make: Any) -> Schema:
    """Return the settings of a dataclass."""
    if make not in _SCHEMAS:
        _SCHEMAS[make] = Schema(make)
    return _SCHEMAS[make]


def check(record: Any) -> None:
    """Raise a ParameterError if a dataclass of settings has a value that is not accepted."""
    schema = schema_of(type(record))
    for name, value in schema.values_of(record).items():
        schema.entries[name].converted(value)


def changed(record: T, values: Mapping[str, Any]) -> T:
    """Return an instance of a dataclass of settings with some of them changed.

    Args:
        values: By their full names; text is converted.

    Raises:
        ParameterError: A value is not accepted.
        KeyError: There is no such setting.
    """
    schema = schema_of(type(record))
    given = {name: schema.entries[name].parsed(value) for name, value in values.items()}
    built: T = schema.build(schema.values_of(record) | given)
    return built


def described(make: type) -> list[Setting]:
    """Return the settings of a dataclass that help and reference have."""
    return [each for each in schema_of(make).entries.values() if not each.hidden]


def plain(value: Any) -> Any:
    """Return a setting's value as YAML and ROS have it."""
    return list(value) if isinstance(value, tuple) else value


def in_yaml(value: Any) -> str:
    """Return a value as YAML has it."""
    if isinstance(value, str):
        return f"'{value}'"
    return json.dumps(value, default=repr, ensure_ascii=False)
