# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The corners of all error systems of a step: gravity slopes and uncertain parameters.

Half a kick multiplies the error by I + (T/2)(Σ θ_k ∂a_k/∂x − c mgl/J₁ e₂e₁ᵀ), which is affine in
the slope c and in each parameter θ_k on its own (gravity's θ multiplies the slope). So over a box
of parameters it is a convex combination of its values at the corners.
"""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import product
from typing import Generic, NamedTuple, TypeVar

from tsobs_ros.checks import Array
from tsobs_ros.errors import ModelError
from tsobs_ros.model.uncertainty import SINE, Uncertainty

Number = TypeVar("Number", float, Fraction)

_MAX_DIRECTIONS = 3
"""Uncertain directions besides gravity: k of them make 4·4^k vertices."""


class KickCorner(NamedTuple, Generic[Number]):
    """One corner of half a kick.

    Attributes:
        slope: Gravity slope c, that of uncertain gravity and inertia included.
        theta: θ of every direction that acts on the state linearly; () without uncertainty.
    """

    slope: Number
    theta: tuple[Number, ...]


class VertexSystem(NamedTuple):
    """The error system e⁺ = transition·e + noise at one vertex.

    Attributes:
        transition: Shape (n, n).
        noise: Covariance of the noise, shape (n, n).
        where: The vertex in words, for reports.
        slopes: Gravity slopes of an arm's first and second half kick.
    """

    transition: Array
    noise: Array
    where: str
    slopes: tuple[float, float] = (0.0, 0.0)


def linear_directions(uncertainty: Uncertainty) -> list[int]:
    """Return the places of the directions that act on the state linearly, all but gravity.

    Raises:
        ModelError: They are too many for a proof by vertices.
    """
    places = [k for k in range(uncertainty.count) if uncertainty.linear[k].any()]
    if len(places) > _MAX_DIRECTIONS:
        raise ModelError(
            f"certify_uncertainty: expected at most {_MAX_DIRECTIONS} uncertain parameters "
            f"besides gravity, got {', '.join(uncertainty.names[k] for k in places)}"
        )
    return places


def kick_corners(
    slopes: Sequence[Number],
    uncertainty: Uncertainty | None,
    bounds: Sequence[Number] = (),
) -> Iterator[KickCorner[Number]]:
    """Yield the corners of half a kick; of those on one line only its two ends.

    Floats and fractions go through the same formula: an exact proof needs exact corners.

    Args:
        slopes: Smallest and largest cosine of the domain; any single number without gravity.
        uncertainty: The uncertain parameters, if any are to be covered.
        bounds: Bound of each |θ|, in the order of `uncertainty`.
    """
    if uncertainty is None:
        for slope in slopes:
            yield KickCorner(slope, ())
        return
    linear = linear_directions(uncertainty)
    # A direction that scales gravity adds θ c to the slope; no direction kicks the motor by it.
    pulls = [bool(uncertainty.directions[k, ..., SINE].any()) for k in range(uncertainty.count)]
    free = [bounds[k] for k in range(uncertainty.count) if k not in linear and pulls[k]]
    for signs in product((-1, 1), repeat=len(linear)):
        theta = tuple(sign * bounds[k] for sign, k in zip(signs, linear, strict=True))
        pull = 1 + sum(value for value, k in zip(theta, linear, strict=True) if pulls[k])
        ends = [
            slope * (pull + sum(sign * bound for sign, bound in zip(turn, free, strict=True)))
            for slope in slopes
            for turn in product((-1, 1), repeat=len(free))
        ]
        yield KickCorner(min(ends), theta)
        if len(ends) > 1:
            yield KickCorner(max(ends), theta)


def describe(
    first: KickCorner[float],
    second: KickCorner[float],
    uncertainty: Uncertainty | None,
    gravity: bool = True,
) -> str:
    """Return a vertex in words, e.g. "slopes (0.7317, 1), stiffness (-0.2, 0.2)"."""
    parts = [f"slopes ({first.slope:.4g}, {second.slope:.4g})" if gravity else "no gravity"]
    if uncertainty is not None:
        names = [uncertainty.names[k] for k in linear_directions(uncertainty)]
        pairs = zip(names, first.theta, second.theta, strict=True)
        parts += [f"{name} ({one:.4g}, {other:.4g})" for name, one, other in pairs]
    return ", ".join(parts)
