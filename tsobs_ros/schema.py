# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of plain data in files to dataclasses and back; errors have the path of the entry.

>>> from dataclasses import make_dataclass
>>> Spring = make_dataclass("Spring", [("stiffness", float)])
>>> decode({"stiffness": "1e3"}, Spring).stiffness
1000.0
>>> decode({"stiffness": "soft"}, Spring)
Traceback (most recent call last):
tsobs_ros.errors.DesignFileError: stiffness: expected a number, got 'soft'
"""

import contextlib
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from functools import lru_cache, partial
from os import PathLike
from types import MappingProxyType, NoneType, UnionType
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

from tsobs_ros.checks import shown
from tsobs_ros.errors import DesignFileError

T = TypeVar("T")

_REFUSALS = (ValueError, ArithmeticError, np.linalg.LinAlgError)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_WORDS = {
    str: "text", bool: "true or false", int: "a whole number", float: "a number",
    list: "a list", dict: "a mapping",
}  # fmt: skip
"""Types of entries in words, in the order in which errors name them."""


def decode(data: object, kind: type[T], **given: Any) -> T:
    """Return plain data as an instance of a type; entries with unknown names are refused.

    Fields in `given` take their values from there, and must not be entries of the data.

    Text such as 1e-4 counts as a number, although YAML 1.1 reads it as text. The type is a
    dataclass of plain types, lists, tuples, mappings and dataclasses. A union with None is for an
    entry that may be left out, `numpy.ndarray` for numbers in lists of lists. A class with
    `from_mapping` is made by that method. A field's metadata may have the `name` of its entry.

    Raises:
        DesignFileError: The data is not of this type; the text has the path of the entry.
    """
    with within(""):
        return cast(T, _decoded(data, kind, given))


def encode(value: Any) -> Any:
    """Return a value as the plain data that `decode` reads, without entries that are None."""
    if is_dataclass(value):
        given = {
            name: getattr(value, field)
            for name, (field, *_) in _entries(cast(Any, type(value))).items()
        }
        if getattr(value, "OMIT_EMPTY", False):
            given = {name: each for name, each in given.items() if each}
        return {name: encode(each) for name, each in given.items() if each is not None}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: encode(each) for name, each in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [encode(each) for each in value]
    return value


@contextlib.contextmanager
def within(place: str | PathLike[str], *, is_file: bool = False) -> Iterator[None]:
    """Put the name or the path of an entry in front of errors about its values."""
    try:
        yield
    except _REFUSALS as problem:
        text, joint = str(problem), ": "
        if not is_file and (text.startswith("[") or not place):
            joint = ""
        elif not is_file and re.match(r"\w+(\.\w+|\[\d+\])*: ", text):  # a path inside it
            joint = "."
        raise DesignFileError(f"{place}{joint}{text}") from problem


naming = partial(within, is_file=True)
"""Puts the name of a file in front of errors about its values."""


@lru_cache
def _entries(kind: Any) -> dict[str, tuple[str, Any, bool]]:
    """Return a dataclass' fields by their entries' names: name, type, whether it is required."""
    hints = get_type_hints(kind)
    return {
        each.metadata.get("name", each.name): (
            each.name,
            hints[each.name],
            each.default is MISSING and each.default_factory is MISSING,
        )
        for each in fields(kind)
        if each.init
    }


def _decoded(data: Any, kind: Any, given: Mapping[str, Any] = MappingProxyType({})) -> Any:
    choices = get_args(kind) if get_origin(kind) in (UnionType, Union) else (kind,)
    if data is None and NoneType in choices:
        return None
    shapes = {_shape(each): each for each in choices if each is not NoneType}
    for name in data if isinstance(data, dict) else ():
        if not isinstance(name, str):
            raise DesignFileError(f"expected names of entries, got {name!r}")
    if Any in shapes:
        return data
    if isinstance(data, dict) and dict in shapes:
        return _of_mapping(data, shapes[dict], given)
    if isinstance(data, list) and list in shapes:
        return _of_list(data, shapes[list])
    is_array = (get_origin(kind) or kind) is np.ndarray  # of numbers, or of arrays
    return _plain(data, {float, *shapes} if is_array else set(shapes))


def _shape(kind: Any) -> Any:
    """Return the plain data that make an instance: Any, dict, list or a plain type."""
    origin = get_origin(kind) or kind
    if origin is Any or origin in _WORDS:
        return origin
    return list if issubclass(origin, Sequence | np.ndarray) else dict


def _of_mapping(data: dict[str, Any], kind: Any, given: Mapping[str, Any]) -> Any:
    origin = get_origin(kind) or kind
    if hasattr(origin, "from_mapping"):
        kinds: dict[str, Any] = dict.fromkeys(data, str | float)
    elif is_dataclass(origin):
        known = {k: v for k, v in _entries(cast(Any, origin)).items() if v[0] not in given}
        if lacking := [name for name, entry in known.items() if entry[2] and name not in data]:
            raise DesignFileError(f"{lacking[0]}: missing")
        if unknown := [name for name in data if name not in known]:
            expected = ", ".join(known)
            raise DesignFileError(f"unknown entry {shown(unknown[0])}, expected some of {expected}")
        kinds = {name: entry[1] for name, entry in known.items()}
    else:
        kinds = dict.fromkeys(data, (get_args(kind) or (str, Any))[1])
    values = {}
    for name, value in data.items():
        with within(name):
            values[name] = _decoded(value, kinds[name])
    if hasattr(origin, "from_mapping"):
        return origin.from_mapping(data)
    if is_dataclass(origin):
        return cast(Any, origin)(**{known[k][0]: each for k, each in values.items()}, **given)
    return values


def _of_list(data: list[Any], kind: Any) -> Any:
    origin, items = get_origin(kind) or kind, list[Any]()
    inner = kind if origin is np.ndarray else (get_args(kind) or (Any,))[0]
    for place, item in enumerate(data):
        with within(f"[{place}]"):
            items.append(_decoded(item, inner))
            if origin is np.ndarray and np.shape(items[-1]) != np.shape(items[0]):
                expected, got = np.shape(items[0]), np.shape(items[-1])
                raise DesignFileError(f"expected shape {expected} as [0] has, got {got}")
    return np.array(items) if origin is np.ndarray else items if origin is list else tuple(items)


def _plain(data: Any, kinds: set[Any]) -> Any:
    if isinstance(data, int | float) and not abs(data) <= sys.float_info.max:
        raise DesignFileError(f"expected a finite number, got {shown(data)}")
    if type(data) in kinds:
        return data
    if isinstance(data, str) and _NUMBER.fullmatch(data) and kinds & {int, float}:
        return _plain(float(data) if re.search(r"[.eE]", data) else int(data), kinds)
    if type(data) is int and float in kinds:
        return float(data)
    if type(data) is float and int in kinds and data.is_integer():
        return int(data)
    wanted = " or ".join(words for kind, words in _WORDS.items() if kind in kinds)
    raise DesignFileError(f"expected {wanted}, got {'nothing' if data is None else shown(data)}")
