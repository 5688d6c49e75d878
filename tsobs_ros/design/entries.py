# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Entries of a YAML file, checked: an error names the entry, what was expected and what came."""

import contextlib
import math
from collections.abc import Collection, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from tsobs_ros.checks import Array, shown
from tsobs_ros.errors import DesignFileError


def mapping(name: str, value: Any) -> Mapping[str, Any]:
    """Return the entry as a mapping of names, or raise `DesignFileError`."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise DesignFileError(f"{name}: expected a mapping, got {shown(value)}")
    return value


def known_only(name: str, data: Mapping[str, Any], allowed: Collection[str]) -> None:
    """Raise `DesignFileError` if the mapping has an entry of another name."""
    unknown = [key for key in data if key not in allowed]
    if unknown:
        raise DesignFileError(
            f"{name}: unknown entry {shown(unknown[0])}, expected some of {', '.join(allowed)}"
        )


def floats(name: str, data: Any, cls: type) -> dict[str, float]:
    """Return the numbers of an entry for the fields of `cls`, or raise `DesignFileError`."""
    entries = mapping(name, data)
    known_only(name, entries, [field.name for field in fields(cls)])
    return {key: number(f"{name}.{key}", value) for key, value in entries.items()}


def text(name: str, value: Any) -> str:
    """Return the entry as text, or raise `DesignFileError` if it is a list or a mapping."""
    # YAML reads a version such as 0.11 as a number.
    if isinstance(value, list | dict):
        raise DesignFileError(f"{name}: expected text, got {shown(value)}")
    return str(value)


def number(name: str, value: Any) -> float:
    """Return the entry as a finite number, or raise `DesignFileError`."""
    # YAML reads 1e-4 (without a point) as text; people write it, so it is accepted as a number.
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DesignFileError(f"{name}: expected a number, got {shown(value)}")
    try:
        converted = float(value)
    except OverflowError:
        converted = math.inf
    if not math.isfinite(converted):
        raise DesignFileError(f"{name}: expected a finite number, got {shown(value)}")
    return converted


def numbers(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Return the entry, lists in lists, as an array of `shape`, or raise `DesignFileError`."""

    def walk(item: Any, depth: int, place: str) -> Any:
        if depth == 0:
            return number(place, item)
        length = shape[len(shape) - depth]
        if not isinstance(item, list) or len(item) != length:
            got = f"{len(item)}" if isinstance(item, list) else shown(item)
            raise DesignFileError(f"{place}: expected a list of {length}, got {got}")
        return [walk(child, depth - 1, f"{place}[{i}]") for i, child in enumerate(item)]

    return np.array(walk(value, len(shape), name), dtype=np.float64)
