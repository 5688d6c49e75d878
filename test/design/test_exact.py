# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The exact proof: enclosures contain what they enclose, and only what is true is proved."""

import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.linalg import expm

from tsobs_ros.design.certificate import check_certificate
from tsobs_ros.design.exact import (
    cosine_below,
    decay_below,
    exponential,
    inverse,
    is_positive_definite,
    noise_integral,
    rational,
    verify_exactly,
)
from tsobs_ros.design.record import Design, SolverReport
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=4)
MATRICES = hnp.arrays(np.float64, (3, 3), elements=st.floats(-3.0, 3.0, allow_subnormal=False))


def as_floats(matrix: Any) -> Array:
    return np.array(matrix, dtype=np.float64)


@PROPERTY
@given(MATRICES)
def test_a_matrix_exponential_is_enclosed(matrix: Array) -> None:
    enclosure = exponential(rational(matrix))
    assert enclosure.radius < Fraction(1, 10**60)
    scale = math.exp(float(np.abs(matrix).sum(axis=1).max()))
    np.testing.assert_allclose(as_floats(enclosure.centre), expm(matrix), atol=1e-13 * scale)
    # e^M e^M = e^{2M} to a hundred digits, not only to those of a float.
    doubled = exponential(rational(matrix) * 2)
    gap = np.abs(enclosure.centre @ enclosure.centre - doubled.centre).max()
    largest = np.abs(enclosure.centre).max() + enclosure.radius
    assert gap <= 2 * 3 * largest * enclosure.radius + doubled.radius


@PROPERTY
@given(MATRICES, MATRICES)
def test_a_noise_integral_is_enclosed(matrix: Array, root: Array) -> None:
    density = rational(root) @ rational(root).T
    enclosure = noise_integral(rational(matrix), density)
    joined = expm(np.block([[-matrix, as_floats(density)], [np.zeros((3, 3)), matrix.T]]))
    expected = joined[3:, 3:].T @ joined[:3, 3:]
    scale = 1.0 + np.abs(joined).max() ** 2
    np.testing.assert_allclose(as_floats(enclosure.centre), expected, atol=1e-13 * scale)
    assert (enclosure.centre == enclosure.centre.T).all()


def test_cosine_and_decay_are_bounded_from_below_to_sixty_digits() -> None:
    pi = Fraction("3.14159265358979323846264338327950288419716939937510582097494459")
    assert 0 <= cosine_below(pi) + 1 < Fraction(1, 10**60)
    assert abs(cosine_below(pi / 3) - Fraction(1, 2)) < Fraction(1, 10**60)
    assert cosine_below(pi / 3 + Fraction(1, 10**50)) < Fraction(1, 2)
    for x in (0.0, 1e-9, 0.3, 40.0):
        lower = decay_below(Fraction(x))
        assert float(lower) == pytest.approx(math.exp(-x), rel=1e-14)
        assert lower * decay_below(Fraction(-x)) <= 1


@PROPERTY
@given(MATRICES)
def test_positive_definiteness_and_inverse_are_exact(root: Array) -> None:
    # With a unit in the last place of 10^-40 taken away it is singular, then indefinite.
    gram = rational(root) @ rational(root).T
    tiny = Fraction(1, 10**40)
    shifted = gram + tiny * rational(np.eye(3))
    assert is_positive_definite(shifted)
    assert (shifted @ inverse(shifted) == rational(np.eye(3))).all()
    singular = gram.copy()
    singular[2], singular[:, 2] = singular[1], singular[:, 1]
    singular[2, 2] = singular[1, 1]
    assert not is_positive_definite(singular)
    assert not is_positive_definite(singular - tiny * rational(np.eye(3)))


def test_a_matrix_singular_only_beyond_the_digits_of_floats_is_told_apart(
    shipped: Design,
) -> None:
    """[[1, a], [a, b]] with b the float next to a²: the sign of b − a² is below rounding."""
    a = 1.0 + 2.0**-27
    above = a * a
    assert Fraction(above) < Fraction(a) ** 2
    P = np.eye(5)
    P[:2, :2] = [[1.0, a], [a, above]]
    first = verify_exactly(replace(shipped, P=P)).inequalities[0]
    assert not first.holds
    P[1, 1] = np.nextafter(above, 2.0)
    first = verify_exactly(replace(shipped, P=P)).inequalities[0]
    assert first.holds
    assert not check_certificate(shipped.request, P, shipped.K).inequalities[0].holds


def test_a_model_too_fast_to_enclose_is_refused() -> None:
    arm = ElasticJointArm(link_damping=5e5)
    request = ArmRequest(arm=arm, disturbance=(DisturbanceTerm("clean"),))
    with pytest.raises(ModelError, match="the model is too fast for the period"):
        verify_exactly(Design(request, np.eye(4), np.zeros((4, 1)), SolverReport()))
