# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Checks of numbers and matrices; errors name the quantity, the expected and the actual value."""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsobs_ros.errors import ModelError

# Not NDArray: in numpy 2.5 that is an alias in which `schema` could not find an origin.
Array = np.ndarray[tuple[Any, ...], np.dtype[np.float64]]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
T = TypeVar("T")


class Fixed(Mapping[str, T]):
    """A copy of a mapping that cannot be changed, so that checked values stay as they were."""

    def __init__(self, entries: Mapping[str, T]) -> None:
        self._entries = dict(entries)

    def __getitem__(self, name: str) -> T:
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __hash__(self) -> int:
        return hash(frozenset(self.items()))

    def __repr__(self) -> str:
        return repr(self._entries)


def shown(value: object) -> str:
    """Return `value` as text for an error: at most 60 characters, whatever it contains."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def expect(name: str, value: object, kind: Any, words: str = "") -> None:
    """Raise `ModelError` for a value that is not of a class, which `words` name."""
    if not isinstance(value, kind):
        raise ModelError(f"{name}: expected {words or kind.__name__}, got {shown(value)}")


def unmasked(value: Any) -> Any:
    """Return a masked array with NaN in place of the masked entries, any other value as it is."""
    is_masked = isinstance(value, np.ma.MaskedArray)
    return value.astype(np.float64).filled(np.nan) if is_masked else value


def numbers(name: str, value: ArrayLike) -> Array:
    """Return a copy of `value` as a float array, or raise `ModelError` if it is not numeric."""
    try:
        if np.iscomplexobj(value):  # numpy would drop the imaginary part
            raise TypeError
        return np.array(unmasked(value), dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ModelError(f"{name}: expected real numbers, got {shown(value)}") from error


def as_matrix(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return `value` as a read-only float array of exactly `shape`.

    Raises:
        ModelError: The value is not numeric, not finite, or of another shape.
    """
    array = numbers(name, value)
    if array.shape != shape:
        raise ModelError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ModelError(f"{name}: every entry must be finite, got {array.tolist()}")
    return fixed(array)


def fixed(array: Array) -> Array:
    """Make an array read-only, and return it."""
    array.setflags(write=False)
    return array


def positive(name: str, value: float) -> float:
    """Return `value` as a float if it is a finite number above zero, else raise `ModelError`."""
    return finite(name, value, math.ulp(0.0), " above 0")


def non_negative(name: str, value: float) -> float:
    """Return `value` as a float if it is finite and at least zero, else raise `ModelError`."""
    return finite(name, value, 0.0, " of at least 0")


def finite(name: str, value: float, least: float = -math.inf, words: str = "") -> float:
    """Return `value` as a float if it is finite and at least `least`, else raise `ModelError`."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not (math.isfinite(number) and number >= least):
        raise ModelError(f"{name}: expected a finite number{words}, got {shown(value)}")
    return number


def check_names(entry: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raise `ModelError` for a name in an entry that is not among the known ones."""
    for name in names:
        if name not in known:
            expected = ", ".join(known) or "none"
            raise ModelError(f"{entry}: expected some of {expected}, got {shown(name)}")
