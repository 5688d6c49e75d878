# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certificate: true where it claims to be, checked again from the physics, and tamper-proof."""

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from tsobs_ros.design.certificate import check_certificate
from tsobs_ros.design.exact import verify_exactly
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, TSRequest
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.errors import CertificateError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import SINE, arm_uncertainty

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=15)
SLOPES = (math.cos(0.75), 1.0)
REQUESTS = {
    "decaying": ArmRequest(decay_rate=0.1),
    "several": ArmRequest(
        uncertainty={"gravity": 0.05, "stiffness": 0.1}, certify_uncertainty=True
    ),
}


def covered(request: ArmRequest) -> Mapping[str, float]:
    """Return the bounds of the parameters that the certificate is about."""
    return request.uncertainty if request.certify_uncertainty else {}


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
        self.half, self.gravity = 0.5 * self.period, arm.gravity_torque / j1
        self.directions = arm_uncertainty(arm, covered(request)).directions[:, 0]
        self.C = np.hstack([[[1.0, 0.0, 0.0, 0.0]], model.H])
        self.R = np.array([[request.measurement_std**2]])
        self.K, self.P = design.K, design.P
        self.X = np.linalg.inv(design.P)
        # X = T Tᵀ: in the coordinates T⁻¹e the bound is the identity and eigenvalues are relative.
        self.T = np.linalg.cholesky(self.X)

    def kick(self, slope: float, theta: Any = 0.0) -> Array:
        """Return the Jacobian of half a kick, from the derivative of the accelerations."""
        change = (self.directions * np.reshape(theta, (-1, 1, 1))).sum(axis=0)
        matrix = np.eye(len(self.phi))
        matrix[1, 0] = -self.half * self.gravity * slope
        if len(self.directions):
            matrix[:4, :4] += self.half * change[:, :4]
            matrix[:4, 0] += self.half * change[:, SINE] * slope
        return matrix

    def step(self, first: Array, second: Array) -> tuple[Array, Array]:
        """Return the error system and its noise between two kicks."""
        return second @ self.phi @ first, second @ self.noise @ second.T

    def next_bound(self, first: Array, second: Array) -> Array:
        """Return the covariance before the next sample if it was X before this one."""
        transition, noise = self.step(first, second)
        closed = np.eye(len(self.K)) - self.K @ self.C
        posterior = closed @ self.X @ closed.T + self.K @ self.R @ self.K.T
        return np.asarray(transition @ posterior @ transition.T + noise)

    def margin(self, first: Array, second: Array, decay_rate: float = 0.0) -> float:
        """Return the smallest eigenvalue of λ²X less the next bound, relative to X, per second."""
        kept = math.exp(-2.0 * decay_rate * self.period)
        return self.smallest(kept * self.X - self.next_bound(first, second)) / self.period

    def smallest(self, matrix: Array) -> float:
        """Return the smallest eigenvalue of a covariance relative to the bound."""
        inverse = np.linalg.inv(self.T)
        return float(np.linalg.eigvalsh(inverse @ matrix @ inverse.T)[0])


@pytest.fixture(scope="module")
def designs(shipped: Design) -> Mapping[str, Design]:
    made = {name: synthesise(request) for name, request in REQUESTS.items()}
    return {"shipped": shipped, **made}


@pytest.fixture(scope="module")
def decaying(designs: Mapping[str, Design]) -> Design:
    """A design with a certified decay rate."""
    return designs["decaying"]


def test_the_shipped_design_holds_with_its_margin(shipped: Design) -> None:
    report = shipped.certificate
    assert report.holds
    report.require("the shipped design")
    names = [inequality.name for inequality in report.inequalities]
    assert names == ["P symmetric and positive definite", *["covariance decrease"] * 4]
    places = {inequality.where for inequality in report.inequalities[1:]}
    assert places == {f"slopes ({a}, {b})" for a, b in product(("0.7317", "1"), repeat=2)}
    # The margin that was asked of the solver: 1e-4 of the bound per second.
    margins = [inequality.margin for inequality in report.inequalities[1:]]
    assert min(margins) == report.worst.margin
    assert all(0.9e-4 < margin < 1.1e-4 for margin in margins)
    assert 0.0 < report.contraction_rate < 1.0


@pytest.mark.parametrize("name", ["shipped", *REQUESTS])
def test_the_margins_are_those_of_an_independent_calculation(
    designs: Mapping[str, Design], name: str
) -> None:
    """The smallest margin of the report is that of a corner of slopes and parameters."""
    design = designs[name]
    loop, request = Loop(design), design.request
    limits = list(covered(request).values())
    corners = product(request.slope_range, product((-1.0, 1.0), repeat=len(limits)))
    kicks = [loop.kick(slope, np.array(signs) * limits) for slope, signs in corners]
    smallest = min(loop.margin(*pair, request.decay_rate) for pair in product(kicks, repeat=2))
    margins = [each.margin for each in design.certificate.inequalities[1:]]
    assert min(margins) == pytest.approx(smallest, rel=1e-4)


@PROPERTY
@given(st.data(), st.sampled_from(["shipped", "several"]), st.floats(0.01, 1.0))
def test_the_bound_holds_between_the_vertices_and_late_samples_widen_it_by_their_factor(
    designs: Mapping[str, Design], data: st.DataObject, name: str, share: float
) -> None:
    """For every slope and parameter, which may even differ between the two half kicks."""
    design = designs[name]
    request = design.arm_request
    late = replace(request, rate=request.rate / share)
    corners = [
        (
            data.draw(st.floats(*request.slope_range)),
            [data.draw(st.floats(-bound, bound)) for bound in covered(request).values()],
        )
        for _ in range(2)
    ]
    loop = Loop(design)
    assert loop.margin(*(loop.kick(*each) for each in corners)) > 0.5e-4
    loop = Loop(replace(design, request=late))
    transition, noise = loop.step(*(loop.kick(*each) for each in corners))
    later = transition @ loop.X @ transition.T + noise
    assert loop.smallest(design.late_factor**2 * loop.X - later) > 0.0
    assert 1.0 < design.late_factor < 1.1


@settings(PROPERTY, max_examples=30)
@given(
    states=hnp.arrays(np.float64, (2, 5), elements=st.floats(-1.0, 1.0)),
    torque=st.floats(-3.0, 3.0),
)
def test_errors_of_the_nonlinear_loop_shrink_at_the_certified_rate(
    decaying: Design, predicted: Any, states: Array, torque: float
) -> None:
    """eᵀPe falls by e^{−2ρT} a step for any two trajectories that stay in the domain."""
    flow, rho, T = decaying.request.flow, decaying.request.decay_rate, decaying.request.period
    truth, estimate = states * [0.7, 2.0, 8.0, 20.0, 0.3]
    u, C = np.array([torque]), flow.output_matrix
    ahead = predicted(flow, truth, u, T)
    corrected = estimate + decaying.K[:, 0] * float((C @ (truth - estimate))[0])
    # The premise of the first kick is the corrected estimate, that of the second the predicted.
    later = predicted(flow, corrected, u, T)
    assume(max(abs(corrected[0]), abs(ahead[0]), abs(later[0])) <= 0.75)
    before, after = truth - estimate, ahead - later
    size = float(before @ decaying.P @ before)
    assert after @ decaying.P @ after <= math.exp(-2.0 * rho * T) * size * (1.0 + 1e-9) + 1e-12


def test_the_certified_rate_is_the_slowest_vertexs(decaying: Design, shipped: Design) -> None:
    loop = Loop(decaying)
    closed = np.linalg.inv(loop.T), (np.eye(5) - loop.K @ loop.C) @ loop.T
    growth = max(
        np.linalg.norm(closed[0] @ loop.step(*map(loop.kick, slopes))[0] @ closed[1], 2)
        for slopes in product(SLOPES, repeat=2)
    )
    rate = -math.log(growth) / loop.period
    assert decaying.certificate.contraction_rate == pytest.approx(rate, rel=1e-6)
    assert rate >= 0.1 > shipped.certificate.contraction_rate
    # Stricter decay costs accuracy.
    assert (decaying.bound_std > shipped.bound_std).all()


@pytest.mark.parametrize(
    ("place", "value"),
    [((4, 4), 0.0), ((2, 3), math.nan), ((0, 1), 1.0), ((0, 0), -1.0), (..., 1.0)],
    ids=["zero", "nan", "unsymmetric", "indefinite", "singular"],
)
def test_a_matrix_that_is_no_bound_is_named(shipped: Design, place: Any, value: float) -> None:
    tampered = shipped.P.copy()
    tampered[place] = value
    report = check_certificate(shipped.request, tampered, shipped.K)
    assert report.worst.name == "P symmetric and positive definite"
    assert math.isnan(report.contraction_rate)
    with pytest.raises(CertificateError, match="P symmetric and positive definite: DOES NOT HOLD"):
        report.require("a file")


@pytest.mark.parametrize(
    "change",
    [
        {"x_max": 0.76},
        {"certify_uncertainty": True, "uncertainty": {"stiffness": 0.05}},
        {"measurement_std": 0.03},
        {"decay_rate": 0.05},
        {"process_noise": ProcessNoise(1.1e-4, 1e-5)},
        {"disturbance": (DisturbanceTerm("bias", {"density": 1.1e-4}),)},
        {"arm": ElasticJointArm(gravity_torque=12.0)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_the_proof_of_one_problem_is_none_of_a_harder_one(
    shipped: Design, change: dict[str, Any]
) -> None:
    request = replace(shipped.request, **change)
    assert not check_certificate(request, shipped.P, shipped.K).holds
    report = check_certificate(shipped.request, shipped.P, 0.7 * shipped.K)
    assert not report.holds
    assert report.worst.name == "covariance decrease"


def test_no_certificate_holds_for_an_arbitrary_disturbance() -> None:
    design = synthesise(ArmRequest(disturbance=(DisturbanceTerm("clean"),)))
    for terms in (("arbitrary",), ("clean", "arbitrary")):
        request = replace(design.request, disturbance=[DisturbanceTerm(kind) for kind in terms])
        changed = replace(design, request=request)
        for report in (changed.certificate, verify_exactly(changed)):
            assert not report.holds
            assert report.worst.name == "disturbance has a model"


def test_what_was_certified_cannot_be_changed_afterwards(shipped: Design) -> None:
    bounds, densities, mixing = {"stiffness": 0.1}, [1e-3], np.ones((1, 1))
    arm = ArmRequest(uncertainty=bounds)
    rules = RuleBase(((membership("always", {}),),))
    model = TSModel(-np.ones((1, 1, 1)), np.ones((1, 1)), np.eye(1), rules, np.ones((1, 1)))
    system = TSRequest(model, densities, [0.1], 10.0, [1.0], D_s=mixing)
    bounds["stiffness"], densities[0], mixing[0, 0] = 0.4, 1.0, 9.0
    assert (arm.uncertainty["stiffness"], arm.uncertainty_model.bounds["stiffness"]) == (0.1, 0.1)
    assert (system.process_noise[0], system.D_s[0, 0]) == (1e-3, 1.0)
    for mapping in (arm.uncertainty, arm.disturbance[0]):
        with pytest.raises(TypeError, match="item assignment"):
            mapping["density"] = 1.0
    arrays = [shipped.P, shipped.K, shipped.covariance_bound, arm.measurement_covariance]
    arrays += [arm.initial_covariance, system.process_noise, system.D_s, system.initial_std]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


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


def test_the_proof_of_one_uncertainty_is_none_of_a_larger_one(
    designs: Mapping[str, Design],
) -> None:
    design = designs["several"]
    request = replace(design.request, uncertainty={"gravity": 0.05, "stiffness": 0.11})
    report = check_certificate(request, design.P, design.K)
    assert not report.holds
    assert "stiffness (" in report.worst.where
    # Bounds alone ask for no proof.
    silent = replace(request, certify_uncertainty=False)
    assert check_certificate(silent, design.P, design.K).holds
