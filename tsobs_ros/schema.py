# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of what files hold, read and written by msgspec: an error has the path of the wrong entry.

>>> class Spring(msgspec.Struct):
...     stiffness: float
>>> decode({"stiffness": "1e3"}, Spring).stiffness
1000.0
>>> decode({"stiffness": "soft"}, Spring)
Traceback (most recent call last):
tsobs_ros.errors.DesignFileError: stiffness: expected a number, got 'soft'
"""

import contextlib
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from os import PathLike
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin

import msgspec
import numpy as np

from tsobs_ros.checks import meant, shown
from tsobs_ros.errors import DesignFileError

T = TypeVar("T")

_REFUSALS = (ValueError, ArithmeticError, np.linalg.LinAlgError)
_NAMES = {
    "object": "a mapping",
    "array": "a list",
    "str": "text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
}


def decode(data: object, kind: type[T]) -> T:
    """Return plain data as an instance of a type. Entries of unknown names are refused.

    Args:
        data: What a YAML file holds. Text such as 1e-4 counts, which YAML 1.1 takes for no number.
        kind: A Struct, or a dataclass of defaults. Two types besides msgspec's may be in it:
            `numpy.ndarray` is numbers in lists of lists, each of one length; a class with
            `from_mapping` is made of a mapping by that.

    Raises:
        DesignFileError: The data is not of this type; the text has the path of the entry, what
            was expected and what came.
    """
    _check(data, kind, "")
    try:
        return msgspec.convert(data, kind, strict=False, dec_hook=_made)
    except msgspec.ValidationError as problem:
        message, _, path = str(problem).removesuffix("`").partition(" - at `$")
        raise DesignFileError(located(path.removeprefix("."), message)) from problem


def encode(value: object) -> Any:
    """Return what `decode` makes the value of."""
    return msgspec.to_builtins(value, enc_hook=_plain)


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
    if message.startswith("[") or not place:
        return f"{place}{message}"
    joint = "." if re.match(r"\w+(\.\w+|\[\d+\])*: ", message) else ": "
    return f"{place}{joint}{message}"


def _check(data: Any, kind: Any, place: str) -> None:
    """Refuse entries of unknown names or wrong types; msgspec omits names and what came."""
    if isinstance(kind, UnionType) and msgspec.UnsetType in get_args(kind):
        kind = get_args(kind)[0]
    if isinstance(data, dict):
        for name in data:
            if not isinstance(name, str):
                raise DesignFileError(located(place, f"expected names of entries, got {name!r}"))
    origin, items = get_origin(kind) or kind, get_args(kind)
    if isinstance(data, dict) and (known := _entries(kind)) is not None:
        for name, (_, required) in known.items():
            if required and name not in data:
                raise DesignFileError(located(place, f"{name}: missing"))
        for name, value in data.items():
            if name not in known:
                message = (
                    f"unknown entry {shown(name)}{meant(name, known)}, "
                    f"expected some of {', '.join(known)}"
                )
                raise DesignFileError(located(place, message))
            _check(value, known[name][0], f"{place}.{name}" if place else name)
    elif isinstance(data, dict) and issubclass(origin, Mapping) and items:
        for name, value in data.items():
            _check(value, items[1], f"{place}.{name}" if place else name)
    elif isinstance(data, list) and items and origin is not np.ndarray:
        for index, value in enumerate(data):
            _check(value, items[0], f"{place}[{index}]")
    else:
        _check_value(data, kind, place)


def _check_value(data: Any, kind: Any, place: str) -> None:
    if isinstance(data, int | float) and not abs(data) <= sys.float_info.max:
        raise DesignFileError(located(place, f"expected a finite number, got {shown(data)}"))
    try:
        msgspec.convert(data, kind, strict=kind is bool, dec_hook=_made)
    except msgspec.ValidationError as problem:
        message = str(problem)
        if match := re.match(r"Expected `(.*?)`", message):
            wanted = " or ".join(_NAMES[name] for name in match[1].split(" | "))
            message = f"expected {wanted}, got {shown(data)}"
        raise DesignFileError(located(place, message)) from problem


def _entries(kind: Any) -> dict[str, tuple[Any, bool]] | None:
    """Return the type of each entry of a mapping and whether it must be there, by its name."""
    if is_dataclass(kind):
        return {
            each.name: (each.type, each.default is MISSING and each.default_factory is MISSING)
            for each in fields(kind)
        }
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        entries = msgspec.structs.fields(kind)
        return {entry.encode_name: (entry.type, entry.required) for entry in entries}
    return None


def _made(kind: Any, value: Any) -> Any:
    if get_origin(kind) is np.ndarray:
        if not isinstance(value, list):
            raise ValueError(f"expected a list, got {shown(value)}")
        return np.array(_numbers(value, ""))
    if not isinstance(value, dict):
        raise ValueError(f"expected a mapping, got {shown(value)}")
    _check(value, dict[str, str | float], "")
    return kind.from_mapping(value)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else dict(value)


def _numbers(value: Any, place: str) -> Any:
    """Return numbers in lists of lists, all lists of a level of one length."""
    if not isinstance(value, list):
        _check_value(value, float, place)
        return float(value)
    rows = [_numbers(item, f"{place}[{i}]") for i, item in enumerate(value)]
    for i, row in enumerate(rows):
        if np.shape(row) != np.shape(rows[0]):
            raise ValueError(
                f"{place}[{i}]: expected shape {np.shape(rows[0])} as {place}[0] has, "
                f"got {np.shape(row)}"
            )
    return rows
