# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The rules of Takagi–Sugeno fuzzy systems: membership functions and normalised rule weights.

The compiled core evaluates them, and the slopes that a covariance along the estimate needs.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, Integers, finite, shown
from tsobs_ros.core import native
from tsobs_ros.core.functions import evaluate
from tsobs_ros.errors import ModelError

_ALWAYS, _TRAPEZOID, _GAUSSIAN, _SINE_UPPER, _SINE_LOWER, _SQUARE, _REST = range(7)


class Shape(NamedTuple):
    """A kind of membership function of a premise variable z.

    Attributes:
        code: Its code in the compiled core.
        parameters: Names of its parameters.
        requirement: The requirement on the parameters, in words.
        encode: Converts them to the core's, at most four; None if they violate the requirement.
    """

    code: int
    parameters: tuple[str, ...] = ()
    requirement: str = ""
    encode: Callable[..., tuple[float, ...] | None] = lambda: ()


def _line(zero: float, one: float) -> tuple[float, ...] | None:
    ends = (zero, one, math.inf, math.inf) if zero < one else (-math.inf, -math.inf, one, zero)
    return None if zero == one else ends


def _sector(half_width: float) -> tuple[float, ...] | None:
    # Below 1e-4, sin(half_width)/half_width is so close to 1 that the sectors no longer differ.
    if not 1e-4 <= half_width < math.pi:
        return None
    return half_width, evaluate("sine", half_width).item() / half_width


_OF_SINE: Any = (("half_width",), "1e-4 ≤ half_width < π", _sector)
_OF_SQUARE: Any = (("half_width",), "half_width above 0", lambda w: (w,) if w > 0.0 else None)

SHAPES: Mapping[str, Shape] = {
    # 1 everywhere: the rule ignores this premise.
    "always": Shape(_ALWAYS),
    # From 0 at z = zero to 1 at z = one, in a straight line, and constant outside.
    "linear": Shape(_TRAPEZOID, ("zero", "one"), "zero and one apart", _line),
    # 1 at the peak, falling in straight lines to 0 at left and right.
    "triangle": Shape(
        _TRAPEZOID, ("left", "peak", "right"), "left < peak < right",
        lambda a, b, c: (a, b, b, c) if a < b < c else None,
    ),
    # 1 between top_left and top_right, falling in straight lines to 0 at left and right.
    "trapezoid": Shape(
        _TRAPEZOID, ("left", "top_left", "top_right", "right"),
        "left < top_left < top_right < right",
        lambda a, b, c, d: (a, b, c, d) if a < b < c < d else None,
    ),
    # exp(−((z − centre)/width)²/2).
    "gaussian": Shape(
        _GAUSSIAN, ("centre", "width"), "width above 0", lambda c, w: (c, w) if w > 0.0 else None
    ),
    # Share h of the upper sector of the sine: sin z = (h + (1 − h) b) z on |z| ≤ half_width, with
    # the lower sector b = sin(half_width)/half_width. Outside of the domain h is 0.
    "sine_upper": Shape(_SINE_UPPER, *_OF_SINE),
    # 1 − sine_upper.
    "sine_lower": Shape(_SINE_LOWER, *_OF_SINE),
    # (z/half_width)² on |z| ≤ half_width and 1 outside.
    "square": Shape(_SQUARE, *_OF_SQUARE),
    # 1 − square.
    "square_rest": Shape(_REST, *_OF_SQUARE),
}  # fmt: skip
"""Every kind of membership function by its name."""


class Membership(NamedTuple):
    """A membership function of one premise variable z, with values in [0, 1]; see `membership`.

    Attributes:
        code: Code of its shape in the compiled core.
        numbers: Its four parameters in the compiled core.
        mapping: Shape and parameters in the form that files have.
    """

    code: int
    numbers: tuple[float, ...]
    mapping: Mapping[str, Any]

    @property
    def support(self) -> tuple[float, float]:
        """Ends of the interval in which it is above 0, except perhaps at a single point."""
        if self.code in (_SINE_UPPER, _REST):
            return -self.numbers[0], self.numbers[0]
        is_bounded = self.code == _TRAPEZOID
        return (self.numbers[0], self.numbers[3]) if is_bounded else (-math.inf, math.inf)


def membership(shape: str, parameters: Mapping[str, float] | None = None) -> Membership:
    """Return a membership function by its name and parameters.

    Raises:
        ModelError: The name is unknown, a parameter is missing, unknown or out of range.

    >>> membership("linear", {"zero": 1.0, "one": 3.0}).numbers
    (1.0, 3.0, inf, inf)
    """
    if shape not in SHAPES:
        raise ModelError(
            f"membership shape: expected one of {', '.join(SHAPES)}, got {shown(shape)}"
        )
    kind, given = SHAPES[shape], parameters or {}
    if sorted(given) != sorted(kind.parameters):
        raise ModelError(
            f"membership {shape}: expected the parameters {', '.join(kind.parameters) or 'none'}, "
            f"got {', '.join(given) or 'none'}"
        )
    values = [finite(f"membership {shape}: {name}", given[name]) for name in kind.parameters]
    if (numbers := kind.encode(*values)) is None:
        raise ModelError(f"membership {shape}: expected {kind.requirement}, got {values}")
    mapping = {"shape": shape, **dict(zip(kind.parameters, values, strict=True))}
    return Membership(kind.code, (*numbers, 0.0, 0.0, 0.0, 0.0)[:4], mapping)


@dataclass(frozen=True)
class RuleBase:
    """The premises of a T–S system: for each rule one membership function per premise variable.

    The weight of rule i is hᵢ(z) = μᵢ(z) / Σ μ(z) with μᵢ(z) = Πⱼ μⱼᵢ(zⱼ), so that the weights
    are non-negative and sum to one.

    Raises:
        ModelError: There is no rule, or rules have different numbers of membership functions.
    """

    rules: tuple[tuple[Membership, ...], ...]

    def __post_init__(self) -> None:
        lengths = [len(rule) for rule in self.rules]
        if not self.rules or not lengths[0]:
            raise ModelError("rules: expected at least one rule with one premise variable")
        if len(set(lengths)) != 1:
            raise ModelError(
                f"rules: expected one membership function per premise variable, got {lengths}"
            )

    @cached_property
    def coded(self) -> tuple[Integers, Array]:
        """The rules in the compiled core's form: codes (r, q) and parameters (r, q, 4)."""
        codes = [[each.code for each in rule] for rule in self.rules]
        numbers = [[each.numbers for each in rule] for rule in self.rules]
        return np.array(codes, np.int64), np.array(numbers)

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """The intervals of a single premise variable in which no rule fires."""
        found, reached = [], -math.inf
        for low, high in sorted(rule[0].support for rule in self.rules if len(rule) == 1):
            if low > reached:
                found.append((reached, low))
            reached = max(reached, high)
        return [*found, (reached, math.inf)] if -math.inf < reached < math.inf else found

    def weights(self, z: ArrayLike) -> Array:
        """Return the normalised weights h ≥ 0 of r rules, shape (..., r), at premises (..., q).

        Raises:
            ModelError: z has the wrong last axis, or no rule fires at some z.
        """
        premise, (r, q) = np.array(z, np.float64, order="C"), self.coded[0].shape
        if premise.shape[-1:] != (q,):
            raise ModelError(
                f"z: expected a last axis of {q} premise variables, got shape {premise.shape}"
            )
        weights = np.empty((*premise.shape[:-1], r))
        native.weights_of_each(*self.coded, premise, weights, r, q)
        if np.isnan(weights).any():
            where = premise[tuple(np.argwhere(np.isnan(weights[..., 0]))[0])].tolist()
            raise ModelError(f"memberships: no rule fires at z = {where}")
        return weights
