# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certificate: true where it claims to be, as errors of many runs show, and tamper-proof."""

import math
from dataclasses import replace
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.linalg import expm

from tsobs_ros.design.certificate import check_certificate
from tsobs_ros.design.exact import cosine_below, decay_below, exponential, rational, verify_exactly
from tsobs_ros.design.record import Design, SolverReport
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TorqueDisturbance
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.errors import CertificateError, ModelError
from tsobs_ros.estimation.records import Basis
from tsobs_ros.estimation.state import likeliest
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.plant import Plant, Scenario, SimulatedOutput
from tsobs_ros.simulation.plant import TorqueDisturbance as TrueTorques
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import GaussMarkov, Sine

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def uncertain() -> Design:
    bounds = {"gravity": 0.05, "stiffness": 0.1}
    return synthesise(ArmRequest(uncertainty=bounds, certify_uncertainty=True))


def test_the_shipped_design_holds_with_its_margin(design: Design) -> None:
    report = design.certificate
    assert report.holds
    report.require("the shipped design")
    names = [inequality.name for inequality in report.inequalities]
    assert names == ["P symmetric and positive definite", *["covariance decrease"] * 4]
    places = [inequality.where for inequality in report.inequalities[1:]]
    assert places == [f"slopes ({a}, {b})" for a, b in product(("0.7317", "1"), repeat=2)]
    # The margin that was asked of the solver: 1e-4 of the bound per second.
    margins = [inequality.margin for inequality in report.inequalities[1:]]
    assert min(margins) == report.worst.margin
    assert all(0.9e-4 < margin < 1.1e-4 for margin in margins)
    assert 0.0 < report.contraction_rate < 1.0


BIAS = DisturbanceTerm("bias")
CONTACT = DisturbanceTerm("gauss_markov", {"std": 2.0, "time_constant": 0.5})
REQUESTS = {
    "shipped": ArmRequest(),
    "stiff with a tone": ArmRequest(
        decay_rate=0.05,
        arm=ElasticJointArm(0.05, 0.005, 200.0, 2.0, 0.01, 0.01),
        disturbance=(BIAS, DisturbanceTerm("sinusoid", {"frequency": 3.0})),
    ),
    "a late encoder and a contact": ArmRequest(
        outputs=(Output("motor_angle", 0.001, delay=0.004), Output("link_angle", 0.01, (BIAS,))),
        torque_disturbance=TorqueDisturbance((), (CONTACT,)),
    ),
    "uncertain": ArmRequest(uncertainty={"gravity": 0.05}, certify_uncertainty=True),
    "no gravity": ArmRequest(
        arm=ElasticJointArm(gravity_torque=0.0),
        outputs=(Output("motor_velocity", 0.01), Output("motor_angle", 0.001)),
        torque_disturbance=TorqueDisturbance((CONTACT,)),
        uncertainty={"motor_inverse_inertia": 0.1},
        certify_uncertainty=True,
    ),
}


@pytest.mark.parametrize("name", REQUESTS)
def test_designs_of_every_sort_are_proved_exactly_with_their_margins(name: str) -> None:
    design = synthesise(REQUESTS[name])
    report = verify_exactly(design)
    assert report.holds
    assert report.worst in report.inequalities
    for exact, rounded in zip(report.inequalities, design.certificate.inequalities, strict=True):
        assert (exact.name, exact.where) == (rounded.name, rounded.where)
        assert exact.margin == pytest.approx(rounded.margin, rel=2e-3)
    summary = design.summary()
    assert (summary["holds"], summary["rate"]) == (True, design.request.rate)
    assert all(text in design.text() for text in ("the certificate holds", design.request.headline))


def test_a_late_sample_widens_the_bound_by_no_more_than_its_factor(uncertain: Design) -> None:
    X, root = uncertain.covariance_bound, np.linalg.cholesky(uncertain.P)
    assert 1.0 < uncertain.late_factor < 1.1
    for share in (0.03, 0.4, 0.6, 0.9, 1.0):
        for vertex in uncertain.request.at_rate(uncertain.request.rate / share).vertices():
            later = vertex.transition @ X @ vertex.transition.T + vertex.noise
            rest = uncertain.late_factor**2 * X - later
            assert np.linalg.eigvalsh(root.T @ rest @ root)[0] > 0.0


@pytest.mark.parametrize(
    ("place", "value"),
    [((4, 4), 0.0), ((2, 3), math.nan), ((0, 1), 1.0), ((0, 0), -1.0), (..., 1.0)],
    ids=["zero", "nan", "unsymmetric", "indefinite", "singular"],
)
def test_a_matrix_that_is_no_bound_is_named(design: Design, place: Any, value: float) -> None:
    tampered = design.P.copy()
    tampered[place] = value
    report = check_certificate(design.request, tampered, design.K)
    assert report.worst.name == "P symmetric and positive definite"
    assert math.isnan(report.contraction_rate)
    with pytest.raises(CertificateError, match="P symmetric and positive definite: DOES NOT HOLD"):
        report.require("a file")
    if not math.isnan(value):
        assert not verify_exactly(replace(design, P=tampered)).holds


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
        {"K": 0.7},
        {"K": 1e200},
    ],
    ids=lambda change: next(iter(change)),
)
def test_the_proof_of_one_problem_is_none_of_a_harder_one(
    design: Design, change: dict[str, Any]
) -> None:
    gain = change.pop("K", 1.0) * design.K
    harder = replace(design, request=replace(design.request, **change), K=gain)
    for report in (harder.certificate, verify_exactly(harder)):
        assert not report.holds
        assert report.worst.name == "covariance decrease"


def test_there_is_no_design_for_an_arbitrary_disturbance() -> None:
    design = synthesise(ArmRequest(disturbance=(DisturbanceTerm("clean"),)))
    for terms in (("arbitrary",), ("clean", "arbitrary")):
        request = replace(design.request, disturbance=[DisturbanceTerm(kind) for kind in terms])
        with pytest.raises(ModelError, match="disturbance: expected one with a model"):
            replace(design, request=request)


def test_what_was_certified_cannot_be_changed_afterwards(design: Design) -> None:
    bounds = {"stiffness": 0.1}
    arm = ArmRequest(uncertainty=bounds)
    bounds["stiffness"] = 0.4
    assert (arm.uncertainty["stiffness"], arm.uncertainty_model.limits.tolist()) == (0.1, [0.1])
    for mapping in (arm.uncertainty, arm.disturbance[0]):
        with pytest.raises(TypeError, match="item assignment"):
            mapping["density"] = 1.0
    for array in (design.P, design.K, design.covariance_bound, arm.initial_covariance):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


MATRICES = hnp.arrays(np.float64, (3, 3), elements=st.floats(-3.0, 3.0, allow_subnormal=False))


@settings(max_examples=4)
@given(MATRICES)
def test_a_matrix_exponential_is_enclosed(matrix: Array) -> None:
    enclosure = exponential(rational(matrix))
    assert enclosure.radius < Fraction(1, 10**60)
    scale = math.exp(float(np.abs(matrix).sum(axis=1).max()))
    np.testing.assert_allclose(enclosure.centre.astype(float), expm(matrix), atol=1e-13 * scale)
    # e^M e^M = e^{2M} to a hundred digits, not only to those of a float.
    doubled = exponential(rational(matrix) * 2)
    gap = np.abs(enclosure.centre @ enclosure.centre - doubled.centre).max()
    largest = np.abs(enclosure.centre).max() + enclosure.radius
    assert gap <= 2 * 3 * largest * enclosure.radius + doubled.radius


def test_cosine_and_decay_are_bounded_from_below_to_sixty_digits() -> None:
    pi = Fraction("3.14159265358979323846264338327950288419716939937510582097494459")
    assert abs(cosine_below(pi) + 1) < Fraction(1, 10**60)
    assert abs(cosine_below(pi / 3) - Fraction(1, 2)) < Fraction(1, 10**60)
    assert cosine_below(pi / 3 + Fraction(1, 10**50)) < Fraction(1, 2)
    for x in (0.0, 1e-9, 0.3, 40.0):
        lower = decay_below(Fraction(x))
        assert float(lower) == pytest.approx(math.exp(-x), rel=1e-14)
        assert lower * decay_below(Fraction(-x)) < 1


def test_a_matrix_singular_only_beyond_the_digits_of_floats_is_told_apart(design: Design) -> None:
    """[[1, a], [a, b]] with b the float next to a²: the sign of b − a² is below rounding."""
    a = 1.0 + 2.0**-27
    above = a * a
    assert Fraction(above) < Fraction(a) ** 2
    P = np.eye(5)
    P[:2, :2] = [[1.0, a], [a, above]]
    assert not verify_exactly(replace(design, P=P)).inequalities[0].holds
    P[1, 1] = np.nextafter(above, 2.0)
    first = verify_exactly(replace(design, P=P)).inequalities[0]
    assert first.holds
    assert not check_certificate(design.request, P, design.K).inequalities[0].holds


def test_a_model_too_fast_to_enclose_is_refused() -> None:
    arm = ElasticJointArm(link_damping=5e5)
    request = ArmRequest(arm=arm, disturbance=(DisturbanceTerm("clean"),))
    with pytest.raises(ModelError, match="the model is too fast for the period"):
        verify_exactly(Design(request, np.eye(4), np.zeros((4, 1)), SolverReport()))


RUNS, SAMPLES = 800, 600
WALK = 1e6
"""Time constant of a drift that is a random walk for the length of a run [s]."""


def test_the_covariance_of_the_errors_stays_below_the_bound_and_not_far() -> None:
    """Encoders on both sides, the link's biased, and an unknown torque at the link, for 3 s.

    The truth is the differential equation with random accelerations, not the prediction that the
    design was made with. The largest eigenvalue of X⁻¹cov(e) may exceed 1 only as far as sampling
    makes it: for `RUNS` normal samples of n numbers whose covariance is X itself, it tends to
    (1 + √(n/800))², 1.18 for n = 6, with a deviation of about 0.04.
    """
    drift = DisturbanceTerm("gauss_markov", {"std": 0.5, "time_constant": 0.5})
    bias = DisturbanceTerm("bias")
    asked = ArmRequest(
        outputs=[Output("motor_angle", 0.002), Output("link_angle", 0.01, [bias])],
        torque_disturbance=TorqueDisturbance(link=[drift]),
    )
    design, rng = synthesise(asked), np.random.default_rng(20260101)
    wander = GaussMarkov((0.5 * bias["density"] * WALK) ** 0.5, WALK)
    scenario = Scenario(
        rate=asked.rate,
        initial_state=(0.2, 0.0, 1.4, 0.0),
        initial_spread=(0.02, 0.02, 0.1, 0.1),
        process_noise=asked.process_noise,
        inputs=(Sine(0.8),),
        outputs=(
            SimulatedOutput("motor_angle", Sensor(0.002)),
            SimulatedOutput("link_angle", Sensor(0.01), (wander,)),
        ),
        torque_disturbance=TrueTorques(link=(GaussMarkov(0.5, 0.5),)),
    )
    runs = Plant(scenario, range(RUNS)).run(SAMPLES + 1)
    parts = [runs.states, runs.disturbances[..., 1:], runs.torque_disturbances[..., 1:]]
    truth, X = np.concatenate(parts, axis=2), design.covariance_bound
    observer, n = design.observer(), len(X)
    start, tracker = likeliest(observer.model["initial"]), Tracker(observer, max_steps=1)
    start["covariance"][:n, :n], start["settling"], start["certified"] = X, 0.0, 1
    away = rng.standard_normal((RUNS, n)) @ np.linalg.cholesky(X).T
    stamps, rows = 10**9 + np.round(1e9 * runs.times).astype(np.int64), []
    # A last sample that is lost leaves the estimate as it is just before it.
    y = runs.measurements.copy()
    y[:, -1] = np.nan
    for run in range(RUNS):
        start["x"][:n] = truth[run, 0] - away[run]
        tracker.reset()
        rows.append(tracker.follow(stamps, y[run], runs.torques[run]))
    known = np.stack(rows).view(np.recarray)
    assert (known.basis == Basis.CERTIFIED).all()
    assert max(np.abs(truth[..., 0]).max(), np.abs(known.state[..., 0]).max()) < asked.x_max
    estimate = asked.arm.from_physical(known.state[:, -1])
    found = [estimate, known.disturbance[:, -1, 1:], known.torque_disturbance[:, -1]]
    errors = truth[:, -1] - np.hstack(found)
    root, covariance = np.linalg.cholesky(design.P), errors.T @ errors / RUNS
    assert np.linalg.eigvalsh(root.T @ covariance @ root)[-1] < 1.27
    share = np.sqrt(np.diag(covariance) / np.diag(X))
    assert ((share > 0.4) & (share < 1.05)).all()
