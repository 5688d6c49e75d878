# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Synthesis: optimal where the optimum is known, known numbers, and refusals that explain."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from tsobs_ros.design.feasibility import find_obstacles, require_detectable
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.design.synthesis import MARGINS, solve_gain, synthesise
from tsobs_ros.errors import DesignError, DetectabilityError, ModelError
from tsobs_ros.model.arm import ElasticJointArm

Array = NDArray[np.float64]


def tone(frequency: float) -> tuple[DisturbanceTerm, ...]:
    return (DisturbanceTerm("sinusoid", {"frequency": frequency}),)


def test_the_shipped_design_can_be_made_again(shipped: Design) -> None:
    again = synthesise(ArmRequest())
    assert again.request == shipped.request
    # Solver versions differ in the last digits; the design they agree on does not.
    np.testing.assert_allclose(again.K, shipped.K, rtol=2e-3)
    np.testing.assert_allclose(again.bound_std, shipped.bound_std, rtol=2e-3)


def test_on_a_single_slope_the_bound_is_the_riccati_solution() -> None:
    request = ArmRequest(x_max=1e-5)
    design = synthesise(request)
    (vertex,) = request.flow.vertices(1.0, 1.0)[:1]
    # The strict margin is bought with a little more noise than there is.
    margin = MARGINS[0] * request.period * design.covariance_bound
    for noise, tolerance in ((vertex.noise, 1e-3), (vertex.noise + margin, 1e-6)):
        kalman = solve_discrete_are(
            vertex.transition.T,
            request.flow.output_matrix.T,
            noise,
            request.measurement_covariance,
        )
        root = np.linalg.cholesky(design.P)
        np.testing.assert_allclose(root.T @ kalman @ root, np.eye(5), atol=tolerance)


def test_a_faster_decay_than_any_gain_gives_is_refused() -> None:
    with pytest.raises(DesignError, match="no common matrix P exists") as caught:
        solve_gain(ArmRequest(decay_rate=5.0))
    assert not isinstance(caught.value, DetectabilityError)
    for part in (r"[0.7317, 1]", "0.75 rad", "decay rate 5 1/s", "200 Hz"):
        assert part in str(caught.value)


def test_a_stiff_arm_has_a_design() -> None:
    design = synthesise(ArmRequest(arm=ElasticJointArm(1.0, 0.5, 5000.0, 10.0)))
    assert design.certificate.holds
    assert design.solver.margin in MARGINS[:3]
    assert design.bound_std[0] < 0.01


def test_an_impossible_design_names_mode_slope_and_help() -> None:
    with pytest.raises(DetectabilityError) as caught:
        require_detectable(ArmRequest(x_max=math.pi / 2))
    for part in (
        "disturbance bias", "c = 0 (|q1| = 90.0 deg)", "the mode 0 with [link_angle, ",
        "[-1, 0, -1, 0, 1]", "x_max below 1.571 rad", "kind gauss_markov", "kind clean",
    ):  # fmt: skip
        assert part in str(caught.value)


def test_the_domain_advised_is_clear_of_every_obstacle() -> None:
    """A bias hides at c = 0, a tone of 1 rad/s at c = 0.35: the advice must clear both."""
    terms = (DisturbanceTerm("bias"), *tone(1.0))
    with pytest.raises(DetectabilityError, match=r"x_max below 1\.213 rad") as caught:
        require_detectable(ArmRequest(disturbance=terms, x_max=1.6))
    assert "c = 0.35 (|q1| = 69.5 deg)" in str(caught.value)
    assert find_obstacles(ArmRequest(disturbance=terms, x_max=1.21)) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"decay_rate": -0.1}, "decay_rate: expected a finite number of at least 0, got -0.1"),
        ({"disturbance": tone(629.0)}, r"sinusoid frequency: .*half the.* 628\.319 rad/s, got 629"),
        (
            {
                "certify_uncertainty": True,
                "uncertainty": dict.fromkeys(
                    ("stiffness", "link_damping", "motor_damping", "link_inverse_inertia"), 0.1
                ),
            },
            "certify_uncertainty: expected at most 3 uncertain parameters besides gravity",
        ),
    ],
)
def test_a_request_out_of_range_is_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        replace(ArmRequest(), **change)


@pytest.mark.parametrize(
    ("kind", "parameters", "message"),
    [
        ("bias", {"density": "much"}, "bias density: expected a finite number, got 'much'"),
        ("clean", {"channels": 2}, "channels: no parameter of clean.*none"),
        ("sinusoid", {}, "frequency: missing, sinusoid has no default"),
    ],
)
def test_a_wrong_disturbance_term_is_named(
    kind: str, parameters: dict[str, float], message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        DisturbanceTerm(kind, parameters)


def test_the_initial_covariance_is_given_in_physical_units() -> None:
    arm = ElasticJointArm(link_inertia=2.0, stiffness=30.0)
    request = ArmRequest(arm=arm, initial_std=(0.1, 0.2, 0.3, 0.4))
    expected = np.diag([0.01, 0.04, (15 * 0.3) ** 2, (15 * 0.4) ** 2, 0.09])
    np.testing.assert_allclose(request.initial_covariance, expected, rtol=1e-14)
