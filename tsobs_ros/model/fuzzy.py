# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The rules of Takagi–Sugeno fuzzy systems: membership functions and normalised rule weights.

A covariance that follows the estimate needs the slopes of the rule weights, since the premise is
an estimate as well; so the named membership functions know theirs. At a corner it is that of one
side.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, Integers, finite, positive
from tsobs_ros.core import native
from tsobs_ros.core.functions import evaluate
from tsobs_ros.errors import ModelError

ALWAYS, LINEAR, TRAPEZOID, GAUSSIAN, SINE_UPPER, SINE_LOWER, SQUARE, SQUARE_REST = range(8)
"""Codes of the shapes. Their parameters, in this order; the rest of the four is not read:

LINEAR: zero, one. TRAPEZOID: left, top_left, top_right, right. GAUSSIAN: centre, width.
SINE_UPPER, SINE_LOWER: half_width, sin(half_width)/half_width. SQUARE, SQUARE_REST: half_width.
"""

MembershipFunction = Callable[[Array], Array]
"""Grade in [0, ∞) of one premise variable, evaluated elementwise on an array."""


class CodedRules(NamedTuple):
    """A rule base as the compiled core has it.

    Attributes:
        shapes: Codes, shape (r, q).
        parameters: Shape (r, q, 4).
    """

    shapes: Integers
    parameters: Array


@dataclass(frozen=True)
class RuleBase:
    """The premises of a T–S system: for each rule one membership function a premise variable.

    The weight of rule i is hᵢ(z) = μᵢ(z) / Σ μ(z) with μᵢ(z) = Πⱼ μⱼᵢ(zⱼ), so that the weights
    are non-negative and sum to one.
    """

    rules: tuple[tuple[MembershipFunction, ...], ...]

    def __post_init__(self) -> None:
        if not self.rules or not self.rules[0]:
            raise ModelError("rules: expected at least one rule with one premise variable")
        lengths = {len(rule) for rule in self.rules}
        if len(lengths) != 1:
            raise ModelError(
                f"rules: every rule needs one membership function a premise variable, "
                f"got {[len(rule) for rule in self.rules]}"
            )

    @property
    def rule_count(self) -> int:
        """Number of rules r."""
        return len(self.rules)

    @property
    def premise_count(self) -> int:
        """Number of premise variables."""
        return len(self.rules[0])

    @property
    def coded(self) -> CodedRules:
        """The rules as arrays.

        Raises:
            ModelError: A membership function is none of this module, so that no code, and no
                slope of it, is known.
        """
        if self._coded is None:
            other = next(
                each for rule in self.rules for each in rule if not isinstance(each, Membership)
            )
            raise ModelError(
                f"memberships: expected functions of tsobs_ros.model.fuzzy, which know their "
                f"slopes, got {type(other).__name__}"
            )
        return self._coded

    @cached_property
    def _coded(self) -> CodedRules | None:
        named = [[each for each in rule if isinstance(each, Membership)] for rule in self.rules]
        if sum(map(len, named)) < self.rule_count * self.premise_count:
            return None
        shapes = np.array([[each.code for each in rule] for rule in named], dtype=np.int64)
        return CodedRules(shapes, np.array([[each.coded for each in rule] for rule in named]))

    def weights(self, z: ArrayLike) -> Array:
        """Return the normalised rule weights h(z).

        Args:
            z: Premise variables, shape (..., premise_count).

        Returns:
            Weights, shape (..., r), each ≥ 0, summing to one.

        Raises:
            ModelError: z has the wrong last axis, a grade is negative or not finite, or no rule
                fires at some z.
        """
        if self._coded is not None:
            return weights_and_slopes(self, z)[0]
        premise = self._checked(z)
        weights = self._grades(premise)
        native.normalise_each(weights, self.rule_count)
        self._check(premise, weights)
        return weights

    def _checked(self, z: ArrayLike) -> Array:
        """Return the premise variables as a contiguous array."""
        premise = np.asarray(z, dtype=np.float64)
        if premise.ndim == 0 or premise.shape[-1] != self.premise_count:
            raise ModelError(
                f"z: expected a last axis of {self.premise_count} premise variables, "
                f"got shape {premise.shape}"
            )
        return np.ascontiguousarray(premise)

    def _check(self, premise: Array, weights: Array) -> None:
        """Refuse weights that are not numbers, with the reason."""
        if not np.isnan(weights).any():
            return
        grades = self._grades(premise)
        wrong = ~((grades >= 0.0) & np.isfinite(grades))
        if wrong.any():
            place = tuple(np.argwhere(wrong)[0])
            raise ModelError(
                f"membership of rule {place[-1] + 1}: expected finite grades of at least 0, "
                f"got {float(grades[place])!r}"
            )
        where = premise[tuple(np.argwhere(np.isnan(weights[..., 0]))[0])].tolist()
        raise ModelError(f"memberships: no rule fires at z = {where}")

    def _grades(self, premise: Array) -> Array:
        """Return μ(z), shape (..., r); the product of huge grades may be beyond all numbers."""
        grades = np.ones((*premise.shape[:-1], self.rule_count))
        for rule, memberships in enumerate(self.rules):
            for place, membership in enumerate(memberships):
                one = np.asarray(membership(premise[..., place]), dtype=np.float64)
                if one.shape not in ((), premise.shape[:-1]):
                    raise ModelError(
                        f"membership of rule {rule + 1}: expected one grade an entry, "
                        f"shape {premise.shape[:-1]}, got shape {one.shape}"
                    )
                grades[..., rule] *= one
        return grades


@dataclass(frozen=True)
class Membership:
    """A grade in [0, 1] of one premise variable z, elementwise; its parameters are its fields.

    Raises:
        ModelError: A parameter is not a finite number, or they are in the wrong order.
    """

    shape: ClassVar[str]
    code: ClassVar[int]
    increasing: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for name, value in self.parameters().items():
            object.__setattr__(self, name, finite(f"membership {self.shape}: {name}", value))
        values = [getattr(self, name) for name in self.increasing]
        if any(one >= other for one, other in pairwise(values)):
            raise ModelError(
                f"membership {self.shape}: expected {' < '.join(self.increasing)}, got {values}"
            )

    def parameters(self) -> dict[str, float]:
        """Return the parameters by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def coded(self) -> tuple[float, float, float, float]:
        """The parameters for the compiled core, filled up with zeros."""
        a, b, c, d = (*self.parameters().values(), 0.0, 0.0, 0.0, 0.0)[:4]
        return a, b, c, d

    def as_mapping(self) -> dict[str, Any]:
        """Return shape and parameters as a file has them."""
        return {"shape": self.shape, **self.parameters()}

    def __call__(self, z: ArrayLike) -> Array:
        """Return the grade."""
        return self._evaluated(z)[0]

    def slope(self, z: ArrayLike) -> Array:
        """Return the grade's derivative."""
        return self._evaluated(z)[1]

    def _evaluated(self, z: ArrayLike) -> tuple[Array, Array]:
        premise = np.ascontiguousarray(z, dtype=np.float64)
        grades, slopes = np.empty((2, premise.size))
        native.grades_and_slopes(self.code, np.array(self.coded), premise, grades, slopes)
        shape = np.shape(z)
        return grades.reshape(shape), slopes.reshape(shape)


@dataclass(frozen=True)
class Always(Membership):
    """1 everywhere: a rule that does not look at this premise."""

    shape: ClassVar[str] = "always"
    code: ClassVar[int] = ALWAYS


@dataclass(frozen=True)
class Linear(Membership):
    """From 0 at z = zero to 1 at z = one, in a straight line, and level outside."""

    zero: float
    one: float
    shape: ClassVar[str] = "linear"
    code: ClassVar[int] = LINEAR

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.zero == self.one:
            raise ModelError(f"membership linear: expected zero and one apart, got {self.zero}")


@dataclass(frozen=True)
class Triangle(Membership):
    """1 at the peak, falling in straight lines to 0 at left and right."""

    left: float
    peak: float
    right: float
    shape: ClassVar[str] = "triangle"
    code: ClassVar[int] = TRAPEZOID
    increasing: ClassVar[tuple[str, ...]] = ("left", "peak", "right")

    @property
    def coded(self) -> tuple[float, float, float, float]:
        """The parameters of a trapezoid whose top is a point."""
        return self.left, self.peak, self.peak, self.right


@dataclass(frozen=True)
class Trapezoid(Membership):
    """1 between top_left and top_right, falling in straight lines to 0 at left and right."""

    left: float
    top_left: float
    top_right: float
    right: float
    shape: ClassVar[str] = "trapezoid"
    code: ClassVar[int] = TRAPEZOID
    increasing: ClassVar[tuple[str, ...]] = ("left", "top_left", "top_right", "right")


@dataclass(frozen=True)
class Gaussian(Membership):
    """exp(−((z − centre)/width)²/2)."""

    centre: float
    width: float
    shape: ClassVar[str] = "gaussian"
    code: ClassVar[int] = GAUSSIAN

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("membership gaussian: width", self.width)


@dataclass(frozen=True)
class SineUpper(Membership):
    """Share of the upper sector of the sine: sin z = (h·1 + (1 − h)·b) z on |z| ≤ half_width.

    b = sin(half_width)/half_width is the lower sector, whose share is `SineLower`. Outside of the
    domain h is 0.
    """

    half_width: float
    shape: ClassVar[str] = "sine_upper"
    code: ClassVar[int] = SINE_UPPER

    def __post_init__(self) -> None:
        super().__post_init__()
        # Below, sin(half_width)/half_width is 1 to so many digits that the sectors are lost.
        if not 1e-4 <= self.half_width < np.pi:
            raise ModelError(
                f"membership {self.shape}: expected 1e-4 ≤ half_width < π, got {self.half_width!r}"
            )

    @property
    def coded(self) -> tuple[float, float, float, float]:
        """The half width and the lower sector b."""
        return self.half_width, evaluate("sine", self.half_width).item() / self.half_width, 0.0, 0.0


@dataclass(frozen=True)
class SineLower(SineUpper):
    """Share of the lower sector of the sine, 1 − `SineUpper`."""

    shape: ClassVar[str] = "sine_lower"
    code: ClassVar[int] = SINE_LOWER


@dataclass(frozen=True)
class Square(Membership):
    """(z/half_width)² on |z| ≤ half_width and 1 outside."""

    half_width: float
    shape: ClassVar[str] = "square"
    code: ClassVar[int] = SQUARE

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(f"membership {self.shape}: half_width", self.half_width)


@dataclass(frozen=True)
class SquareRest(Square):
    """1 − `Square`."""

    shape: ClassVar[str] = "square_rest"
    code: ClassVar[int] = SQUARE_REST


SHAPES: Mapping[str, type[Membership]] = {
    cls.shape: cls
    for cls in (
        Always, Linear, Triangle, Trapezoid, Gaussian, SineUpper, SineLower, Square, SquareRest,
    )
}  # fmt: skip
"""Every membership function by its name."""


def membership(shape: str, parameters: Mapping[str, float]) -> Membership:
    """Return a membership function by its name and parameters.

    Raises:
        ModelError: The name is unknown, a parameter is missing, unknown or out of range.
    """
    if shape not in SHAPES:
        raise ModelError(f"membership shape: expected one of {', '.join(SHAPES)}, got {shape!r}")
    wanted = [field.name for field in fields(SHAPES[shape])]
    if sorted(parameters) != sorted(wanted):
        raise ModelError(
            f"membership {shape}: expected the parameters {', '.join(wanted) or 'none'}, "
            f"got {', '.join(parameters) or 'none'}"
        )
    return SHAPES[shape](**parameters)


def weights_and_slopes(rule_base: RuleBase, z: ArrayLike) -> tuple[Array, Array]:
    """Return the normalised rule weights h, shape (..., r), and ∂hᵢ/∂zⱼ, shape (..., r, q).

    Args:
        rule_base: Rules of membership functions of this module.
        z: Premise variables, shape (..., q).

    Raises:
        ModelError: A membership function does not know its slope, or no rule fires.
    """
    premise, coded = rule_base._checked(z), rule_base.coded
    r, q = coded.shapes.shape
    weights = np.empty((*premise.shape[:-1], r))
    slopes = np.empty((*premise.shape[:-1], r, q))
    native.weights_and_slopes_of_each(*coded, premise, weights, slopes, r, q)
    rule_base._check(premise, weights)
    return weights, slopes
