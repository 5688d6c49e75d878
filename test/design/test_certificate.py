# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certificate: true where it claims to be, checked again from the physics, and tamper-proof."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from tsobs_ros.design.certificate import CertificateReport, Inequality, check_certificate
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.errors import CertificateError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=100)
SLOPES = (math.cos(0.75), 1.0)


class Loop:
    """Error systems of a design's closed loop, written out from the physics of the arm alone."""

    def __init__(self, design: Design) -> None:
        request = design.request
        arm, model = request.arm, request.disturbance_model
        n, self.period = 4 + model.state_count, 1.0 / request.rate
        j1, j2, k = arm.link_inertia, arm.motor_inertia, arm.stiffness
        drift = np.zeros((n, n))
        drift[:4, :4] = [
            [0.0, 1.0, 0.0, 0.0],
            [-k / j1, -arm.link_damping / j1, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
            [k**2 / (j1 * j2), 0.0, -k / j2, -arm.motor_damping / j2],
        ]
        drift[4:, 4:] = model.S
        motor = request.process_noise.motor * (k / j1) ** 2
        driven = [np.diag([0.0, request.process_noise.link, 0.0, motor]), model.G @ model.G.T]
        van_loan = expm(
            np.block([[-drift, block_diag(*driven)], [np.zeros((n, n)), drift.T]]) * self.period
        )
        self.phi = van_loan[n:, n:].T
        self.noise = self.phi @ van_loan[:n, n:]
        self.half_kick = 0.5 * self.period * arm.gravity_torque / j1
        self.C = np.hstack([[[1.0, 0.0, 0.0, 0.0]], model.H])
        self.R = np.array([[request.measurement_std**2]])
        self.K, self.P = design.K, design.P
        self.X = np.linalg.inv(design.P)
        # X = T Tᵀ: in the coordinates T⁻¹e the bound is the identity and eigenvalues are relative.
        self.T = np.linalg.cholesky(self.X)

    def kick(self, slope: float) -> Array:
        matrix = np.eye(len(self.phi))
        matrix[1, 0] = -self.half_kick * slope
        return matrix

    def step(self, first: float, second: float) -> tuple[Array, Array]:
        """Return the error system and its noise between two slopes."""
        after = self.kick(second)
        return after @ self.phi @ self.kick(first), after @ self.noise @ after.T

    def next_bound(self, first: float, second: float) -> Array:
        """Return the covariance before the next sample when it was X before this one."""
        transition, noise = self.step(first, second)
        closed = np.eye(len(self.K)) - self.K @ self.C
        posterior = closed @ self.X @ closed.T + self.K @ self.R @ self.K.T
        return np.asarray(transition @ posterior @ transition.T + noise)

    def smallest(self, matrix: Array) -> float:
        """Return the smallest eigenvalue of a form in e, relative to the bound's."""
        return float(np.linalg.eigvalsh(self.T.T @ matrix @ self.T)[0])


@pytest.fixture(scope="module")
def loop(shipped: Design) -> Loop:
    return Loop(shipped)


@pytest.fixture(scope="module")
def decaying() -> Design:
    """A design with a certified decay rate."""
    return synthesise(ArmRequest(decay_rate=0.1))


@pytest.fixture(scope="module")
def full_turn() -> Design:
    """A design for a clean sensor and every angle."""
    return synthesise(ArmRequest(disturbance=(DisturbanceTerm("clean"),), x_max=math.pi))


def test_the_shipped_design_holds_with_its_margin(shipped: Design) -> None:
    report = shipped.certificate
    assert report.holds
    report.require("the shipped design")
    assert [inequality.name for inequality in report.inequalities] == [
        "P symmetric and positive definite", *["covariance decrease"] * 4
    ]  # fmt: skip
    places = {inequality.where for inequality in report.inequalities[1:]}
    ends = ("0.7317", "1")
    assert places == {f"slopes ({first}, {second})" for first in ends for second in ends}
    # The margin that was asked of the solver: 1e-4 of the bound per second.
    margins = [inequality.margin for inequality in report.inequalities[1:]]
    assert min(margins) == report.worst.margin
    assert all(0.9e-4 < margin < 1.1e-4 for margin in margins)
    assert 0.0 < report.contraction_rate < 1.0


def test_the_checked_margins_are_those_of_an_independent_calculation(
    shipped: Design, loop: Loop
) -> None:
    inverse = np.linalg.inv(loop.T)
    for inequality in shipped.certificate.inequalities[1:]:
        ends = dict(zip(("0.7317", "1"), SLOPES, strict=True))
        first, second = inequality.where.removeprefix("slopes (").removesuffix(")").split(", ")
        decrease = loop.X - loop.next_bound(ends[first], ends[second])
        margin = np.linalg.eigvalsh(inverse @ decrease @ inverse.T)[0] / loop.period
        assert inequality.margin == pytest.approx(margin, rel=1e-4)


@pytest.mark.parametrize("which", ["shipped", "decaying", "full_turn"])
def test_the_linear_matrix_inequality_holds_for_the_returned_matrix(
    which: str, request: pytest.FixtureRequest
) -> None:
    """The delta form with the gain eliminated, as a block matrix, at every vertex."""
    design: Design = request.getfixturevalue(which)
    loop = Loop(design)
    n, T, P = len(loop.P), loop.period, loop.P
    decay = math.exp(-2.0 * design.request.decay_rate * T)
    information = loop.C.T @ loop.C / (loop.R[0, 0] * T)
    lowest = math.cos(design.request.x_max)
    for slopes in ((lowest, lowest), (lowest, 1.0), (1.0, lowest), (1.0, 1.0)):
        transition, noise = loop.step(*slopes)
        delta, G = (transition - np.eye(n)) / T, np.linalg.cholesky(noise / T)
        corner = (decay - 1.0) / T * P - P @ delta - delta.T @ P + information
        cross = math.sqrt(T) * (P @ delta - information)
        block = np.block(
            [
                [corner, cross, P @ G],
                [cross.T, P + T * information, np.zeros((n, n))],
                [(P @ G).T, np.zeros((n, n)), np.eye(n)],
            ]
        )
        scaling = block_diag(loop.T, loop.T, np.eye(n))
        # Its size there is of order one, so a positive eigenvalue far above rounding is a proof.
        assert np.linalg.eigvalsh(scaling.T @ block @ scaling)[0] > 1e-6


def test_the_gain_is_the_kalman_gain_of_the_bound(shipped: Design, loop: Loop) -> None:
    spread = loop.C @ loop.X @ loop.C.T + loop.R
    np.testing.assert_allclose(shipped.K, loop.X @ loop.C.T / spread, rtol=1e-9)


@PROPERTY
@given(first=st.floats(*SLOPES), second=st.floats(*SLOPES))
def test_the_bound_decreases_between_the_vertices_too(
    loop: Loop, first: float, second: float
) -> None:
    inverse = np.linalg.inv(loop.T)
    decrease = inverse @ (loop.X - loop.next_bound(first, second)) @ inverse.T
    assert np.linalg.eigvalsh(decrease)[0] > 0.9e-4 * loop.period


@PROPERTY
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.0, 1.0))
def test_the_bound_is_matrix_convex_in_each_slope(
    loop: Loop, one: float, other: float, fixed: float, share: float
) -> None:
    """Why four vertices cover the square: the closed-loop covariance lies below its chords."""
    middle = share * one + (1.0 - share) * other
    for pair in (lambda slope: (slope, fixed), lambda slope: (fixed, slope)):
        chord = share * loop.next_bound(*pair(one)) + (1.0 - share) * loop.next_bound(*pair(other))
        gap = chord - loop.next_bound(*pair(middle))
        inverse = np.linalg.inv(loop.T)
        assert np.linalg.eigvalsh(inverse @ gap @ inverse.T)[0] > -1e-12


@settings(PROPERTY, max_examples=60)
@given(
    states=hnp.arrays(np.float64, (2, 5), elements=st.floats(-1.0, 1.0)),
    torque=st.floats(-3.0, 3.0),
)
def test_errors_of_the_nonlinear_loop_shrink_at_the_certified_rate(
    decaying: Design, states: Array, torque: float
) -> None:
    """eᵀPe falls by e^{−2ρT} a step for any two trajectories that stay in the domain."""
    flow, rho, T = decaying.request.flow, decaying.request.decay_rate, decaying.request.period
    truth, estimate = states * [0.7, 2.0, 8.0, 20.0, 0.3]
    u, C = np.array([torque]), flow.output_matrix
    ahead = flow.predict(truth, u, T)
    corrected = estimate + decaying.K[:, 0] * float((C @ (truth - estimate))[0])
    # The premise of the first kick is the corrected estimate, that of the second the predicted.
    predicted = flow.predict(corrected, u, T)
    assume(max(abs(corrected[0]), abs(ahead[0]), abs(predicted[0])) <= 0.75)
    before, after = truth - estimate, ahead - predicted
    size = float(before @ decaying.P @ before)
    assert after @ decaying.P @ after <= math.exp(-2.0 * rho * T) * size * (1.0 + 1e-9) + 1e-12


def test_the_certified_rate_is_reported_and_reached(decaying: Design, shipped: Design) -> None:
    assert decaying.certificate.contraction_rate >= 0.1
    assert shipped.certificate.contraction_rate < 0.1
    # Stricter decay costs accuracy.
    assert (decaying.bound_std > shipped.bound_std).all()


def test_the_contraction_rate_is_the_slowest_vertexs(decaying: Design) -> None:
    loop = Loop(decaying)
    inverse = np.linalg.inv(loop.T)
    closed = np.eye(5) - loop.K @ loop.C
    growth = max(
        np.linalg.norm(inverse @ loop.step(first, second)[0] @ closed @ loop.T, 2)
        for first in SLOPES
        for second in SLOPES
    )
    rate = -math.log(growth) / loop.period
    assert decaying.certificate.contraction_rate == pytest.approx(rate, rel=1e-6)


def perturbed(matrix: Array, place: tuple[int, int], value: float) -> Array:
    changed = matrix.copy()
    changed[place] = value
    return changed


@pytest.mark.parametrize("index", range(5))
@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_changed_gain_does_not_hold(shipped: Design, index: int, factor: float) -> None:
    K = perturbed(shipped.K, (index, 0), factor * shipped.K[index, 0])
    report = check_certificate(shipped.request, shipped.P, K)
    assert not report.holds
    assert report.worst.name == "covariance decrease"
    assert report.worst.margin < 0.0


@pytest.mark.parametrize("factor", [1.001, 1.1, 1e3])
def test_a_smaller_bound_than_the_noise_allows_does_not_hold(
    shipped: Design, factor: float
) -> None:
    report = check_certificate(shipped.request, factor * shipped.P, shipped.K)
    assert not report.holds
    # The contraction does not depend on the size of P, only the noise's share does.
    assert report.contraction_rate == pytest.approx(shipped.certificate.contraction_rate, rel=1e-6)


@pytest.mark.parametrize("factor", [0.1, 0.9])
def test_a_larger_bound_holds_as_well(shipped: Design, factor: float) -> None:
    assert check_certificate(shipped.request, factor * shipped.P, shipped.K).holds


@pytest.mark.parametrize(
    "tampered",
    [
        lambda P: perturbed(P, (4, 4), 0.0),
        lambda P: perturbed(P, (0, 0), math.inf),
        lambda P: perturbed(P, (0, 0), math.nan),
        lambda P: perturbed(P, (2, 3), math.nan),
        lambda P: perturbed(P, (0, 1), P[0, 1] * (1.0 + 1e-12)),
        lambda P: perturbed(P, (0, 0), -P[0, 0]),
        lambda P: -P,
        lambda P: 0.0 * P,
        lambda P: np.ones_like(P),
    ],
    ids=[
        "zero",
        "infinite",
        "nan",
        "nan beside",
        "unsymmetric",
        "indefinite",
        "negative",
        "null",
        "singular",
    ],
)  # fmt: skip
def test_a_matrix_that_is_no_bound_is_named(
    shipped: Design, tampered: Callable[[Array], Array]
) -> None:
    report = check_certificate(shipped.request, tampered(shipped.P), shipped.K)
    assert not report.holds
    assert report.worst.name == "P symmetric and positive definite"
    assert math.isnan(report.contraction_rate)
    with pytest.raises(CertificateError, match="P symmetric and positive definite: DOES NOT HOLD"):
        report.require("a file")


@pytest.mark.parametrize(
    "change",
    [
        {"x_max": 0.76},
        {"x_max": math.pi},
        {"rate": 195.0},
        {"measurement_std": 0.03},
        {"decay_rate": 0.05},
        {"process_noise": ProcessNoise(1.1e-4, 1e-5)},
        {"process_noise": ProcessNoise(1e-4, 1.1e-5)},
        {"disturbance": (DisturbanceTerm("bias", {"density": 1.1e-4}),)},
        {"arm": ElasticJointArm(stiffness=10.5)},
        {"arm": ElasticJointArm(gravity_torque=12.0)},
    ],
    ids=str,
)
def test_the_proof_of_one_problem_is_none_of_a_harder_one(
    shipped: Design, change: dict[str, Any]
) -> None:
    request = replace(shipped.request, **change)
    assert not check_certificate(request, shipped.P, shipped.K).holds


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e200, 1e308])
def test_a_gain_beyond_numbers_is_a_failed_certificate(shipped: Design, value: float) -> None:
    report = check_certificate(shipped.request, shipped.P, np.full((5, 1), value))
    assert not report.holds
    assert report.worst.name == "covariance decrease"


@pytest.mark.parametrize("damping", [0.0, 1.0])
def test_no_certificate_holds_for_an_arbitrary_disturbance(damping: float) -> None:
    arm = ElasticJointArm(link_damping=damping, motor_damping=damping)
    design = synthesise(ArmRequest(arm=arm, disturbance=(DisturbanceTerm("clean"),)))
    for terms in (("arbitrary",), ("clean", "arbitrary")):
        request = replace(design.request, disturbance=[DisturbanceTerm(kind) for kind in terms])
        report = check_certificate(request, design.P, design.K)
        assert not report.holds
        assert report.worst.name == "disturbance has a model"


def test_what_rounding_may_add_is_far_below_the_margin_at_any_rate() -> None:
    """The allowance is per step, so it grows with the rate; a fixed one would not."""
    for rate in (25.0, 1000.0):
        design = synthesise(ArmRequest(rate=rate))
        (required,) = {each.required for each in design.certificate.inequalities[1:]}
        assert required < 1e-4 * design.certificate.worst.margin
        condition = np.linalg.cond(design.P / np.sqrt(np.outer(*[np.diag(design.P)] * 2)))
        assert required * design.request.period > 1e-15 * condition


def test_the_worst_margin_is_the_one_nearest_to_what_it_requires() -> None:
    """Per second and unitless margins are compared by their ratio to what is required."""
    near, far = Inequality("near", "", 1e-3, 1e-4), Inequality("far", "", 1e-5, 1e-12)
    assert CertificateReport((far, near), 0.0).worst is near


def test_a_failure_names_source_inequality_vertex_and_margin(shipped: Design) -> None:
    request = replace(shipped.request, x_max=0.8)
    report = check_certificate(request, shipped.P, shipped.K)
    failing = [inequality for inequality in report.inequalities if not inequality.holds]
    assert {inequality.where for inequality in failing} <= {
        "slopes (0.6967, 0.6967)", "slopes (0.6967, 1)", "slopes (1, 0.6967)"
    }  # fmt: skip
    pattern = (
        r"my\.yaml: the certificate does not hold: covariance decrease at slopes "
        r"\(0\.6967, 0\.6967\): DOES NOT HOLD, margin -\d\.\d{3}e-\d\d \(> 7e-10\)"
    )
    with pytest.raises(CertificateError, match=pattern) as caught:
        report.require("my.yaml")
    assert str(caught.value).count("DOES NOT HOLD") == len(failing) > 0


def test_nan_is_not_a_margin() -> None:
    report = CertificateReport((Inequality("x", "", math.nan, 0.0),), math.nan)
    assert not report.holds
    assert report.worst.name == "x"
