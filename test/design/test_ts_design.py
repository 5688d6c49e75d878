# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Certified designs for T–S systems: known answers, what is covered, files, and refusals."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.design.exact import verify_exactly
from tsobs_ros.design.file import load_request
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import DisturbanceTerm, TSRequest
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.errors import DesignError, DetectabilityError, ModelError
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_model import Direction, TSFlow, TSModel
from tsobs_ros.resources import config_path

Array = NDArray[np.float64]

CLEAN = [DisturbanceTerm("clean")]
BIAS = [DisturbanceTerm("bias")]
RAMPS = RuleBase(
    (
        (membership("linear", {"zero": 1.0, "one": 0.0}),),
        (membership("linear", {"zero": 0.0, "one": 1.0}),),
    )
)


def blended(**changes: Any) -> TSRequest:
    """Two rules blended by a known signal, three states, two outputs."""
    A = [[0, 1, 0], [-4, -0.4, 1], [0, 0, -1]], [[0, 1, 0], [-9, -0.1, 0.5], [0.3, 0, -2]]
    rows = np.zeros((1, 3)), np.ones((1, 1))
    model = TSModel(np.array(A), np.eye(3)[:, 2:], np.eye(3)[[0, 2]], RAMPS, *rows)
    noise = [1e-4, 1e-2, 1e-2], [0.02, 0.05]
    request = TSRequest(model, *noise, 40.0, [1.0, 1.0, 1.0], disturbance=[BIAS, CLEAN])
    return replace(request, **changes)


@pytest.fixture(scope="module")
def example() -> Design:
    return synthesise(load_request(config_path("ts_example.request.yaml")))


@pytest.fixture(scope="module")
def known() -> Design:
    return synthesise(blended())


def deviation_jacobian(flow: TSFlow, x: Array, u: Array) -> Array:
    """Return the Jacobian of what the rules differ by from their mean, shape (n, n)."""
    n, model = flow.model.state_count, flow.model
    jacobian = np.zeros((flow.state_count, flow.state_count))
    A, B = flow.deviations[..., :n], flow.deviations[..., n:]
    rest, shifts = replace(model, A=A, B=B), 1e-6 * np.eye(n)
    ahead, behind = (
        np.array([rest.derivative(x[:n] + sign * shift, u) for shift in shifts])
        for sign in (1.0, -1.0)
    )
    jacobian[:n, :n] = (ahead - behind).T / 2e-6
    return jacobian


def decrease(design: Design, transition: Array, noise: Array) -> float:
    """Return the smallest eigenvalue of λ²X − A[(I−KC)X(I−KC)ᵀ + KRKᵀ]Aᵀ − Q where X = I."""
    K, C = design.K, design.request.flow.output_matrix
    closed = np.eye(len(K)) - K @ C
    X = design.covariance_bound
    after = closed @ X @ closed.T + K @ design.request.measurement_covariance @ K.T
    root = np.linalg.cholesky(design.P)
    rest = X - transition @ after @ transition.T - noise
    return float(np.linalg.eigvalsh(root.T @ rest @ root)[0])


@pytest.mark.parametrize("kind", ["known", "estimated"])
def test_the_bound_decreases_at_every_weight_and_state(
    kind: str, known: Design, example: Design
) -> None:
    """At random weights of a known premise, or states of the domain of an estimated one."""
    design = known if kind == "known" else example
    flow, rng = design.request.flow, np.random.default_rng(11)
    margins = []
    for _ in range(20):
        if kind == "known":
            # The premise does not move with the state, so the Jacobian is the blend of the rules.
            pair = [deviation_jacobian(flow, np.zeros(4), np.array([0.0, rng.uniform()]))] * 2
        else:
            states = rng.uniform(-1.2, 1.2, (2, 3))
            pair = [deviation_jacobian(flow, x, np.zeros(1)) for x in states]
        margins.append(decrease(design, *flow.error_map(*pair)))
    assert min(margins) > 0.0
    assert ("covers every weight" if kind == "known" else "Jacobian") in design.request.claim


def test_without_slope_vertices_the_gap_is_not_covered_and_said_so(example: Design) -> None:
    bare = replace(example.request, slope_vertices=())
    assert not bare.covers_estimated_premise
    assert "NOT the difference between the weights" in bare.claim
    assert "no rule fires" not in bare.claim
    rules = RuleBase(((membership("triangle", {"left": -1, "peak": 0, "right": 2}),),) * 2)
    narrow = replace(bare, model=replace(bare.model, rule_base=rules))
    assert "no rule fires for a premise between -inf and -1 or between 2 and inf" in narrow.claim
    design = synthesise(bare)
    assert design.certificate.holds
    flow = bare.flow
    at_the_edge = deviation_jacobian(flow, np.array([1.19, 0.0, 0.0]), np.zeros(1))
    assert decrease(design, *flow.error_map(at_the_edge, at_the_edge)) < 0.0


def uncertain(request: TSRequest, name: str, E: Array, bound: float) -> TSRequest:
    return replace(request, uncertainty={name: Direction(E, bound)}, certify_uncertainty=True)


def test_certified_uncertainty_covers_its_box_at_a_price(known: Design) -> None:
    E = np.zeros((2, 3, 3))
    E[:, 1, 0] = [-4.0, -9.0]
    design = synthesise(uncertain(known.request, "stiffness", E, 0.05))
    assert (design.bound_std >= known.bound_std * (1.0 - 1e-3)).all()
    for theta in (-0.05, 0.02, 0.05):
        for weight in (0.0, 0.4, 1.0):
            change = theta * ((1.0 - weight) * E[0] + weight * E[1])
            N = deviation_jacobian(known.request.flow, np.zeros(4), np.array([0.0, weight]))
            N[:3, :3] += change
            assert decrease(design, *design.request.flow.error_map(N, N)) > 0
    assert "stiffness +0.05" in design.certificate.inequalities[-1].where


@pytest.mark.parametrize("rate", [1.0 / 60.0, 20.0])
def test_a_slow_system_has_the_design_of_a_fast_one(known: Design, rate: float) -> None:
    """The same numbers in another unit of time, and a rate far above what the system needs."""
    slower, fast = 2400.0, known.request
    model = replace(fast.model, A=fast.model.A / slower, B=fast.model.B / slower)
    density = fast.channels[0].terms[0].get("density", 0.0) / slower
    terms = [DisturbanceTerm("bias", {"density": density})], CLEAN
    noise = np.asarray(fast.process_noise) / slower
    design = synthesise(blended(model=model, process_noise=noise, disturbance=terms, rate=rate))
    assert design.certificate.holds
    ratio = design.bound_std / known.bound_std
    assert (ratio < 1.001).all()
    assert rate > 1.0 or (ratio > 0.999).all()


def test_every_kind_of_vertex_is_proved_exactly(known: Design, example: Design) -> None:
    """Rules, and slope vertices at the corners of an uncertainty's box."""
    friction = np.array([[0.0, 0.0], [0.0, -1.0]])
    boxed = synthesise(uncertain(replace(example.request, decay_rate=0.05), "k", friction, 0.1))
    for design, pairs in ((known, 4), (boxed, 16)):
        report = verify_exactly(design)
        assert report.holds
        assert len(report.inequalities) == 1 + pairs
        both = zip(report.inequalities, design.certificate.inequalities, strict=True)
        for exact, rounded in both:
            assert exact[:2] == rounded[:2]
            assert exact.margin == pytest.approx(rounded.margin, rel=2e-3)
    harder = uncertain(example.request, "k", 2.0 * friction, 0.2)
    assert not verify_exactly(replace(example, request=harder)).holds


def test_disturbances_act_through_D_s() -> None:
    request = blended(disturbance=[BIAS], D_s=np.array([[0.0], [2.0]]))
    np.testing.assert_array_equal(request.flow.output_matrix, [[1, 0, 0, 0], [0, 0, 1, 2]])
    assert [channel.name for channel in request.channels] == ["channel 1"]


def test_a_hidden_mode_is_named_with_its_rule() -> None:
    """A constant disturbance and an integrator that are measured as a sum."""
    A = np.array([[[0.0, 1.0], [0.0, -1.0]], [[0.0, 1.0], [-2.0, -1.0]]])
    model = TSModel(A, np.zeros((2, 1)), np.eye(2)[:1], RAMPS, np.array([[1.0, 0.0]]))
    request = TSRequest(model, [1e-3, 1e-2], [0.1], 50.0, [1.0, 1.0], disturbance=[BIAS])
    with pytest.raises(DetectabilityError) as caught:
        synthesise(request)
    text = str(caught.value)
    assert "disturbance bias" in text
    assert re.search(
        r"rule 1: the mode 0 with \[x1, x2, w1\] = \[-?1, -?0, -?1\] does not decay", text
    )
    assert "rule 2" not in text
    assert "gauss_markov" in text
    assert "kind clean for y1" in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"disturbance": [CLEAN]}, "disturbance: expected 2 channels, one per output, got 1"),
        ({"D_s": [[1.0, 1.0], [1.0, 1.0]]}, "D_s: expected full column rank"),
        ({"certify_uncertainty": True}, "certify_uncertainty: expected at least one uncertain"),
    ],
)
def test_wrong_requests_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        blended(**changes)


def test_what_does_not_go_together_is_refused(example: Design) -> None:
    with pytest.raises(DesignError, match="process_noise may be too small: its noise has to reach"):
        synthesise(replace(example.request, process_noise=[0.0, 0.0]))
    with pytest.raises(ModelError, match="slope_vertices: expected none, the premise is made of"):
        blended(slope_vertices=[np.eye(3)])
    with pytest.raises(ModelError, match=r"vertices: expected at most 16 matrices.*got 17"):
        replace(example.request, slope_vertices=[np.eye(2)] * 17)
    with pytest.raises(ModelError, match="every direction must be one matrix for all rules"):
        replace(example.request, certify_uncertainty=True)
    with pytest.raises(ModelError, match="expected one for an arm, got one for a T-S system"):
        _ = example.arm_request
