# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Certified designs for T–S systems: known answers, what is covered, files, and refusals."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from tsobs_ros.design.file import load_design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.design.ts_design import TSDesign
from tsobs_ros.design.ts_file import (
    is_ts_file,
    load_ts_design,
    load_ts_request,
    parse_ts_design,
    save_ts_design,
)
from tsobs_ros.design.ts_request import TSRequest
from tsobs_ros.design.ts_synthesis import design_ts_file, synthesise_ts
from tsobs_ros.errors import (
    CertificateError,
    DesignError,
    DesignFileError,
    DetectabilityError,
    ModelError,
)
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import system_uncertainty
from tsobs_ros.paper.systems import arm_system
from tsobs_ros.resources import config_path

Array = NDArray[np.float64]

CLEAN = [DisturbanceTerm("clean")]
BIAS = [DisturbanceTerm("bias")]
ALWAYS = RuleBase(((membership("always", {}),),))
RAMPS = RuleBase(
    (
        (membership("linear", {"zero": 1.0, "one": 0.0}),),
        (membership("linear", {"zero": 0.0, "one": 1.0}),),
    )
)


def single(**changes: Any) -> TSRequest:
    """One rule, two outputs, a bias on the second."""
    A = np.array([[[0.0, 1.0], [-2.0, -0.3]]])
    model = TSModel(A, np.array([[0.0], [1.0]]), np.eye(2), ALWAYS, np.ones((1, 2)))
    request = TSRequest(
        model=model,
        disturbance=[CLEAN, BIAS],
        process_noise=[1e-3, 1e-2],
        measurement_std=[0.1, 0.05],
        rate=50.0,
        initial_std=[1.0, 1.0],
    )
    return replace(request, **changes)


def blended(**changes: Any) -> TSRequest:
    """Two rules blended by a known signal, three states, two outputs."""
    model = TSModel(
        A=np.array(
            [
                [[0.0, 1.0, 0.0], [-4.0, -0.4, 1.0], [0.0, 0.0, -1.0]],
                [[0.0, 1.0, 0.0], [-9.0, -0.1, 0.5], [0.3, 0.0, -2.0]],
            ]
        ),
        B=np.array([[0.0], [0.0], [1.0]]),
        C=np.eye(3)[[0, 2]],
        rule_base=RAMPS,
        premise=np.zeros((1, 3)),
        schedule=np.array([[1.0]]),
    )
    request = TSRequest(
        model=model,
        disturbance=[BIAS, CLEAN],
        process_noise=[1e-4, 1e-2, 1e-2],
        measurement_std=[0.02, 0.05],
        rate=40.0,
        initial_std=[1.0, 1.0, 1.0],
    )
    return replace(request, **changes)


@pytest.fixture(scope="module")
def example_file() -> Path:
    return config_path("ts_example.request.yaml")


@pytest.fixture(scope="module")
def example(example_file: Path) -> TSDesign:
    return synthesise_ts(load_ts_request(example_file))


@pytest.fixture(scope="module")
def known() -> TSDesign:
    return synthesise_ts(blended())


def decrease(design: TSDesign, transition: Array, noise: Array) -> float:
    """Return the smallest eigenvalue of λ²X − A[(I−KC)X(I−KC)ᵀ + KRKᵀ]Aᵀ − Q where X = I."""
    K, C = design.K, design.request.flow.output_matrix
    closed = np.eye(len(K)) - K @ C
    X = design.covariance_bound
    after = closed @ X @ closed.T + K @ design.request.measurement_covariance @ K.T
    root = np.linalg.cholesky(design.P)
    rest = X - transition @ after @ transition.T - noise
    return float(np.linalg.eigvalsh(root.T @ rest @ root)[0])


def test_one_rule_is_the_kalman_filter() -> None:
    request = single()
    design = synthesise_ts(request)
    (vertex,) = request.vertices()
    C, R = request.flow.output_matrix, request.measurement_covariance
    X = solve_discrete_are(vertex.transition.T, C.T, vertex.noise, R)
    K = X @ C.T @ np.linalg.inv(C @ X @ C.T + R)
    np.testing.assert_allclose(design.covariance_bound, X, rtol=1e-3, atol=1e-3 * np.abs(X).max())
    np.testing.assert_allclose(design.K, K, rtol=2e-3, atol=1e-5)
    assert design.certificate.holds


def test_the_arm_is_a_special_case() -> None:
    """Given as two rules with the ends of its slopes, it gets the bound of its own design."""
    own = ArmRequest(rate=1000.0)
    arm, width = own.arm, own.x_max
    sector = RuleBase(
        tuple((membership(name, {"half_width": width}),) for name in ("sine_upper", "sine_lower"))
    )
    system = arm_system(arm, width)
    gain = arm.stiffness / arm.link_inertia
    noise = own.process_noise
    request = TSRequest(
        model=TSModel(system.A, system.B[0], system.C[0], sector, np.eye(4)[:1]),
        disturbance=[own.disturbance],
        process_noise=[0.0, noise.link, 0.0, noise.motor * gain**2],
        measurement_std=[own.measurement_std],
        rate=own.rate,
        initial_std=np.sqrt(np.diag(own.initial_covariance))[:4],
        slope_vertices=[arm.slope_matrix(slope) for slope in own.slope_range],
    )
    assert request.covers_estimated_premise
    np.testing.assert_array_equal(request.initial_covariance, own.initial_covariance)
    design, reference = synthesise_ts(request), synthesise(own)
    std = np.sqrt(np.diag(reference.covariance_bound))
    np.testing.assert_allclose(design.bound_std, std, rtol=1e-3)
    np.testing.assert_allclose(design.K, reference.K, rtol=2e-3)


def test_with_a_known_premise_the_certificate_holds_at_every_weight(known: TSDesign) -> None:
    flow = known.request.flow
    rng = np.random.default_rng(11)
    margins = []
    for _ in range(50):
        u = np.array([0.0, rng.uniform()])
        # The premise does not move with the state, so the Jacobian is the blend of the rules.
        N = flow.deviation_jacobian(np.zeros(4), u)
        margins.append(decrease(known, *flow.error_map(N, N, flow.nominal)))
    assert min(margins) > 0.0
    assert "covers every weight" in known.request.claim


def test_slope_vertices_cover_the_estimated_premise(example: TSDesign) -> None:
    """At random states of the domain, whatever the state in the middle of the step."""
    flow = example.request.flow
    rng = np.random.default_rng(12)
    margins = []
    for _ in range(50):
        x, other = rng.uniform(-1.2, 1.2, (2, 3))
        pair = [flow.deviation_jacobian(each, np.zeros(1)) for each in (x, other)]
        margins.append(decrease(example, *flow.error_map(*pair, flow.nominal)))
    assert min(margins) > 0.0
    assert "Jacobian" in example.request.claim


def test_without_slope_vertices_the_gap_is_not_covered_and_said_so(example: TSDesign) -> None:
    bare = replace(example.request, slope_vertices=())
    assert not bare.covers_estimated_premise
    assert "NOT the difference between the weights" in bare.claim
    design = synthesise_ts(bare)
    assert design.certificate.holds
    flow = bare.flow
    at_the_edge = flow.deviation_jacobian(np.array([1.19, 0.0, 0.0]), np.zeros(1))
    assert decrease(design, *flow.error_map(at_the_edge, at_the_edge, flow.nominal)) < 0.0


def test_every_pair_of_vertices_has_its_inequality(example: TSDesign) -> None:
    places = [each.where for each in example.certificate.inequalities[1:]]
    assert places == [f"slope vertex {i}, slope vertex {j}" for i in (1, 2) for j in (1, 2)]
    weak = replace(example, K=np.zeros_like(example.K))
    assert not weak.certificate.holds


def test_a_decay_that_is_asked_for_is_proved(known: TSDesign) -> None:
    slow = known.certificate.contraction_rate
    faster = synthesise_ts(blended(decay_rate=slow + 0.05))
    assert faster.certificate.holds
    assert faster.certificate.contraction_rate > slow + 0.04


def test_certified_uncertainty_covers_its_box_at_a_price(known: TSDesign) -> None:
    model = known.request.model
    E = np.zeros((2, 3, 3))
    E[:, 1, 0] = [-4.0, -9.0]
    uncertain = system_uncertainty(model, {"stiffness": E}, {"stiffness": 0.05})
    design = synthesise_ts(blended(uncertainty=uncertain, certify_uncertainty=True))
    assert (design.bound_std >= known.bound_std * (1.0 - 1e-3)).all()
    for theta in (-0.05, 0.02, 0.05):
        for weight in (0.0, 0.4, 1.0):
            change = theta * ((1.0 - weight) * E[0] + weight * E[1])
            N = known.request.flow.deviation_jacobian(np.zeros(4), np.array([0.0, weight]))
            N[:3, :3] += change
            assert (
                decrease(design, *design.request.flow.error_map(N, N, design.request.flow.nominal))
                > 0
            )
    assert "stiffness +0.05" in design.certificate.inequalities[-1].where


def test_disturbances_act_through_D_s() -> None:
    request = single(disturbance=[BIAS], D_s=[[0.0], [2.0]])
    np.testing.assert_array_equal(request.flow.output_matrix, [[1.0, 0.0, 0.0], [0.0, 1.0, 2.0]])
    twice = synthesise_ts(request)
    direct = single(disturbance=[CLEAN, [DisturbanceTerm("bias", {"density": 4e-4})]])
    np.testing.assert_allclose(
        twice.bound_std * [1.0, 1.0, 2.0], synthesise_ts(direct).bound_std, rtol=2e-3
    )


def test_a_design_is_read_back_to_the_last_bit(example: TSDesign, tmp_path: Path) -> None:
    path = tmp_path / "pendulum.design.yaml"
    save_ts_design(example, path)
    again = load_ts_design(path)
    assert is_ts_file(path)
    np.testing.assert_array_equal(again.P, example.P)
    np.testing.assert_array_equal(again.K, example.K)
    assert again.solver == example.solver
    assert again.summary() == example.summary()
    assert again.request.uncertainty is not None
    np.testing.assert_array_equal(again.request.uncertainty.limits, [0.2])
    save_ts_design(again, tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text() == path.read_text()


def test_from_request_file_to_design_file(example_file: Path, tmp_path: Path) -> None:
    path = tmp_path / "design.yaml"
    made = design_ts_file(example_file, path)
    np.testing.assert_array_equal(load_ts_design(path).K, made.K)


def test_a_scheduled_design_is_read_back(known: TSDesign, tmp_path: Path) -> None:
    save_ts_design(known, tmp_path / "design.yaml")
    again = load_ts_design(tmp_path / "design.yaml")
    assert again.request.model.premise_known
    assert again.certificate == known.certificate


def test_an_edited_file_is_refused(example: TSDesign, tmp_path: Path) -> None:
    path = tmp_path / "design.yaml"
    save_ts_design(example, path)
    data = yaml.safe_load(path.read_text())
    data["measurement_std"] = [0.02, 0.02]
    path.write_text(yaml.safe_dump(data))
    assert not parse_ts_design(path).certificate.holds
    with pytest.raises(CertificateError, match=r"design.yaml.*slope vertex 1.*DOES NOT HOLD"):
        load_ts_design(path)


def test_files_of_arms_are_told_apart(example_file: Path) -> None:
    shipped = config_path("elastic_joint.design.yaml")
    assert not is_ts_file(shipped)
    assert load_design(shipped).certificate.holds
    with pytest.raises(DesignFileError, match="format: expected 'tsobs_ros T-S design'"):
        load_ts_design(shipped)
    assert is_ts_file(example_file)


def test_the_text_says_what_is_proved(example: TSDesign) -> None:
    text = example.text()
    for part in ("2 rules, 2 states, 2 outputs", "convex hull", "the certificate holds", "100 Hz"):
        assert part in text
    assert "THE CERTIFICATE DOES NOT HOLD" in replace(example, P=np.eye(3)).text()


def test_a_hidden_mode_is_named_with_its_rule() -> None:
    """A constant disturbance and an integrator that are measured as a sum."""
    A = np.array([[[0.0, 1.0], [0.0, -1.0]], [[0.0, 1.0], [-2.0, -1.0]]])
    model = TSModel(A, np.zeros((2, 1)), np.eye(2)[:1], RAMPS, np.array([[1.0, 0.0]]))
    request = single(model=model, disturbance=[BIAS], measurement_std=[0.1])
    with pytest.raises(DetectabilityError) as caught:
        synthesise_ts(request)
    text = str(caught.value)
    assert "outputs disturbed by bias" in text
    assert re.search(
        r"rule 1: the mode 0 with \[x1, x2, w1\] = \[-?1, -?0, -?1\] is not seen", text
    )
    assert "rule 2" not in text
    assert "gauss_markov" in text
    assert "damping" in text


def test_an_arbitrary_disturbance_is_refused_with_a_way_out() -> None:
    with pytest.raises(DetectabilityError, match="leaving these outputs out of C"):
        synthesise_ts(single(disturbance=[CLEAN, [DisturbanceTerm("arbitrary")]]))


def test_what_no_common_matrix_answers_is_refused_by_name() -> None:
    with pytest.raises(DesignError, match="no common matrix P exists") as caught:
        synthesise_ts(blended(decay_rate=50.0))
    for part in ("rule 1, rule 2", "decay rate 50 1/s", "40 Hz", "a smaller decay_rate"):
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measurement_std": [0.1]}, r"measurement_std: expected shape \(2,\), got \(1,\)"),
        ({"measurement_std": [0.1, 0.0]}, "square of measurement_std: expected a finite number"),
        ({"initial_std": [1.0, -1.0]}, "square of initial_std"),
        ({"rate": 0.0}, "rate: expected a finite number above 0"),
        ({"decay_rate": -1.0}, "decay_rate"),
        ({"disturbance": [CLEAN]}, "disturbance: expected 2 channels, one an output, got 1"),
        ({"disturbance": [CLEAN, []]}, r"disturbance\[1\]: expected at least one term"),
        ({"D_s": [[1.0, 1.0], [1.0, 1.0]]}, "D_s: expected full column rank"),
        (
            {"disturbance": [CLEAN, [DisturbanceTerm("sinusoid", {"frequency": 200.0})]]},
            "sinusoid frequency: expected less than half the measurement rate",
        ),
        ({"slope_vertices": [np.eye(3)]}, r"slope_vertices\[0\]: expected shape \(2, 2\)"),
        ({"certify_uncertainty": True}, "certify_uncertainty: expected at least one uncertain"),
        ({"slope_vertices": [np.eye(2)] * 17}, "vertices: expected at most 16 matrices.*got 17"),
    ],
)
def test_wrong_requests_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        single(**changes)


def test_slope_vertices_of_a_known_premise_are_refused() -> None:
    with pytest.raises(ModelError, match="slope_vertices: expected none, the premise is made of"):
        blended(slope_vertices=[np.eye(3)])


def test_directions_that_differ_from_rule_to_rule_have_no_slope_vertices(
    example: TSDesign,
) -> None:
    with pytest.raises(ModelError, match="every direction must be one matrix for all rules"):
        replace(example.request, certify_uncertainty=True)


@pytest.mark.parametrize(
    ("directions", "bounds", "message"),
    [
        ({"k": np.eye(2)}, {"j": 0.1}, "expected a bound for each of k, got j"),
        ({"k": np.zeros((2, 2))}, {"k": 0.1}, "direction of k: expected a matrix other than zero"),
        ({"k": np.eye(3)}, {"k": 0.1}, r"direction of k: expected shape \(2, 2\), got \(3, 3\)"),
        ({"k": np.ones((3, 2, 2))}, {"k": 0.1}, r"direction of k: expected shape \(1, 2, 2\)"),
        ({"k": np.eye(2)}, {"k": 0.0}, "bound of k: expected a finite number above 0"),
    ],
)
def test_wrong_directions_are_named(
    directions: dict[str, Array], bounds: dict[str, float], message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        system_uncertainty(single().model, directions, bounds)


def _without(data: dict[str, Any], *path: Any) -> None:
    for key in path[:-1]:
        data = data[key]
    del data[path[-1]]


def _with(data: dict[str, Any], value: Any, *path: Any) -> None:
    for key in path[:-1]:
        data = data[key]
    data[path[-1]] = value


@pytest.mark.parametrize(
    ("value", "path", "message"),
    [
        (None, ("rate",), "rate: missing"),
        (None, ("system", "rules"), "system.rules: expected a list, got None"),
        (None, ("system", "premises"), "system.premises: expected a mapping"),
        (1, ("colour",), "the file: unknown entry 'colour'"),
        (1, ("system", "D"), "system: unknown entry 'D'"),
        ([], ("system", "rules"), "system.rules: expected at least one rule"),
        ({}, ("system", "premises"), "system.premises: expected at least one premise variable"),
        ({}, ("system", "premises", "angle"), "premises.angle: expected one of state, output"),
        ([1], ("system", "premises", "angle", "state"), "angle.state: expected a list of 2, got 1"),
        ([[1, "a"]], ("system", "rules", 0, "A"), r"rules\[0\].A\[0\]\[1\]: expected a number"),
        ([[1], [2]], ("system", "rules", 1, "A"), "expected A of one shape in all rules, got"),
        ([], ("system", "C"), "system.C: expected rows of numbers, got none"),
        ([[1, 2, 3]], ("system", "C"), "system.C: expected rows of 2 numbers, got 3"),
        ({"speed": {}}, ("system", "rules", 0, "if"), r"rules\[0\].if: unknown entry 'speed'"),
        ({"angle": {}}, ("system", "rules", 0, "if"), "if.angle.shape: expected a name, got None"),
        ({"angle": {"shape": "box"}}, ("system", "rules", 0, "if"), "membership shape: expected"),
        ([[1]], ("system", "slope_vertices"), r"slope_vertices\[0\]: expected a list of 2"),
        ([{"kind": "clean"}], ("disturbance",), r"disturbance\[0\]: expected a list"),
        ([1.0], ("process_noise",), "process_noise: expected a list of 2, got 1"),
        ("high", ("rate",), "rate: expected a number, got 'high'"),
        ("yes", ("certify_uncertainty",), "certify_uncertainty: expected true or false"),
        ([[0]], ("uncertainty", "gravity", "E"), "uncertainty.gravity.E: expected a list of 2"),
        (None, ("uncertainty", "gravity", "bound"), "gravity.bound: expected a number, got None"),
    ],
)
def test_wrong_entries_are_named_with_the_file(
    value: Any, path: tuple[Any, ...], message: str, example_file: Path, tmp_path: Path
) -> None:
    data = yaml.safe_load(example_file.read_text())
    if value is None:
        _without(data, *path)
    else:
        _with(data, value, *path)
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(yaml.safe_dump(data))
    with pytest.raises(DesignFileError, match=rf"wrong\.yaml: .*{message}"):
        load_ts_request(wrong)


def test_premises_of_outputs_and_scheduled_signals(example_file: Path, tmp_path: Path) -> None:
    data = yaml.safe_load(example_file.read_text())
    data["system"]["C"] = [[2, 0], [0, 1]]
    data["system"]["premises"] = {
        "angle": {"output": [0.5, 0]},
        "load": {"state": [0, 1], "scheduled": [0, 3]},
    }
    path = tmp_path / "request.yaml"
    path.write_text(yaml.safe_dump(data))
    model = load_ts_request(path).model
    np.testing.assert_array_equal(model.premise, [[1.0, 0.0], [0.0, 1.0]])
    np.testing.assert_array_equal(model.schedule, [[0.0, 0.0], [0.0, 3.0]])
    # The second premise is in no rule's "if", so it is always met.
    held = np.array([0.0, 5.0, 7.0])
    np.testing.assert_array_equal(
        model.weights(np.array([0.4, 0.0]), held), model.weights(np.array([0.4, 9.0]), -held)
    )
