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

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, is_dataclass, replace
from enum import Enum
from numbers import Integral
from typing import Any, TypeVar, cast, get_args, get_type_hints

from tsobs_ros.errors import ModelError, ParameterError

T = TypeVar("T")

_KEY = "tsobs_ros.setting"
# Of each type: what ROS calls it, and one and several of it in words.
_TYPES: Mapping[type, tuple[str, str, str]] = {
    bool: ("bool", "true or false", "booleans"),
    int: ("integer", "an integer", "integers"),
    float: ("double", "a number", "numbers"),
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
        element: Its type as a user gives it, or that of an element: bool, int, float or str.
        is_array: Whether it is a tuple.
        make: Its type, or that of an element, which may be an enum.
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
    element: type = str
    is_array: bool = False
    make: type = str

    @property
    def kind(self) -> str:
        """The name of the type in ROS, such as "double_array"."""
        return _TYPES[self.element][0] + "_array" * self.is_array

    @property
    def limits(self) -> tuple[str, ...]:
        """What is accepted, in words."""
        low, high = self.minimum, self.maximum
        return (
            *([] if low is None else [f"at least {low}"]),
            *([] if high is None else [f"at most {high}"]),
            *([f"one of: {', '.join(map(str, self.choices))}"] if self.choices else []),
        )

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
            return self._element(value)
        if value is None:  # rcl hands `name: []` over like this
            return ()
        if isinstance(value, str | bytes) or not hasattr(value, "__len__"):
            raise self._wrong_type(value)
        return tuple(self._element(item) for item in list(value))

    def parsed(self, value: Any) -> Any:
        """Return a value, or its text as on the command line, in the setting's type."""
        if isinstance(value, str) and not self.is_array and self.element in (bool, int, float):
            text = value.strip()
            try:
                words = {"true": True, "false": False}
                value = words[text.lower()] if self.element is bool else self.element(text)
            except (KeyError, ValueError):
                raise self._wrong_type(value) from None
        return self.converted(value)

    def _element(self, value: Any) -> Any:
        low, high, kind = self.minimum, self.maximum, cast(Any, self.element)
        if isinstance(value, self.make) and isinstance(value, Enum):
            value = value.value
        if isinstance(value, bool) != (kind is bool):
            raise self._wrong_type(value)
        if kind in (int, float) and isinstance(value, Integral):
            value = kind(value)
        if not isinstance(value, kind):
            raise self._wrong_type(value)
        if isinstance(value, float) and not math.isfinite(value):
            accepted, limits = False, "finite"
        else:
            accepted = (low is None or value >= low) and (high is None or value <= high)
            accepted &= not self.choices or value in self.choices
            limits = " and ".join(self.limits)
        if not accepted:
            each = "each element of " if self.is_array else ""
            unit = f" {self.unit}" if self.unit else ""
            raise ParameterError(
                f"{each}parameter '{self.name}' must be {limits}{unit}, got {in_yaml(value)}"
            )
        return self.make(value)

    def _wrong_type(self, value: Any) -> ParameterError:
        hint = ""
        if self.is_array and isinstance(value, str) and value.lstrip().startswith("["):
            # ros2cli sends a list of mixed types as a string, and rcl refuses it in YAML.
            hint = "; lists must not mix types: write every number with a decimal point"
        _, one, several = _TYPES[self.element]
        expected = f"a list of {several}" if self.is_array else one
        got = "nothing" if value is None else in_yaml(value)
        return ParameterError(f"parameter '{self.name}': expected {expected}, got {got}{hint}")


def setting(default: T, description: str, **rules: Any) -> T:
    """Declare a dataclass field as a setting, of type bool, int, float, str, an enum or tuples.

    Args:
        default: Value if the user gives none.
        description: One line, without the unit.
        **rules: Other attributes of `Setting`: `unit`, `minimum`, `maximum`, `choices`, `live` and
            `hidden`.

    Returns:
        A dataclass field, typed as the default so that annotations check.
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
                limits = f" of {' and '.join(rule.limits)}" if rule.limits else ""
                raise ModelError(
                    f"{name} {item.name}: expected a finite number{limits}, got {value!r}"
                )


class Schema:
    """The settings of a dataclass and of its groups.

    Attributes:
        entries: The settings by their full names, in the order of the fields.

    Raises:
        TypeError: A field is none of a setting or of a type that none has.
    """

    def __init__(
        self, make: Any, members: Mapping[str, Field[Any]] | None = None, prefix: str = ""
    ) -> None:
        if not (isinstance(make, type) and is_dataclass(make)):
            raise TypeError(f"{make!r} is not a dataclass of settings")
        self.entries: dict[str, Setting] = {}
        self._make, self._prefix = make, prefix
        self._parts: dict[str, Schema | Setting] = {}
        hints = get_type_hints(make)
        for name, item in (members or {item.name: item for item in fields(make)}).items():
            hint, own, full_name = hints[name], item.metadata.get(_KEY), f"{prefix}{name}"
            if isinstance(own, dict):
                group = Schema(hint, own, f"{full_name}.")
                self._parts[name] = group
                self.entries |= group.entries
                continue
            kind = (get_args(hint) or (hint,))[0]
            if own is None or not issubclass(kind, (*_TYPES, Enum)):
                raise TypeError(f"{make.__name__}.{name}: {hint} is not a setting")
            found = {"name": full_name, "make": kind, "element": kind, "is_array": hint is not kind}
            if issubclass(kind, Enum):
                choices = own.choices or tuple(each.value for each in kind)
                found |= {"element": str, "choices": choices}
            self._parts[name] = self.entries[full_name] = replace(own, **found)

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
    """Refuse an instance of a dataclass of settings with a value that is not accepted.

    Raises:
        ParameterError: The first such value.
    """
    schema = schema_of(type(record))
    for name, value in schema.values_of(record).items():
        schema.entries[name].converted(value)


def changed(record: T, values: Mapping[str, Any]) -> T:
    """Return an instance of a dataclass of settings with some of them changed.

    Args:
        record: The instance.
        values: By their full names; text is converted.

    Raises:
        ParameterError: A value is not accepted.
        KeyError: There is no such setting.
    """
    schema = schema_of(type(record))
    given = {name: schema.entries[name].parsed(value) for name, value in values.items()}
    built: T = schema.build(schema.values_of(record) | given)
    return built


def describe(make: type) -> list[tuple[str, str, str, str, str]]:
    """Return name, type, default, what is accepted and description of settings, but hidden ones."""
    return [
        (
            each.name,
            each.kind,
            in_yaml(each.default),
            "; ".join([*each.limits, *([] if each.live else ["read-only"])]),
            each.description,
        )
        for each in schema_of(make).entries.values()
        if not each.hidden
    ]


def plain(value: Any) -> Any:
    """Return a setting's value as YAML and ROS have it."""
    return list(value) if isinstance(value, tuple) else getattr(value, "value", value)


def in_yaml(value: Any) -> str:
    """Return a value as YAML would take it back."""
    value = plain(value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"'{value}'"
    if hasattr(value, "__len__"):
        return f"[{', '.join(map(in_yaml, list(value)))}]"
    return repr(value)
