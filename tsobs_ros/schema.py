# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of what files hold, checked by msgspec: an error names the file and the wrong entry.

>>> class Spring(Entries):
...     stiffness: Number
>>> decode({"stiffness": "1e3"}, Spring, "my.yaml").stiffness
1000.0
>>> decode({"stiffness": "soft"}, Spring, "my.yaml")
Traceback (most recent call last):
tsobs_ros.errors.DesignFileError: my.yaml: stiffness: expected a number, got 'soft'
"""

import contextlib
import math
import re
from collections.abc import Callable, Iterator
from os import PathLike
from types import UnionType
from typing import Any, ClassVar, TypeVar, get_args, get_origin

import msgspec
import numpy as np

from tsobs_ros.checks import shown
from tsobs_ros.errors import DesignFileError, TsobsError

T = TypeVar("T")

_REFUSALS = (ValueError, ArithmeticError, np.linalg.LinAlgError)
_PLACE = re.compile(r"(?s)(.*?)(?: - at (`key` in )?`\$(.*)`)?$")
_STEP = re.compile(r"\.(\w+)|\[(\d+)\]|\[(\.{3})\]")
_NAMES = {
    "object": "a mapping",
    "array": "a list",
    "str": "text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "null": "nothing",
}


class Entries(msgspec.Struct, forbid_unknown_fields=True):
    """Base of a mapping's type; entries of other names are refused."""


class Number(float):
    """A finite number; text such as 1e-4 counts, which YAML 1.1 does not take for a number."""


class Variant:
    """A mapping of a name under `tag` and of numbers under whatever other names.

    Attributes:
        name: The text under `tag`.
        parameters: The numbers.
    """

    tag: ClassVar[str]

    def __init__(self, name: str, parameters: dict[str, float]) -> None:
        self.name = name
        self.parameters = parameters


def decode(
    data: object,
    kind: type[T],
    where: str | PathLike[str],
    error: Callable[[str], TsobsError] = DesignFileError,
) -> T:
    """Return plain data as an instance of a type.

    Args:
        data: What a YAML or JSON file holds.
        kind: `Entries`, or another type that msgspec knows, of these and the types of this module;
            `numpy.ndarray` is numbers in lists of lists, of one length each.
        where: The file, for errors.
        error: The kind of error to raise.

    Raises:
        TsobsError: The data is not of this type; the text names the file, the path of the entry,
            what was expected and what came.
    """
    try:
        return msgspec.convert(data, kind, dec_hook=_custom)
    except msgspec.ValidationError as problem:
        raise error(f"{where}: {_explained(str(problem), data, kind)}") from problem


@contextlib.contextmanager
def within(place: str) -> Iterator[None]:
    """Put the path of an entry in front of what its values are refused for."""
    try:
        yield
    except _REFUSALS as problem:
        raise DesignFileError(located(place, str(problem))) from problem


@contextlib.contextmanager
def naming(path: str | PathLike[str]) -> Iterator[None]:
    """Put a file in front of what its values are refused for."""
    try:
        yield
    except _REFUSALS as problem:
        raise DesignFileError(f"{path}: {problem}") from problem


def located(place: str, message: str) -> str:
    """Return a message that may begin with a path inside the entry at `place`."""
    if message.startswith("["):
        return f"{place}{message}"
    if not place:
        return message
    joint = "." if re.match(r"\w+(\.\w+|\[\d+\])*: ", message) else ": "
    return f"{place}{joint}{message}"


def _custom(kind: Any, value: Any) -> Any:
    """Return a value as one of this module's types; msgspec adds its path to a `ValueError`."""
    if kind is Number:
        return Number(_number(value))
    if (get_origin(kind) or kind) is np.ndarray:
        if not isinstance(value, list):
            raise ValueError(f"expected a list, got {shown(value)}")
        return np.array(_numbers(value, ""), dtype=np.float64)
    if isinstance(kind, type) and issubclass(kind, Variant):
        if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
            raise ValueError(f"expected a mapping, got {shown(value)}")
        name = value.get(kind.tag)
        if not isinstance(name, str):
            raise ValueError(f"{kind.tag}: expected a name, got {shown(name)}")
        return kind(name, {k: _number(v, k) for k, v in value.items() if k != kind.tag})
    raise NotImplementedError(f"no entries of type {kind}")


def _number(value: Any, place: str = "") -> float:
    number = math.nan if isinstance(value, bool) else value
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            number = float(value)
    if isinstance(value, bool) or not isinstance(number, int | float):
        raise ValueError(f"{place}: " * bool(place) + f"expected a number, got {shown(value)}")
    try:
        number = float(number)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(
            f"{place}: " * bool(place) + f"expected a finite number, got {shown(value)}"
        )
    return number


def _numbers(value: Any, place: str) -> Any:
    """Return numbers in lists of lists, all lists of a level of one length."""
    if not isinstance(value, list):
        return _number(value, place)
    rows = [_numbers(item, f"{place}[{i}]") for i, item in enumerate(value)]
    for i, row in enumerate(rows):
        if np.shape(row) != np.shape(rows[0]):
            raise ValueError(
                f"{place}[{i}]: expected shape {np.shape(rows[0])} as {place}[0] has, "
                f"got {np.shape(row)}"
            )
    return rows


def _explained(problem: str, data: Any, kind: Any) -> str:
    """Return msgspec's message with the names in a path that it leaves out, and what came."""
    matched = _PLACE.match(problem)
    assert matched is not None
    message, is_key, path = matched[1], bool(matched[2]), matched[3] or ""
    place = ""
    for name, index, anything in _STEP.findall(path):
        kind = _inside(kind, name)
        if anything:
            name = next(key for key in data if not _fits(data[key], kind))
        data = data[int(index)] if index else data[name]
        place += f"[{index}]" if index else f".{name}" if place else name
    if is_key:
        key = next(key for key in data if not isinstance(key, str))
        return located(place, f"expected names of entries, got {shown(key)}")
    if match := re.match(r"(?s)Object contains unknown field `(.*)`", message):
        known = ", ".join(_fields(_only(kind)))
        message = f"unknown entry {shown(match[1])}, expected some of {known}"
    elif match := re.match(r"Object missing required field `(.*)`", message):
        message = f"{match[1]}: missing"
    elif match := re.match(r"Expected (.*?)(, got [^,]*)?$", message):
        wanted = re.sub(r"`(.*?)`", lambda m: _worded(m[1]), match[1])
        message = f"expected {wanted}, got {shown(data)}"
    elif message.startswith("Invalid "):
        wanted = " or ".join(map(repr, get_args(_only(kind))))
        message = f"expected {wanted or 'another value'}, got {shown(data)}"
    return located(place, message)


def _worded(names: str) -> str:
    return " or ".join(_NAMES.get(name, name) for name in names.split(" | ") if name != "null")


def _only(kind: Any) -> Any:
    """Return what an entry is if it is there."""
    if get_origin(kind) is UnionType:
        return next(k for k in get_args(kind) if k not in (msgspec.UnsetType, type(None)))
    return kind


def _inside(kind: Any, name: str) -> Any:
    """Return the type of an entry in a mapping or a list."""
    kind = _only(kind)
    return _fields(kind)[name] if name else get_args(kind)[-1]


def _fields(kind: Any) -> dict[str, Any]:
    """Return the types of a mapping's entries by their names in a file."""
    return {field.encode_name: field.type for field in msgspec.structs.fields(kind)}


def _fits(value: Any, kind: Any) -> bool:
    try:
        msgspec.convert(value, kind, dec_hook=_custom)
    except msgspec.ValidationError:
        return False
    return True
