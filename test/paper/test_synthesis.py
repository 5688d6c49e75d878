# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method's design procedure: its answers, its proofs of impossibility, its refusals."""

import numpy as np
import pytest

from tsobs_ros.errors import DetectabilityError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper.examples import PaperExample, arm_system, example_1, example_2
from tsobs_ros.paper.synthesis import INNOVATION_RATE, check_stability, design_adaptive_observer

ARM, NO_BOUNDS = arm_system(ElasticJointArm()), np.zeros(2)


@pytest.mark.parametrize("example", [example_1(), example_2()], ids=["1", "2"])
def test_examples_are_designed_and_hold_on_rechecking(example: PaperExample) -> None:
    design = design_adaptive_observer(example.system, example.alpha, example.xi)
    aug, P = design.augmentation, design.P
    assert np.linalg.eigvalsh(P)[0] > 0.0
    alpha_1 = np.linalg.norm(aug.E_L_inverse, 2) * example.alpha
    for rule, H in enumerate(design.H1):
        closed = aug.A1[rule] - H @ aug.C_bar + alpha_1[rule] * np.eye(6)
        assert np.linalg.eigvalsh(closed.T @ P + P @ closed)[-1] < 0.0
    np.testing.assert_allclose(P @ design.M, aug.C_bar.T, atol=1e-12)
    bound = (alpha_1 / example.xi).max() / np.linalg.norm(aug.C_bar, 2)
    assert np.linalg.norm(np.linalg.inv(P), 2) == pytest.approx(bound)
    rates = np.linalg.eigvals(np.eye(3) + aug.C_bar @ design.H1).real
    assert INNOVATION_RATE / np.linalg.cond(P) < rates.min()
    assert 0.9 * INNOVATION_RATE < rates.max() < 1.5 * INNOVATION_RATE


def test_undamped_arm_is_refused_with_its_mode() -> None:
    A = ARM.A
    (_, P, Z), _ = check_stability(A, NO_BOUNDS)
    assert P is None
    assert np.linalg.eigvalsh(Z).min() > -1e-12
    assert np.trace(Z, axis1=1, axis2=2).sum() == pytest.approx(1.0)
    assert np.linalg.eigvalsh((A @ Z + Z @ A.transpose(0, 2, 1)).sum(axis=0))[0] > -1e-6
    with pytest.raises(DetectabilityError) as caught:
        design_adaptive_observer(ARM, NO_BOUNDS, NO_BOUNDS)
    text = str(caught.value)
    assert "rule 1 has a mode that does not decay: eigenvalue 0+4.776j with x = [" in text
    for help_offered in ("damping", "a model of the disturbance", "a sensor known to be clean"):
        assert help_offered in text


def test_too_large_an_uncertainty_is_refused_with_the_rate_it_asks_for() -> None:
    example = example_1()
    with pytest.raises(
        DetectabilityError, match=r"rule 2 .* not decay faster than α₁ = 0\.6286 1/s"
    ):
        design_adaptive_observer(example.system, np.array([0.0608, 0.3]), example.xi)
