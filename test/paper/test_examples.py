# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The paper's data: what fits, what does not, for every way to read its lost signs."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from tsobs_ros.design.file import design_text, load_design, load_request
from tsobs_ros.design.request import DisturbanceTerm, TSRequest
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.errors import DetectabilityError, ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper import examples as printed
from tsobs_ros.paper.augmentation import Augmentation, blend, check_conditions, failing
from tsobs_ros.paper.claims import check_printed_gains, check_printed_p
from tsobs_ros.paper.examples import PaperExample, arm_system, example_1, example_2
from tsobs_ros.resources import config_path

FIRST = Augmentation(example_1().system)
NAMED = [("example_1", example_1()), ("example_2", example_2())]
SIGNS = [np.array(signs) for signs in itertools.product([1.0, -1.0], repeat=6)]


@pytest.mark.parametrize(("name", "example"), NAMED)
def test_the_shipped_request_is_the_example(name: str, example: PaperExample) -> None:
    """Rules, their own outputs, weights by the measured y1, the disturbance's size, and ΔA."""
    request = load_request(config_path(f"paper_{name}.request.yaml"))
    assert isinstance(request, TSRequest)
    model, system = request.model, example.system
    for name, matrix in (("A", system.A), ("B", system.B), ("rule_outputs", system.rule_outputs)):
        np.testing.assert_array_equal(getattr(model, name), matrix)
    np.testing.assert_array_equal(model.C, system.C)
    assert request.output_names[0] == request.input_names[1] == "y1"
    for y1 in (-1.2, 0.3, 0.9):
        held = np.array([0.7, y1])
        np.testing.assert_array_equal(
            model.weights(np.ones(3), held), system.rule_base.weights([y1])
        )
    np.testing.assert_array_equal(request.uncertainty_model.linear[0], example.delta_A)
    # Sizes and speeds of the models are those of the signals, within a factor of two.
    times = np.arange(3.0, 103.0, 1e-3)
    omega = example.disturbance(times)
    rms = np.sqrt((omega**2).mean(axis=0))
    std = np.array([term["std"] for (term,) in request.disturbance])
    assert (np.maximum(std / rms, rms / std) < 2.0).all()


@pytest.mark.parametrize("number", [1, 2])
def test_our_design_of_an_example_exists_with_a_model_of_the_disturbance_only(number: int) -> None:
    design = load_design(config_path(f"paper_example_{number}.design.yaml"))
    request = load_request(config_path(f"paper_example_{number}.request.yaml"))
    assert isinstance(request, TSRequest)
    assert design_text(replace(design, request=request)) == design_text(design)
    assert "the rules' C differ" in request.claim
    arbitrary = replace(request, disturbance=[[DisturbanceTerm("arbitrary")]] * 3)
    with pytest.raises(DetectabilityError, match="explains every value"):
        synthesise(arbitrary)


def test_printed_p_fails_rule_2_for_every_reading_of_its_signs() -> None:
    A2 = example_1().system.A[1]
    places = np.argwhere(A2 != 0.0)
    P, T = printed.EXAMPLE_1_P, FIRST.blind_basis
    on_blind = T.T @ P @ T
    largest = []
    for signs in SIGNS:
        A = np.zeros((3, 3))
        A[places[:, 0], places[:, 1]] = signs * np.abs(A2[places[:, 0], places[:, 1]])
        largest.append(float(np.linalg.eigvalsh(A.T @ on_blind + on_blind @ A)[-1]))
    assert min(largest) == pytest.approx(0.565, abs=1e-3)


def test_printed_p_meets_the_other_conditions() -> None:
    conditions, example = check_printed_p(), example_1()
    assert failing(conditions) == ["(37) rule 2"]
    epsilon = FIRST.epsilon(example.alpha, example.xi)
    assert epsilon == pytest.approx(printed.EXAMPLE_1_EPSILON, rel=3e-4)
    norm = conditions["(38)"].number
    assert norm == pytest.approx(printed.EXAMPLE_1_INVERSE_NORM, rel=3e-4)


def test_printed_solution_of_example_3_fails_for_every_sign() -> None:
    readings = check_printed_gains()
    assert len(readings) == 512
    assert all(map(failing, readings))
    aug = Augmentation(arm_system(ElasticJointArm()))
    for change in printed.sign_changes(4):
        # On {C̄x̄ = 0} no gain helps, so H and its signs do not matter.
        alone = check_conditions(aug, change[:, None] * printed.EXAMPLE_3_P * change, np.zeros(2))
        assert min(alone[f"(37) rule {rule}"].number for rule in (1, 2)) > 1.0


@pytest.mark.parametrize(("name", "example"), NAMED)
def test_rules_are_stable_and_the_uncertainty_within_its_bounds(
    name: str, example: PaperExample
) -> None:
    assert np.linalg.eigvals(example.system.A).real.max() < -0.5
    norms = np.linalg.norm(example.delta_A, 2, axis=(1, 2))
    np.testing.assert_allclose(norms, example.alpha, rtol=1e-12)


def test_example_3_is_the_arm_and_undamped() -> None:
    """Equations (47) with the signs restored and (49): on |q₁| ≤ π/2 the rules are the arm."""
    system = arm_system(ElasticJointArm())
    for A, corner in zip(system.A, (-20.0, -20.0 / np.pi - 10.0), strict=True):
        expected = [[0, 1, 0, 0], [corner, 0, 1, 0], [0, 0, 0, 1], [50, 0, -5, 0]]
        np.testing.assert_allclose(A, expected, rtol=1e-15, atol=0.0)
    modes = [np.sort(np.abs(np.linalg.eigvals(A).imag))[::2] for A in system.A]
    np.testing.assert_allclose(modes, [[1.4806, 4.7757], [1.2694, 4.4446]], atol=1e-4)
    np.testing.assert_allclose(np.linalg.eigvals(system.A).real, 0.0, atol=1e-12)
    random = np.random.default_rng(1)
    for arm, x_max in ((ElasticJointArm(), np.pi / 2), (ElasticJointArm(2, 1, 5, 3, 0.1, 0.2), 3)):
        system = arm_system(arm, x_max)
        x = random.uniform(-x_max, x_max, size=(20, 4))
        u = random.normal(size=(20, 1))
        weights = system.rule_base.weights(x[:, :1])
        rate = blend(system.A, weights, x) + blend(system.B, weights, u)
        np.testing.assert_allclose(rate, arm.derivative(x, u), atol=1e-12)
        np.testing.assert_allclose(system.derivative(x, u), rate, atol=1e-12)
    with pytest.raises(ModelError, match="half_width < π"):
        arm_system(ElasticJointArm(), np.pi)
