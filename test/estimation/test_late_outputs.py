# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Angles that are measured late: a model of first order, against sensors that really are late."""

from functools import cache

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output
from tsobs_ros.simulation.signals import BiasStep

pytest.importorskip("cvxpy")
PERIOD = 0.005
BIAS = (DisturbanceTerm("bias", {"density": 1e-6}),)


@cache
def design_of(delay: float) -> Design:
    outputs = (Output("motor_angle", 0.001, delay=delay), Output("link_angle", 0.005, BIAS, delay))
    return ts.synthesise(ArmRequest(outputs=outputs, uncertainty={}))


def test_the_output_matrix_has_the_delay_on_the_velocity() -> None:
    design, plain = design_of(PERIOD), design_of(0.0)
    C, C0 = (each.request.flow.output_matrix for each in (design, plain))
    np.testing.assert_allclose(C[:, [0, 2, 4]], C0[:, [0, 2, 4]])
    np.testing.assert_allclose(C[:, [1, 3]], -PERIOD * C0[:, [0, 2]])
    assert design.certificate.holds
    assert plain.certificate.holds
    # What is late is worth less, and not much.
    assert (design.bound_std >= plain.bound_std * (1.0 - 1e-6)).all()
    assert (design.bound_std <= 1.1 * plain.bound_std).all()


def errors(plant: Design, observer: Design) -> tuple[Array, Array]:
    """Return errors of states and disturbances by their bounds."""
    found = []
    for seed in range(3):
        step = {"link_angle": [BiasStep(0.1, 4.0)]}
        run = ts.simulate(plant, duration=15.0, seed=seed, disturbance=step)
        said = ts.estimate(observer, run.time, run.angle, run.torque)
        after = run.time > 8.0
        off = (said.disturbance - run.disturbance)[:, 1:] / said.disturbance_bound[:, 1:]
        found.append(np.hstack([(said.state - run.state) / said.state_bound, off])[after])
        assert said.claimed[after].all() or plant is not observer
    root = np.sqrt((np.array(found) ** 2).mean(axis=(0, 1)))
    return root[:4], root[4:]


def test_the_first_order_suffices_for_a_period() -> None:
    """Of states and of the sensor's disturbance, which is what it has beyond the angle that was."""
    late, plain = design_of(PERIOD), design_of(0.0)
    states, disturbance = errors(late, late)
    assert (states < 1.0).all()
    assert (disturbance < 1.0).all()
    states, _ = errors(late, plain)
    assert states.max() > 2.0
