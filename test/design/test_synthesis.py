# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Synthesis: optimal where the optimum is known, refusals that explain, remedies that help."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from tsobs_ros.checks import Array
from tsobs_ros.design.feasibility import find_obstacles, require_detectable, undetectable_modes
from tsobs_ros.design.lyapunov import common_lyapunov, refutation_margin
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import (
    ArmRequest,
    DisturbanceTerm,
    Output,
    TorqueDisturbance,
    TorquePath,
    TSRequest,
)
from tsobs_ros.design.synthesis import MARGINS, solve_gain, synthesise
from tsobs_ros.errors import DesignError, DetectabilityError, ModelError
from tsobs_ros.model.arm import QUANTITIES, ElasticJointArm
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_model import TSModel

BIAS, CLEAN = (DisturbanceTerm("bias"),), (DisturbanceTerm("clean"),)
DRIFT = (DisturbanceTerm("gauss_markov"),)
NO_GRAVITY = ElasticJointArm(gravity_torque=0.0)

SLOW = pytest.mark.slow


def tone(frequency: float) -> tuple[DisturbanceTerm, ...]:
    return (DisturbanceTerm("sinusoid", {"frequency": frequency}),)


def of(*outputs: Any, motor: Any = (), link: Any = (), **changes: Any) -> ArmRequest:
    """Return a request for outputs (name, terms) and torques at motor and link."""
    return ArmRequest(
        outputs=[Output(name, 0.001, terms) for name, terms in outputs],
        torque_disturbance=TorqueDisturbance(motor, link),
        **changes,
    )


def test_the_shipped_design_can_be_made_again(design: Design) -> None:
    again = synthesise(ArmRequest())
    assert again.request == design.request
    # Solver versions differ in the last digits; the design they agree on does not.
    np.testing.assert_allclose(again.K, design.K, rtol=2e-3)
    np.testing.assert_allclose(again.bound_std, design.bound_std, rtol=2e-3)


def test_on_a_single_slope_the_bound_is_the_riccati_solution() -> None:
    request = ArmRequest(x_max=1e-5)
    design = synthesise(request)
    vertex = request.vertices(0)[0]
    # The strict margin is bought with a little more noise than there is.
    margin = MARGINS[0] * request.period * design.covariance_bound
    for noise, tolerance in ((vertex.noise, 1e-3), (vertex.noise + margin, 1e-6)):
        kalman = solve_discrete_are(
            vertex.transition.T, request.flow.output_matrix.T, noise, request.measurement_covariance
        )
        root = np.linalg.cholesky(design.P)
        np.testing.assert_allclose(root.T @ kalman @ root, np.eye(5), atol=tolerance)


def test_a_faster_decay_than_any_gain_gives_is_refused() -> None:
    with pytest.raises(DesignError, match="no common matrix P exists") as caught:
        solve_gain(ArmRequest(decay_rate=5.0))
    assert not isinstance(caught.value, DetectabilityError)
    for part in (r"[0.7317, 1]", "0.75 rad", "decay rate 5 1/s", "200 Hz"):
        assert part in str(caught.value)


TERMS = st.sampled_from([CLEAN, BIAS, DRIFT, tone(2.0), (*BIAS, *tone(3.0)), (*BIAS, *BIAS)])
TORQUES = st.sampled_from([(), BIAS, DRIFT, tone(2.0), tone(3.0)])
REQUESTS = st.builds(
    lambda arm, outputs, motor, link: of(*outputs.items(), motor=motor, link=link, arm=arm),
    st.builds(
        ElasticJointArm, st.floats(0.5, 2.0), st.floats(0.5, 2.0), st.floats(5.0, 20.0),
        st.just(0.0) | st.floats(5.0, 20.0), st.just(0.0) | st.floats(0.1, 1.0),
        st.just(0.0) | st.floats(0.1, 1.0),
    ),
    st.dictionaries(st.sampled_from(QUANTITIES), TERMS, min_size=1, max_size=3),
    TORQUES, TORQUES,
)  # fmt: skip


def drift(request: ArmRequest, slope: float) -> Array:
    """Return the continuous matrix of the augmented error at a gravity slope."""
    matrix = request.flow.drift.copy()
    matrix[1, 0] -= request.arm.gravity_gain * slope
    return matrix


@settings(max_examples=60)
@given(REQUESTS, st.floats(0.75, 0.99))
def test_obstacles_agree_with_a_rank_test(request_: ArmRequest, slope: float) -> None:
    """Obstacles at any slope are what a rank test finds at a slope at random, mode by mode."""
    flow = request_.flow
    obstacles = find_obstacles(request_)
    for obstacle in obstacles:
        at = obstacle.slope if obstacle.slope is not None else request_.slope_range[1]
        A, shape = drift(request_, at), obstacle.shape
        residual = A @ shape - obstacle.eigenvalue * shape
        assert np.linalg.norm(residual) < 1e-9 * np.linalg.norm(A)
        assert np.linalg.norm(flow.output_matrix @ shape) < 1e-9
        assert obstacle.eigenvalue.real > -1e-9
    A = drift(request_, slope)
    anywhere = {round(each.eigenvalue.imag, 6) for each in obstacles if each.slope is None}
    # At the eigenvalues themselves, which numbers have only to few digits if they are defective.
    candidates = (0.0, 2.0, 3.0)
    hidden = set()
    for frequency in candidates:
        pencil = np.vstack([A - 1j * frequency * np.eye(len(A)), flow.output_matrix])
        sizes = np.linalg.svd(pencil, compute_uv=False)
        if sizes[-1] < 1e-9 * sizes[0]:
            hidden.add(frequency)
    assert anywhere == hidden
    for mode in undetectable_modes(A, flow.output_matrix):
        assert np.abs(abs(mode.eigenvalue) - np.array(candidates)).min() < 1e-2


@pytest.mark.parametrize(
    ("request_", "parties"),
    [
        (of(("link_angle", BIAS)), None),
        (of(("link_angle", BIAS), link=DRIFT), None),
        (of(("link_angle", BIAS), link=BIAS),
         "the arm's position, the bias of link_angle and the bias of the torque at the link"),
        (of(("motor_angle", CLEAN), ("link_angle", BIAS), link=BIAS), None),
        (of(("link_angle", BIAS), arm=NO_GRAVITY), "the arm's position and the bias of link_angle"),
        (of(("link_velocity", CLEAN), ("motor_velocity", CLEAN), arm=NO_GRAVITY),
         "the arm's position is not shown by velocities"),
        (of(("motor_velocity", CLEAN), x_max=2.0), "c = 0 (|q1| = 90.0 deg): the arm's pos"),
        (of(("motor_angle", tone(2.0)), link=tone(2.0)),
         "the arm's motion, the sinusoid of motor_angle and the sinusoid of the torque at the"),
    ],
)  # fmt: skip
def test_what_cannot_be_distinguished_is_named(request_: ArmRequest, parties: str | None) -> None:
    if parties is None:
        require_detectable(request_)
        return
    with pytest.raises(DetectabilityError) as caught:
        require_detectable(request_)
    assert parties in str(caught.value)


def lorenz() -> TSRequest:
    """The Lorenz system for |x1| <= 30, of which x1 is measured."""
    A = [[[-10, 10, 0], [28, -1, s * 30.0], [0, -s * 30.0, -8 / 3]] for s in (1.0, -1.0)]
    ends = {"zero": 30.0, "one": -30.0}, {"zero": -30.0, "one": 30.0}
    rules = RuleBase(tuple((membership("linear", each),) for each in ends))
    model = TSModel(
        np.array(A), np.zeros((2, 3, 1)), np.eye(3)[:1], rules, np.array([[1.0, 0.0, 0.0]])
    )
    return TSRequest(
        model=model,
        disturbance=[CLEAN],
        process_noise=[1e-3] * 3,
        measurement_std=[0.1],
        rate=200.0,
        initial_std=[10.0] * 3,
    )


@pytest.mark.parametrize(
    ("request_", "expected"),
    [
        pytest.param(of(("motor_angle", BIAS), ("link_angle", BIAS), link=BIAS),
         ["kind gauss_markov for the torque at the link", "kind clean for motor_angle",
          "kind clean for link_angle", "kind clean for the torque at the link"],
         id="two encoders", marks=SLOW),
        pytest.param(of(("link_velocity", CLEAN), x_max=2.0),
         ["a smaller domain: x_max below 1.571 rad", "a further output without disturbance: link_"],
         id="velocity"),
        pytest.param(ArmRequest(disturbance=tone(1.4)),
         ["x_max below 0.5722 rad", "motor_ang"],
         id="tone", marks=SLOW),
        pytest.param(ArmRequest(disturbance=(*BIAS, *BIAS)), ["kind gauss_markov"],
         id="two biases", marks=SLOW),
        pytest.param(of(("motor_angle", CLEAN), ("link_angle", (DisturbanceTerm("arbitrary"),))),
         ["a model of the disturbance"], id="arbitrary"),
        pytest.param(ArmRequest(arm=NO_GRAVITY),
         ["kind gauss_markov for link_angle", "kind clean for link_angle", "disturbance: motor"],
         id="no gravity"),
        pytest.param(ArmRequest(arm=NO_GRAVITY, disturbance=CLEAN, torque=TorquePath(delay=0.05),
                                decay_rate=50.0),
         ["a smaller decay_rate: 0 1/s"], id="decay without gravity"),
        pytest.param(ArmRequest(torque=TorquePath(delay=0.05), decay_rate=50.0),
         ["a smaller decay_rate: 0 1/s"],
         id="decay, and a delay too long for faster rates", marks=SLOW),
        pytest.param(lorenz(), ["a faster rate: ", "a smaller domain: rules 75 % as far"],
         id="Lorenz", marks=SLOW),
    ],
)  # fmt: skip
def test_every_remedy_that_is_suggested_has_a_design(
    request_: ArmRequest | TSRequest, expected: list[str]
) -> None:
    with pytest.raises(DesignError) as caught:
        synthesise(request_)
    text = str(caught.value)
    for part in expected:
        assert part in text
    assert caught.value.remedies
    for remedy in caught.value.remedies:
        assert remedy.text in text
        assert synthesise(remedy.request).certificate.holds


FOUR = ("stiffness", "link_damping", "motor_damping", "link_inverse_inertia")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: of(("elbow", CLEAN)), r"outputs\[0\]: expected one of link_angle, .*got 'elbow'"),
        (lambda: of(("link_angle", BIAS), motor=tone(629.0)), "half the.* 628.*, got 629"),
        (lambda: of(("link_angle", BIAS), disturbance=BIAS), "^disturbance: expected in outputs,"),
        (
            lambda: ArmRequest(certify_uncertainty=True, uncertainty=dict.fromkeys(FOUR, 0.1)),
            "expected at most 3 uncertain parameters beside gravity",
        ),
        (lambda: ArmRequest(uncertainty={}, certify_uncertainty=True), "at least one uncertain"),
        (lambda: Output("link_angle", 1e200), "expected a number with a finite square"),
    ],
)
def test_a_wrong_request_is_named(make: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()


def test_matrices_that_are_stable_alone_but_not_together_are_refuted_by_a_dual() -> None:
    A = np.array([[[-0.1, 1.0], [-10.0, -0.1]], [[-0.1, 10.0], [-1.0, -0.1]]])
    margin, P, Z = common_lyapunov(A)

    assert P is None
    # Farkas' certificate: with it, no P ≻ 0 has AᵢᵀP + PAᵢ ≺ 0 for all i.
    assert np.linalg.eigvalsh(Z).min() > -1e-12
    assert np.trace(Z, axis1=1, axis2=2).sum() == pytest.approx(1.0)
    assert refutation_margin(A, Z) == margin > -1e-6
