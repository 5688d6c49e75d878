# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Settings: dataclass fields with default, range, unit and description.

A node declares them as ROS parameters, the command line and the API read and check the same ones,
and `--help` and the reference pages list them::

    @dataclass(frozen=True)
    class SimulatorSettings:
        rate: float = setting(200.0, "Publish rate", unit="Hz", minimum=1.0)
        kind: str = live_setting("none", "Disturbance kind", choices=("none", "bias_step"))
        bias_step: BiasStep = field(default_factory=BiasStep)  # a dataclass of settings, too

The full name of the step's amplitude is then "bias_step.amplitude". A ``__post_init__`` that raises
ParameterError or ModelError checks fields against each other.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from numbers import Integral, Real
from operator import attrgetter
from typing import Any, TypeVar

from tsobs_ros.errors import ModelError, ParameterError

T = TypeVar("T")

MIN_RATE = 0.01
"""Least rate of samples and of estimates [Hz]."""

_KEY = "tsobs_ros.setting"
# For each type: its name in ROS, one and several values in words, and the accepted class.
_TYPES: Mapping[type, tuple[str, str, str, Any]] = {
    bool: ("bool", "true or false", "booleans", bool),
    int: ("integer", "an integer", "integers", Integral),
    float: ("double", "a finite number", "numbers with decimal points", Real),
    str: ("string", "a string", "strings", str),
}


@dataclass(frozen=True)
class Setting:
    """A setting of a dataclass.

    Attributes:
        default: Value if the user gives none: bool, int, float, str or a tuple of these.
        summary: A description in one line, without the unit.
        unit: SI unit, or "".
        minimum: Least accepted value, in `unit`; of each element of a tuple.
        maximum: Greatest accepted value, in `unit`; of each element of a tuple.
        choices: The only accepted values, if not empty; of each element of a tuple.
        live: Whether the value may be changed while a node runs.
        element: Type of the elements of a tuple.
        name: Its full name.
    """

    default: Any
    summary: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: Sequence[Any] = ()
    live: bool = False
    element: type = str
    name: str = ""

    @property
    def is_array(self) -> bool:
        """Whether it is a tuple."""
        return isinstance(self.default, tuple)

    @property
    def type(self) -> Any:
        """Its type, or that of an element."""
        return self.element if self.is_array else type(self.default)

    @property
    def kind(self) -> str:
        """The name of the type in ROS, such as "double_array"."""
        return _TYPES[self.type][0] + "_array" * self.is_array

    @property
    def limits(self) -> str:
        """The accepted values, in words."""
        ends = (("at least", self.minimum), ("at most", self.maximum))
        limits = [f"{words} {end}" for words, end in ends if end is not None]
        return f"one of: {', '.join(self.choices)}" if self.choices else " and ".join(limits)

    @property
    def description(self) -> str:
        """The description with the unit."""
        return f"{self.summary} [{self.unit}]" if self.unit else self.summary

    @property
    def expectation(self) -> str:
        """The expected values in words, for the error about another one."""
        _, one, several, _ = _TYPES[self.type]
        expected = f"a list of {several}" if self.is_array else one
        if self.limits:
            link = ", each " if self.is_array else " of "
            expected = self.limits if self.choices else f"{expected}{link}{self.limits}"
        return f"expected {expected}{self.unit and f' {self.unit}'}"

    def accepted(self, value: Any) -> Any:
        """Return a value in the setting's type; None if it is refused, as is text for a number."""
        if not self.is_array:
            return self._accepted(value)
        if value is None:  # this is how rcl passes `name: []`
            return ()
        if isinstance(value, str | bytes) or not isinstance(value, Iterable):
            return None
        elements = tuple(map(self._accepted, value))
        return None if None in elements else elements

    def converted(self, value: Any) -> Any:
        """Return a value, or its text as on the command line, in the setting's type.

        Raises:
            ParameterError: It is of another type, not finite or out of range.
        """
        parsed = value
        if isinstance(value, str) and not self.is_array:
            with suppress(KeyError, ValueError):
                words = {"true": True, "false": False}
                parsed = words[value.lower()] if self.type is bool else self.type(value)
        found = self.accepted(parsed)
        if found is None:
            raise ParameterError(self.refusal(value))
        return found

    def refusal(self, value: Any) -> str:
        """Return the text of an error about a value."""
        return f"parameter '{self.name}': {self.expectation}, got {in_yaml(value)}"

    def _accepted(self, value: Any) -> Any:
        """Return a value in the type of a setting or of its elements; None if it is refused."""
        if isinstance(value, bool) != (self.type is bool):
            return None
        if not isinstance(value, _TYPES[self.type][3]):
            return None
        low = -math.inf if self.minimum is None else self.minimum
        high = math.inf if self.maximum is None else self.maximum
        if self.type in (int, float) and not (math.isfinite(value) and low <= value <= high):
            return None
        return self.type(value) if not self.choices or value in self.choices else None


def setting(default: T, summary: str, **rules: Any) -> T:
    """Declare a dataclass field as a setting; the rules are the other attributes of `Setting`.

    The return type is that of the default, so that type checkers accept the annotation.
    """
    return field(default=default, metadata={_KEY: Setting(default, summary, **rules)})


def live_setting(default: T, summary: str, **rules: Any) -> T:
    """Declare a setting that may be changed while a node runs: `setting` with `live`."""
    return setting(default, summary, live=True, **rules)


def settings_of(make: Any) -> dict[str, Setting]:
    """Return the settings of a dataclass and of dataclasses in it, by full name, in order."""
    found: dict[str, Setting] = {}
    for item in fields(make):
        inner: dict[str, Setting] = {}
        if _KEY in item.metadata:
            inner = {item.name: item.metadata[_KEY]}
        elif is_dataclass(item.default_factory):
            own = settings_of(item.default_factory)
            inner = {f"{item.name}.{name}": each for name, each in own.items()}
        found |= {name: replace(each, name=name) for name, each in inner.items()}
    return found


def values_of(record: Any) -> dict[str, Any]:
    """Return the settings' values in an instance of a dataclass by their full names."""
    return {name: attrgetter(name)(record) for name in settings_of(type(record))}


def check(record: Any, name: str = "") -> None:
    """Refuse a dataclass of settings if one of them has a value that is not accepted.

    Raises:
        ParameterError: For the first such value; a ModelError instead if `name` is given.
    """
    for full_name, rule in settings_of(type(record)).items():
        if rule.accepted(value := attrgetter(full_name)(record)) is None:
            if name:
                raise ModelError(f"{name} {full_name}: {rule.expectation}, got {value!r}")
            raise ParameterError(rule.refusal(value))


def changed(record: T, values: Mapping[str, Any]) -> T:
    """Return an instance of a dataclass of settings with some of them changed.

    Settings have their full names; text is converted.

    Raises:
        ParameterError: There is no such setting, a value is not accepted, or they contradict each
            other.
    """
    known = settings_of(type(record))
    if not isinstance(values, Mapping):
        raise ParameterError(f"expected a mapping from {', '.join(known)}, got {values!r}")
    for name in values:
        if name not in known:
            raise ParameterError(f"parameter '{name}': expected one of {', '.join(known)}")
    given = {name: known[name].converted(value) for name, value in values.items()}
    found: T = _changed(record, given)
    return found


def _changed(record: Any, values: Mapping[str, Any], prefix: str = "") -> Any:
    own = {name: value for name, value in values.items() if "." not in name}
    for group in dict.fromkeys(name.partition(".")[0] for name in values if "." in name):
        start = f"{group}."
        inner = {n.removeprefix(start): v for n, v in values.items() if n.startswith(start)}
        own[group] = _changed(getattr(record, group), inner, prefix + start)
    try:
        return replace(record, **own)
    except ModelError as error:
        where = f"parameters '{prefix}*': " if prefix else ""
        raise ParameterError(f"{where}{error}") from error


def about_unknown(name: str, known: Iterable[str]) -> str:
    """Return the warning about a parameter that is not one of the known ones."""
    near = get_close_matches(name, known, 1)
    return f"ignored unknown parameter '{name}'" + "".join(f"; did you mean '{n}'?" for n in near)


def in_yaml(value: Any) -> str:
    """Return a value as text in YAML."""
    if isinstance(value, str):
        return f"'{value}'"
    return json.dumps(value, default=repr, ensure_ascii=False)
