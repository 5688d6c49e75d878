# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The arm, and its one-step prediction: linear flow, order, exact error map, covariance."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, expm

from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import QUANTITIES, ElasticJointArm
from tsobs_ros.model.disturbance import DisturbanceTerm, per_channel, sum_of
from tsobs_ros.model.flow import ArmFlow, ProcessNoise, arm_uncertainty
from tsobs_ros.model.prediction import Uncertainty, VertexSystem

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=8)

ARMS = st.builds(
    ElasticJointArm, st.floats(0.2, 5.0), st.floats(0.2, 5.0), st.floats(1.0, 50.0),
    st.just(0.0) | st.floats(0.5, 50.0), st.floats(0.0, 3.0), st.floats(0.0, 3.0),
)  # fmt: skip
CLEAN, BIAS, RAMP, DRIFT = map(DisturbanceTerm, ("clean", "bias", "ramp", "gauss_markov"))
TONES = st.floats(0.5, 10.0).map(lambda f: DisturbanceTerm("sinusoid", {"frequency": f}))
DISTURBANCES = st.one_of(
    st.sampled_from([[CLEAN], [BIAS], [RAMP], [DRIFT]]), TONES.map(lambda tone: [BIAS, tone])
).map(sum_of)
NOISE = ProcessNoise(3e-4, 2e-5)
RATES = st.floats(25.0, 1000.0)
OUTPUTS = st.dictionaries(st.sampled_from(QUANTITIES), DISTURBANCES, min_size=1, max_size=2)
TORQUES = st.lists(DISTURBANCES, min_size=2, max_size=2)
FLOWS = st.builds(
    lambda arm, outputs, rate, torques: ArmFlow(
        arm, per_channel([*outputs.values(), *torques]), NOISE, 1.0 / rate, [*outputs]
    ),
    ARMS, OUTPUTS, RATES, TORQUES,
)  # fmt: skip


def draw_state(data: st.DataObject, flow: ArmFlow, *batch: int, bound: float = 2.0) -> Array:
    """Draw augmented states whose motor angle lies within the spring's reach of the link's."""
    shape = (*batch, flow.state_count)
    x = data.draw(hnp.arrays(np.float64, shape, elements=st.floats(-bound, bound)))
    x[..., 2] = flow.arm.stiffness / flow.arm.link_inertia * (x[..., 0] + 0.2 * x[..., 2])
    return x


def drift(flow: ArmFlow) -> Array:
    """Return the linear part of the augmented system, written out from the physics."""
    arm, model = flow.arm, flow.disturbance
    matrix = block_diag(arm.spring_matrix, model.S)
    motor = arm.stiffness / (arm.link_inertia * arm.motor_inertia)
    matrix[3, 4:] = motor * model.H[-2]
    matrix[1, 4:] = model.H[-1] / arm.link_inertia
    return np.asarray(matrix)


def density(flow: ArmFlow) -> Array:
    """Return the white noise density, written out from the physics."""
    gain = flow.arm.stiffness / flow.arm.link_inertia
    arm = np.diag([0.0, NOISE.link, 0.0, NOISE.motor * gain**2])
    return np.asarray(block_diag(arm, flow.disturbance.G @ flow.disturbance.G.T))


def vertices_of(
    flow: ArmFlow, lowest: float, highest: float, known: Uncertainty | None = None
) -> list[VertexSystem]:
    known = known or arm_uncertainty(flow.arm, {})
    return flow.vertices(flow.corners((lowest, highest), known, 1.0, 0.5 * flow.period))


def kick(flow: ArmFlow, slope: float, duration: float) -> Array:
    matrix = np.eye(flow.state_count)
    matrix[1, 0] = -0.5 * duration * flow.arm.gravity_torque / flow.arm.link_inertia * slope
    return matrix


def secant(a: float, b: float) -> float:
    """Return c with sin a − sin b = c (a − b), without cancellation."""
    return math.cos(0.5 * (a + b)) * float(np.sinc(0.5 * (a - b) / math.pi))


@PROPERTY
@given(FLOWS, st.floats(0.05, 1.0))
def test_flow_and_noise_are_those_of_matrix_exponentials(flow: ArmFlow, fraction: float) -> None:
    for duration in (flow.period, fraction * flow.period):
        n, step, A = flow.state_count, flow.transition(duration), drift(flow)
        torque = np.vstack([flow.arm.input_matrix, np.zeros((n - 4, 1))])
        joined = expm(np.block([[A, torque], [np.zeros((1, n + 1))]]) * duration)
        scale = np.abs(joined).max()
        np.testing.assert_allclose(step.phi, joined[:n, :n], rtol=1e-12, atol=1e-14 * scale)
        np.testing.assert_allclose(step.gamma, joined[:n, n:], rtol=1e-10, atol=1e-15 * scale)
        joined = expm(np.block([[-A, density(flow)], [np.zeros((n, n)), A.T]]) * duration)
        expected = joined[n:, n:].T @ joined[:n, n:]
        # Entries differ by ten orders of magnitude, so each is judged by its own standard
        # deviations; Van Loan's form loses digits to cancellation in the smallest.
        deviations = np.sqrt(np.outer(np.diag(step.noise), np.diag(step.noise)))
        np.testing.assert_allclose(step.noise / deviations, expected / deviations, atol=1e-8)
        assert (step.noise == step.noise.T).all()


def test_the_flow_over_a_step_long_for_the_arm_is_the_matrix_exponential() -> None:
    """Fast modes turn or decay many times in a step, where a bare series loses every digit."""
    for arm, rate in (
        (ElasticJointArm(1e-3, 1e-4, 100.0), 25.0),
        (ElasticJointArm(link_damping=1e5), 200.0),
        (ElasticJointArm(), 0.1),
    ):
        flow = ArmFlow(arm, BIAS.model, ProcessNoise(), 1.0 / rate)
        for duration in (flow.period, 0.37 * flow.period):
            step, exact = flow.transition(duration), expm(drift(flow) * duration)
            assert np.abs(step.phi - exact).max() < 1e-9 * np.abs(exact).max()
            deviations = np.sqrt(np.diag(step.noise))
            correlation = step.noise / np.outer(deviations, deviations)
            assert np.linalg.eigvalsh(correlation)[0] >= -1e-12


def test_prediction_is_of_second_order(predicted: Any) -> None:
    """Halving the period quarters the error against an accurate solution of the equations."""
    arm, u = ElasticJointArm(0.7, 1.3, 12.0, 9.0, 0.3, 0.2), np.array([2.0])
    model = DisturbanceTerm("sinusoid", {"frequency": 3.0}).model
    x, errors = np.array([0.5, -0.3, 8.0, 0.7, 0.2, -0.1]), []

    def rate(_: float, z: Array) -> Array:
        return np.concatenate([arm.derivative(z[:4], u), model.S @ z[4:]])

    exact = solve_ivp(rate, (0.0, 0.4), x, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    for period in (0.02, 0.01, 0.005):
        flow, z = ArmFlow(arm, model, ProcessNoise(), period), x
        for _ in range(round(0.4 / period)):
            z = predicted(flow, z, u, period)
        errors.append(float(np.linalg.norm(z - exact)))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.03)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.03)
    assert errors[2] < 2e-3


@settings(PROPERTY, max_examples=20)
@given(st.data(), FLOWS, st.floats(0.05, math.pi), st.floats(-5.0, 5.0))
def test_the_error_after_a_step_is_one_of_the_certified_error_systems(
    predicted: Any, data: st.DataObject, flow: ArmFlow, x_max: float, torque: float
) -> None:
    """The mean value theorem behind the certificate, on true and estimated states at random."""
    truth, estimate = draw_state(data, flow, 2, bound=1.0)
    truth[0] *= x_max
    estimate[0] *= x_max
    u, n = np.array([torque]), flow.state_count
    ahead = [predicted(flow, z, u, flow.period) for z in (truth, estimate)]
    # The second kick changes velocities only, so these are the angles at which it acted.
    if x_max < math.pi:
        assume(max(abs(z[0]) for z in ahead) <= x_max)
    slopes = secant(truth[0], estimate[0]), secant(ahead[0][0], ahead[1][0])
    lowest, highest = math.cos(x_max), 1.0
    assert all(lowest - 1e-15 <= slope <= highest + 1e-15 for slope in slopes)

    # The corner (i, j) of the vertex list has the weight of its slopes' barycentric coordinates.
    second, first = ((slope - lowest) / (highest - lowest) for slope in slopes[::-1])
    weights = [one * other for one in (1.0 - first, first) for other in (1.0 - second, second)]
    if not flow.arm.gravity_torque:
        weights = [1.0]
    vertices = vertices_of(flow, lowest, highest)
    pairs = zip(weights, vertices, strict=True)
    blend = sum((weight * vertex.transition for weight, vertex in pairs), np.zeros((n, n)))
    exact = kick(flow, slopes[1], flow.period) @ expm(drift(flow) * flow.period)
    exact = exact @ kick(flow, slopes[0], flow.period)
    scale = np.abs(exact).max()
    np.testing.assert_allclose(blend, exact, rtol=1e-10, atol=1e-12 * scale)
    error = truth - estimate
    size = 1.0 + np.abs(truth).max() + np.abs(estimate).max() + abs(torque)
    np.testing.assert_allclose(exact @ error, ahead[0] - ahead[1], rtol=0.0, atol=1e-11 * size)


TWO, FAST = per_channel([BIAS.model, BIAS.model]), ElasticJointArm(1e-3, 1e-4, 1e4)


def flow_of(arm: ElasticJointArm = FAST, period: float = 0.005, **others: Any) -> ArmFlow:
    given = {"disturbance": BIAS.model, "process_noise": NOISE, **others}
    return ArmFlow(arm, **given, period=period)


def test_a_wrong_number_is_named() -> None:
    cases: list[tuple[Any, str]] = [
        (lambda: flow_of(period=0.0), "period: expected a finite number above 0, got 0.0"),
        (lambda: ProcessNoise(link=-1.0), "process noise density of the link: expected"),
        (lambda: ProcessNoise(motor=math.inf), "process noise density of the motor: expected"),
        (lambda: flow_of(disturbance=TWO), "disturbance: expected 3 channels, .* got 2"),
        (lambda: flow_of(ElasticJointArm(stiffness=1e150)), "at most 65536 rad in a step of 0.005"),
        (lambda: flow_of(ElasticJointArm(1e-200, 1e-200)), "every entry must be finite"),
        (
            lambda: flow_of(process_noise=ProcessNoise(motor=1e308)),
            r"every entry over a step of 0\.005 s must be finite",
        ),
    ]
    arm = ElasticJointArm()
    cases += [
        (lambda: arm.measured(("elbow",)), r"outputs\[0\]: expected one of link_angle"),
        (lambda: arm.measured(("link_angle",) * 2), r"outputs\[1\]: link_angle is listed already"),
        (lambda: arm.measured(("link_velocity",), (0.1,)), r"outputs\[0\].delay: expected 0 for"),
        (lambda: ElasticJointArm(stiffness=0.0), "stiffness: expected a finite number above 0"),
        (lambda: ElasticJointArm(gravity_torque=-1.0), "gravity_torque: expected .* at least 0"),
    ]
    for build, message in cases:
        with pytest.raises(ModelError, match=message):
            build()


def test_what_each_map_reads_of_the_augmented_state() -> None:
    arm = ElasticJointArm(link_inertia=2.0, motor_inertia=0.5, stiffness=8.0, gravity_torque=3.0)
    models = [CLEAN.model, BIAS.model, RAMP.model, DRIFT.model, sum_of([BIAS, RAMP])]
    outputs = ("motor_angle", "link_angle", "motor_velocity")
    late = {"delays": (0.5, 0.0, 0.0)}
    flow = ArmFlow(arm, per_channel(models), ProcessNoise(), 0.005, outputs, **late)
    state = np.concatenate([arm.from_physical([0.1, 0.2, 0.3, 0.4]), np.arange(1.0, 8.0)])
    # w = [1; 2, 3] of link angle and motor velocity, then [4; 5; 6, 7] of motor and link.
    for found, expected in (
        (flow.disturbance_map, [0.0, 1.0, 2.0]),
        (flow.rate_map, [0.0, 0.0, 3.0]),
        (flow.output_matrix, [0.3 - 0.5 * 0.4, 0.1 + 1.0, 0.4 + 2.0]),
        (flow.torque_map, [4.0, 5.0 + 6.0]),
        (flow.torques, [4.0, 5.0 + 6.0]),
    ):
        np.testing.assert_allclose(found @ state, expected, rtol=1e-14)
    physical = np.concatenate([[0.1, 0.2, 0.3, 0.4], state[4:]])
    np.testing.assert_allclose(flow.to_physical(state), physical[:4])
    alone = ArmFlow(arm, per_channel(models[:3]), ProcessNoise(), 0.005, outputs)
    assert alone.torque_map.shape == (0, 7)


def test_uncertain_parameters_have_corners_of_their_own() -> None:
    """A kick at every corner is the derivative of gravity and of the parameters' torques."""
    arm = ElasticJointArm()
    known = arm_uncertainty(arm, {"gravity": 0.1, "link_inverse_inertia": 0.2})
    vertices = vertices_of(flow_of(arm), 0.5, 1.0, known)
    assert len(vertices) == 16
    assert [each.where for each in vertices[:16:5]] == [
        f"slopes ({slope}, {slope}), link_inverse_inertia ({theta}, {theta})"
        for slope, theta in ((0.35, -0.2), (0.9, -0.2), (0.55, 0.2), (1.3, 0.2))
    ]
    floating = flow_of(ElasticJointArm(gravity_torque=0.0))
    assert [each.where for each in vertices_of(floating, 0.0, 1.0)] == ["no gravity"]


@settings(max_examples=20)
@given(
    ARMS,
    hnp.arrays(np.float64, 4, elements=st.floats(-5.0, 5.0, allow_subnormal=False)),
    hnp.arrays(np.float64, 1, elements=st.floats(-10.0, 10.0)),
)
def test_the_derivative_is_newtons_law_in_physical_coordinates(
    arm: ElasticJointArm, q: Array, u: Array
) -> None:
    rate = arm.to_physical(arm.derivative(arm.from_physical(q), u))
    q1, v1, q2, v2 = q
    twist = arm.stiffness * (q1 - q2)
    link = -(arm.link_damping * v1 + twist + arm.gravity_torque * math.sin(q1)) / arm.link_inertia
    motor = (u[0] + twist - arm.motor_damping * v2) / arm.motor_inertia
    np.testing.assert_allclose(rate, [v1, link, v2, motor], rtol=1e-11, atol=1e-10)
