# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The rules of Takagi–Sugeno fuzzy systems: membership functions and normalised rule weights.

A covariance that follows the estimate needs the slopes of the rule weights, since the premise is
an estimate as well; so the named membership functions know theirs. At a corner it is that of one
side.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, finite, positive
from tsobs_ros.errors import ModelError

MembershipFunction = Callable[[Array], Array]
"""Grade in [0, ∞) of one premise variable, evaluated elementwise on an array."""


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
        premise = np.asarray(z, dtype=np.float64)
        if premise.ndim == 0 or premise.shape[-1] != self.premise_count:
            raise ModelError(
                f"z: expected a last axis of {self.premise_count} premise variables, "
                f"got shape {premise.shape}"
            )
        grades = np.stack([self._grade(index, premise) for index in range(self.rule_count)], -1)
        if not (grades.min(initial=0.0) >= 0.0 and grades.max(initial=0.0) < np.inf):
            place = tuple(np.argwhere(~((grades >= 0.0) & np.isfinite(grades)))[0])
            raise ModelError(
                f"membership of rule {place[-1] + 1}: expected finite grades of at least 0, "
                f"got {float(grades[place])!r}"
            )
        # A sum of huge grades overflows; dividing by a power of two loses no digit.
        largest = grades.max(axis=-1, keepdims=True)
        if not largest.all():
            where = premise[tuple(np.argwhere(largest[..., 0] == 0.0)[0])].tolist()
            raise ModelError(f"memberships: no rule fires at z = {where}")
        shares = np.ldexp(grades, -np.frexp(largest)[1])
        return np.asarray(shares / shares.sum(axis=-1, keepdims=True))

    def _grade(self, rule: int, premise: Array) -> Array:
        """Return μᵢ(z), shape (...); the product of huge grades may be beyond all numbers."""
        grade = np.ones(premise.shape[:-1])
        for place, membership in enumerate(self.rules[rule]):
            one = np.asarray(membership(premise[..., place]), dtype=np.float64)
            if one.shape not in ((), grade.shape):
                raise ModelError(
                    f"membership of rule {rule + 1}: expected one grade an entry, "
                    f"shape {grade.shape}, got shape {one.shape}"
                )
            grade = grade * one
        return grade


@dataclass(frozen=True)
class Membership(ABC):
    """A grade in [0, 1] of one premise variable z, elementwise; its parameters are its fields.

    Raises:
        ModelError: A parameter is not a finite number, or they are in the wrong order.
    """

    shape: ClassVar[str]
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

    def as_mapping(self) -> dict[str, Any]:
        """Return shape and parameters as a file has them."""
        return {"shape": self.shape, **self.parameters()}

    @abstractmethod
    def __call__(self, z: Array) -> Array:
        """Return the grade."""

    @abstractmethod
    def slope(self, z: Array) -> Array:
        """Return the grade's derivative."""


@dataclass(frozen=True)
class Always(Membership):
    """1 everywhere: a rule that does not look at this premise."""

    shape: ClassVar[str] = "always"

    def __call__(self, z: Array) -> Array:
        return np.ones_like(z)

    def slope(self, z: Array) -> Array:
        return np.zeros_like(z)


@dataclass(frozen=True)
class Linear(Membership):
    """From 0 at z = zero to 1 at z = one, in a straight line, and level outside."""

    zero: float
    one: float
    shape: ClassVar[str] = "linear"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.zero == self.one:
            raise ModelError(f"membership linear: expected zero and one apart, got {self.zero}")

    def __call__(self, z: Array) -> Array:
        return _share((z - self.zero) / (self.one - self.zero))

    def slope(self, z: Array) -> Array:
        inside = (z >= min(self.zero, self.one)) & (z < max(self.zero, self.one))
        return np.where(inside, 1.0 / (self.one - self.zero), 0.0)


@dataclass(frozen=True)
class Triangle(Membership):
    """1 at the peak, falling in straight lines to 0 at left and right."""

    left: float
    peak: float
    right: float
    shape: ClassVar[str] = "triangle"
    increasing: ClassVar[tuple[str, ...]] = ("left", "peak", "right")

    def __call__(self, z: Array) -> Array:
        return np.interp(z, [self.left, self.peak, self.right], [0.0, 1.0, 0.0])

    def slope(self, z: Array) -> Array:
        return _edges(z, self.left, self.peak, self.peak, self.right)


@dataclass(frozen=True)
class Trapezoid(Membership):
    """1 between top_left and top_right, falling in straight lines to 0 at left and right."""

    left: float
    top_left: float
    top_right: float
    right: float
    shape: ClassVar[str] = "trapezoid"
    increasing: ClassVar[tuple[str, ...]] = ("left", "top_left", "top_right", "right")

    def __call__(self, z: Array) -> Array:
        corners = [self.left, self.top_left, self.top_right, self.right]
        return np.interp(z, corners, [0.0, 1.0, 1.0, 0.0])

    def slope(self, z: Array) -> Array:
        return _edges(z, self.left, self.top_left, self.top_right, self.right)


@dataclass(frozen=True)
class Gaussian(Membership):
    """exp(−((z − centre)/width)²/2)."""

    centre: float
    width: float
    shape: ClassVar[str] = "gaussian"

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("membership gaussian: width", self.width)

    def __call__(self, z: Array) -> Array:
        return np.asarray(np.exp(-0.5 * ((z - self.centre) / self.width) ** 2))

    def slope(self, z: Array) -> Array:
        return np.asarray(-(z - self.centre) / self.width**2 * self(z))


@dataclass(frozen=True)
class SineUpper(Membership):
    """Share of the upper sector of the sine: sin z = (h·1 + (1 − h)·b) z on |z| ≤ half_width.

    b = sin(half_width)/half_width is the lower sector, whose share is `SineLower`.
    """

    half_width: float
    shape: ClassVar[str] = "sine_upper"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.half_width < np.pi:
            raise ModelError(
                f"membership {self.shape}: expected 0 < half_width < π, got {self.half_width!r}"
            )

    def __call__(self, z: Array) -> Array:
        bottom = np.sinc(self.half_width / np.pi)
        return _share((np.sinc(z / np.pi) - bottom) / (1.0 - bottom))

    def slope(self, z: Array) -> Array:
        z = np.asarray(z, dtype=np.float64)
        near = np.abs(z) < 1e-3
        away = np.where(near, 1.0, z)
        # (z cos z − sin z)/z² loses every digit near 0, where its series is −z/3 + z³/30.
        fall = np.where(
            near, -z / 3.0 + z**3 / 30.0, (away * np.cos(away) - np.sin(away)) / away**2
        )
        bottom = np.sinc(self.half_width / np.pi)
        return np.where(np.abs(z) < self.half_width, fall / (1.0 - bottom), 0.0)


@dataclass(frozen=True)
class SineLower(SineUpper):
    """Share of the lower sector of the sine, 1 − `SineUpper`."""

    shape: ClassVar[str] = "sine_lower"

    def __call__(self, z: Array) -> Array:
        return np.asarray(1.0 - super().__call__(z))

    def slope(self, z: Array) -> Array:
        return np.asarray(-super().slope(z))


SHAPES: Mapping[str, type[Membership]] = {
    cls.shape: cls for cls in (Always, Linear, Triangle, Trapezoid, Gaussian, SineUpper, SineLower)
}
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
    premise = np.asarray(z, dtype=np.float64)
    grades, slopes = [], []
    for rule in rule_base.rules:
        each = [_named(one)(premise[..., j]) for j, one in enumerate(rule)]
        grades.append(math.prod(each))
        slopes.append(
            [
                _named(one).slope(premise[..., j]) * math.prod(each[:j] + each[j + 1 :])
                for j, one in enumerate(rule)
            ]
        )
    total = np.asarray(sum(grades))
    if not (total > 0.0).all():
        # Says at which z no rule fires.
        rule_base.weights(premise)
    weights = np.moveaxis(np.array(grades), 0, -1) / total[..., np.newaxis]
    rise = np.moveaxis(np.array(slopes), (0, 1), (-2, -1)) / total[..., np.newaxis, np.newaxis]
    return weights, rise - weights[..., np.newaxis] * rise.sum(axis=-2, keepdims=True)


def _named(function: Any) -> Membership:
    if not isinstance(function, Membership):
        raise ModelError(
            f"memberships: expected functions of tsobs_ros.model.fuzzy, which know their "
            f"slopes, got {type(function).__name__}"
        )
    return function


def _edges(z: Array, left: float, top_left: float, top_right: float, right: float) -> Array:
    """Return the slope of a trapezoid, whose top may be a point."""
    rising = (z >= left) & (z < top_left)
    falling = (z >= top_right) & (z < right)
    up, down = 1.0 / (top_left - left), 1.0 / (right - top_right)
    return np.asarray(np.where(rising, up, 0.0) - np.where(falling, down, 0.0))


def _share(value: Array) -> Array:
    """Return the value, kept within [0, 1]; np.clip takes five times as long for one number."""
    return np.asarray(np.minimum(np.maximum(value, 0.0), 1.0))
