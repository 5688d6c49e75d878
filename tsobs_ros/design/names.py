# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Names and units of a T–S system's signals, as its file gives them and messages have them."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

from tsobs_ros.checks import shown
from tsobs_ros.errors import ModelError

_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_MAX_LENGTH = 60


@dataclass(frozen=True)
class Labels:
    """Names, or units, of signals in the order of the model; a group left out has none.

    Attributes:
        states: Of x.
        outputs: Of y.
        inputs: Of u, scheduled signals not among them.
        scheduled: Of s.
    """

    OMIT_EMPTY: ClassVar[bool] = True
    """Groups without names are left out of files."""

    states: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    scheduled: tuple[str, ...] = ()


NO_LABELS = Labels()
"""Those of a request that gives none."""


def checked_labels(names: Labels, units: Labels, counts: Sequence[int]) -> tuple[Labels, Labels]:
    """Return the names and units of all signals, of which a request may give some.

    Groups without names get x1, y1, u1, s1 and so on; units without any are empty texts. A
    scheduled signal with the name of an output is that measurement. Else the names of outputs,
    inputs and scheduled signals differ, as these are entries of one message, and so do those of
    the states.

    Raises:
        ModelError: There is not one text per signal, one is not plain, or two signals share a name;
            the text has the place of the entry.
    """
    groups = zip(vars(names).values(), counts, "xyus", strict=True)
    filled = Labels(
        *(given or tuple(f"{x}{i + 1}" for i in range(count)) for given, count, x in groups)
    )
    plain = "a letter, then letters, digits and underscores"
    _require("names", filled, counts, plain, _PLAIN.fullmatch)
    if units == NO_LABELS:
        units = Labels(*(("",) * count for count in counts))
    _require("units", units, counts, "printable characters", str.isprintable)
    for together in (("states",), ("outputs", "inputs"), ("inputs", "scheduled")):
        places: dict[str, str] = {}
        for group in together:
            for i, name in enumerate(getattr(filled, group)):
                place = f"names.{group}[{i}]"
                if (other := places.setdefault(name, place)) != place:
                    raise ModelError(
                        f"{place}: expected a name that no other has, got {shown(name)}, "
                        f"which {other} has"
                    )
    return filled, units


def labelled(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Return each name with its unit, if it has one, as in "angle [rad]"."""
    pairs = zip(names, units, strict=True)
    return tuple(f"{name} [{unit}]" if unit else name for name, unit in pairs)


def _require(
    entry: str, labels: Labels, counts: Sequence[int], what: str, is_good: Callable[[str], object]
) -> None:
    """Refuse texts of another number than signals, too long ones and those that are not `what`."""
    for (group, given), count in zip(vars(labels).items(), counts, strict=True):
        if len(given) != count:
            signal = "scheduled signal" if group == "scheduled" else group.removesuffix("s")
            got = len(given) or "none"
            raise ModelError(f"{entry}.{group}: expected {count}, one for each {signal}, got {got}")
        for i, text in enumerate(given):
            if len(text) > _MAX_LENGTH or not is_good(text):
                raise ModelError(
                    f"{entry}.{group}[{i}]: expected {what}, {_MAX_LENGTH} at most, "
                    f"got {shown(text)}"
                )
