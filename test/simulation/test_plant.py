# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The plant: what a sample means, what a seed means, and what can be changed on the way."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import t

from tsobs_ros.checks import Array
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm, TorquePath
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.simulation.plant import (
    Friction,
    Mismatch,
    Payload,
    Plant,
    PlantScenario,
    Scenario,
    SimulatedOutput,
    SystemScenario,
    TorqueDisturbance,
    Trajectories,
)
from tsobs_ros.simulation.scenarios import SCENARIOS, arm_with, simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import (
    BiasStep,
    GaussMarkov,
    Multisine,
    Pulses,
    Signal,
    Sine,
    Sinusoid,
    StuckSensor,
)

STILL: Any = {"initial_spread": (0.0,) * 4, "process_noise": ProcessNoise(0.0, 0.0)}
QUIET = arm_with(Sensor(noise_std=0.0), **STILL)

BUSY = arm_with(
    Sinusoid(0.2, 3.0, 0.3),
    GaussMarkov(0.1, 5.0, 0.5),
    GaussMarkov(),
    StuckSensor(1.0, 0.2),
    Sensor(
        outlier_probability=0.1,
        dropout_interval=0.5,
        dropout_duration=0.1,
        outlier_is_uniform=True,
        noise_time_constant=0.05,
        noise_degrees=3,
        burst_interval=0.7,
        burst_duration=0.2,
        latency=0.01,
        resolution=0.001,
    ),
    Mismatch(stiffness=0.2, motor_damping=-0.1),
    Friction(0.1, 0.05, 0.3, 0.15),
    Payload(0.3, 3.0, 0.6, 0.5),
    inputs=(Multisine(1.7, 0.4, 6.5, 8),),
    torque_error=(Pulses(50.0, 1.0, 0.005, 0.0),),
    torque_disturbance=TorqueDisturbance(
        motor=(Sinusoid(0.3, 5.0, 0.2, 0.7), GaussMarkov(0.2, 1.0)),
        link=(BiasStep(2.0, 0.4), GaussMarkov(1.0, 0.5, 0.1), GaussMarkov(0.5, 2.0)),
    ),
)
MANY = replace(
    BUSY,
    outputs=(
        SimulatedOutput("motor_angle", Sensor(0.001, noise_degrees=2), (GaussMarkov(0.1, 2.0),)),
        *BUSY.outputs,
        SimulatedOutput("motor_velocity", Sensor(0.1, latency=0.02, dropout_interval=0.4)),
    ),
)
MODEL = TSModel(
    A=np.array([[[0.0, 1.0], [-9.81, -0.2]], [[0.0, 1.0], [-4.0, -0.2]]]),
    B=np.array([[0.0], [1.0]]),
    C=np.eye(2),
    rule_base=RuleBase(
        (
            (
                membership("gaussian", {"centre": 0.0, "width": 0.5}),
                membership("sine_upper", {"half_width": 1.2}),
            ),
            (membership("gaussian", {"centre": 1.0, "width": 0.7}), membership("always")),
        )
    ),
    premise=np.array([[1.0, 0.0], [0.5, 0.0]]),
    schedule=np.array([[0.3], [0.0]]),
)
SYSTEM = SystemScenario(
    model=MODEL,
    true_rates=MODEL.rates + 0.01,
    outputs=tuple(
        replace(each, measures=name) for each, name in zip(MANY.outputs, "ab", strict=False)
    ),
    inputs=(Multisine(), Sine(0.5)),
    fed_back=(None,),
    process_noise=np.array([1e-4, 1e-3]),
    rate=200.0,
    initial_state=(0.4, 0.0),
)


def measured(run: Any, number: int = 0) -> Array:
    """Return what a sensor adds to the link angle beside its disturbance."""
    rest = run.measurements - run.disturbances - run.physical[..., :1]
    return np.asarray(rest[..., number])


@pytest.mark.parametrize("scenario", [BUSY, MANY, SYSTEM, replace(SYSTEM, fed_back=(1,))])
def test_a_run_is_the_same_bits_in_a_batch_alone_in_one_call_and_sample_by_sample(
    scenario: PlantScenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    stepped, seeds = Plant(scenario, [4, 9]), [4, 9]
    stepping = [stepped.step() for _ in range(300)]
    assert [each.times for each in stepping] == [k / 200.0 for k in range(300)]
    monkeypatch.setattr("tsobs_ros.simulation.plant._BLOCK", 256)
    batch = Plant(scenario, seeds).run(300)
    for place, seed in enumerate(seeds):
        single, parted = Plant(scenario, seed).run(300), Plant(scenario, seed)
        parts = [parted.run(count) for count in (1, 149, 0, 113, 37)]
        for field in Trajectories._fields:
            whole = getattr(single, field)
            assert np.concatenate([getattr(p, field) for p in parts]).tobytes() == whole.tobytes()
            if field != "times":
                assert getattr(batch, field)[place].tobytes() == whole.tobytes()
                steps = [getattr(each, field)[place] for each in stepping]
                assert np.stack(steps).tobytes() == whole.tobytes()


@pytest.mark.parametrize(
    ("other", "changed"),
    [
        (arm_with(GaussMarkov(0.5, 1.0)), "disturbances"),
        (
            arm_with(GaussMarkov(), inputs=(Signal(),), process_noise=ProcessNoise(1e-6, 1e-6)),
            "physical",
        ),
        (arm_with(GaussMarkov(), Sensor(0.056, outlier_probability=0.3)), "measurements"),
    ],
)
def test_changing_one_source_leaves_the_numbers_of_the_others(
    other: Scenario, changed: str
) -> None:
    before, after = Plant(arm_with(GaussMarkov()), 3).run(200), Plant(other, 3).run(200)
    for name in {"disturbances", "physical"} - {changed}:
        assert (getattr(before, name) == getattr(after, name)).all()
    assert not np.allclose(getattr(before, changed), getattr(after, changed), atol=1e-3)
    if changed == "measurements":
        hit = np.abs(measured(after) - 2.0 * measured(before)) > 1e-6
        assert 30 < hit.sum() < 90  # the outliers, 60 ± 6.5


def test_a_command_takes_the_place_of_the_excitation() -> None:
    commanded, plain = Plant(QUIET), Plant(replace(QUIET, inputs=(Signal(),)))
    assert (commanded.run(20, 0.0).physical == plain.run(20).physical).all()
    assert commanded.step(2.5).torques == [2.5]
    assert commanded.step().torques == pytest.approx([np.sin(21 / 200)])
    with pytest.raises(ModelError, match="torque of sample 22: expected finite"):
        commanded.step(np.nan)
    with pytest.raises(ModelError, match=r"torque: expected shape \(1, 1\), got \(3, 1, 1\)"):
        commanded.step(np.zeros((3, 1)))
    assert commanded.step().times == 22 / 200


def test_a_stuck_sensor_freezes_the_measured_value() -> None:
    bias = BiasStep(0.1, 0.0)
    stuck, free, forever = (
        Plant(arm_with(*signals)).run(200)
        for signals in ((bias, StuckSensor(0.5, 0.25)), (bias,), (StuckSensor(0.5, 0.0),))
    )
    y, d = stuck.measurements[:, 0], stuck.disturbances[:, 0]
    assert (y[100:150] == y[100]).all()
    assert len(np.unique(y)) == 151
    np.testing.assert_allclose(d[100:150], y[100] - stuck.physical[100:150, 0], atol=1e-15)
    np.testing.assert_allclose(np.delete(d, np.s_[100:150]), 0.1)
    assert (free.measurements[150:, 0] == y[150:]).all()
    assert (forever.measurements[100:] == forever.measurements[100]).all()


def noise_of(sensor: Sensor, seeds: Any = range(20), seconds: float = 10.0) -> Array:
    """Return what a sensor adds to the angle, shape (runs, samples)."""
    return measured(simulate(arm_with(sensor), seeds, seconds))


def test_correlated_noise_has_the_stated_spread_and_memory() -> None:
    noise = noise_of(Sensor(0.1, noise_time_constant=0.05))
    ages = np.arange(0, 40, 5)
    products = [np.mean(noise[:, age:] * noise[:, : noise.shape[1] - age]) for age in ages]
    np.testing.assert_allclose(products, 0.01 * np.exp(-ages * 0.005 / 0.05), atol=4e-4)
    np.testing.assert_allclose(noise_of(Sensor(0.1), range(2000), 0.0).std(), 0.1, rtol=0.05)


def test_noise_of_students_t_has_its_tails() -> None:
    noise = np.abs(noise_of(Sensor(0.1, noise_degrees=3)).ravel())
    shares = np.array([0.5, 0.9, 0.99, 0.999])
    expected = 0.1 * t.ppf(0.5 + 0.5 * shares, 3)
    np.testing.assert_allclose(np.quantile(noise, shares), expected, rtol=0.08)


def test_outliers_may_have_any_size_up_to_the_stated_one_and_losses_hit_no_outlier() -> None:
    kind = Sensor(0.0, outlier_probability=0.2, outlier_size=3.0, outlier_is_uniform=True)
    noise = noise_of(replace(kind, loss_probability=0.3)).ravel()
    added = noise[np.abs(noise) > 1e-12]
    assert len(added) / len(noise) == pytest.approx(0.2, rel=0.05)
    counts, _ = np.histogram(added, bins=6, range=(-3.0, 3.0))
    np.testing.assert_allclose(counts / len(added), 1 / 6, rtol=0.1)
    lost = np.isnan(noise)
    assert lost.mean() == pytest.approx(0.3, abs=0.02)
    assert (lost[1:] & lost[:-1]).mean() == pytest.approx(0.09, abs=0.01)


def test_an_old_angle_is_measured_in_steps() -> None:
    sensor = Sensor(0.0, latency=0.02, resolution=0.01)
    plant = Plant(arm_with(sensor, BiasStep(0.1, 0.5), **STILL))
    run = plant.run(300)
    angle, d = run.physical[:, 0], run.disturbances[:, 0]
    old = np.concatenate([np.full(4, angle[0]), angle[:-4]])
    np.testing.assert_allclose(run.measurements[:, 0], 0.01 * np.round((old + d) / 0.01))
    # The angles before a change of the latency are not known any more.
    plant.exchange(arm_with(Sensor(0.0, latency=0.01), BiasStep(0.1, 0.5), **STILL))
    later = plant.run(10)
    now = later.physical[:, 0]
    expected = np.concatenate([np.full(2, now[0]), now[:-2]]) + 0.1
    np.testing.assert_allclose(later.measurements[:, 0], expected)


def test_each_output_measures_its_quantity_by_its_own_sensor() -> None:
    names = ("motor_velocity", "link_angle", "motor_angle", "link_velocity")
    sensors = [
        Sensor(0.5, dropout_interval=0.3, dropout_duration=0.1),
        Sensor(0.0, resolution=0.01),
        Sensor(0.001),
        Sensor(0.001),
    ]
    outputs = [
        SimulatedOutput(name, sensor, (BiasStep(0.1 * k, 0.5),))
        for k, (name, sensor) in enumerate(zip(names, sensors, strict=True))
    ]
    scenario = replace(QUIET, outputs=tuple(outputs))
    plant = Plant(scenario, 5)
    run = plant.run(400)
    truth, y = run.physical[:, [3, 0, 2, 1]], run.measurements
    late = np.arange(400) >= 100
    expected = late[:, np.newaxis] * 0.1 * np.arange(4)
    np.testing.assert_allclose(run.disturbances, expected, atol=1e-15)
    noise = y - truth - expected
    gone = [(np.arange(400) % 60 < n) & (np.arange(400) >= 60) for n in (20, 0, 0, 0)]
    assert (np.isnan(y) == np.stack(gone, axis=1)).all()
    assert np.nanmax(np.abs(noise[:, 1])) <= 0.005 + 1e-12
    np.testing.assert_allclose(np.nanstd(noise, axis=0)[[0, 2, 3]], [0.5, 1e-3, 1e-3], rtol=0.1)
    assert abs(np.corrcoef(noise[:, 2], noise[:, 3])[0, 1]) < 0.2
    outputs[2] = replace(outputs[2], sensor=Sensor(0.0), disturbance=(BiasStep(0.7, 0.0),))
    plant.exchange(replace(scenario, outputs=tuple(outputs)))
    later = plant.step()
    assert later.measurements[2] == later.physical[2] + 0.7
    assert later.disturbances[[1, 3]] == pytest.approx([0.1, 0.3])


def test_torques_that_the_model_lacks_are_what_moves_the_arm_otherwise() -> None:
    arm = ElasticJointArm(link_damping=0.2, motor_damping=0.3, gravity_torque=9.0)
    # At 5 kHz a difference of speeds is the acceleration that the truth speaks of.
    scenario = replace(
        QUIET,
        arm=arm,
        mismatch=Mismatch(stiffness=0.2),
        rate=5000.0,
        friction=Friction(0.1, 0.05, 0.3, 0.15),
        payload=Payload(mass=0.5, distance=0.8, start=0.4, duration=0.5),
        torque_disturbance=TorqueDisturbance((Sinusoid(0.5, 9.0, 0.1),), (BiasStep(3.0, 0.2),)),
        torque_error=(Pulses(0.4, 0.3, 0.1, 0.0),),
    )
    run, true = Plant(scenario).run(6001), scenario.true_arm
    q1, v1, q2, v2 = run.physical.T
    spring = true.stiffness * (q2 - q1)
    rates = np.diff(run.physical, axis=0) * scenario.rate
    weight = true.gravity_torque * np.sin(q1)
    lacking_link = true.link_inertia * rates[:, 1] - (spring - weight - 0.2 * v1)[:-1]
    lacking_motor = true.motor_inertia * rates[:, 3] - (run.torques[:, 0] - spring - 0.3 * v2)[:-1]
    motor, link = run.torque_disturbances[:-1].T
    assert np.quantile(np.abs(lacking_link - link), 0.999) < 0.02
    assert np.quantile(np.abs(lacking_motor - motor), 0.999) < 0.02
    assert np.ptp(link) > 3.0
    assert np.ptp(motor) > 0.8
    plain = Plant(replace(scenario, torque_disturbance=TorqueDisturbance())).run(1001)
    assert (plain.physical[:501] == run.physical[:501]).all()


def test_play_frees_the_spring_within_it_and_is_a_torque_that_the_nominal_arm_lacks() -> None:
    still = replace(QUIET, initial_state=(0.0,) * 4, inputs=(Signal(),), backlash=0.04)
    arm = still.arm
    free, held = (
        Plant(
            replace(still, initial_state=tuple(arm.from_physical([0.0, 0.0, twist, 0.0]).tolist()))
        ).run(2)
        for twist in (0.02, 0.03)
    )
    assert not free.physical[1, [1, 3]].any()
    assert free.torque_disturbances[0] == pytest.approx([0.2, -0.2])
    assert held.torque_disturbances[0] == pytest.approx([0.2, -0.2])
    speeds = [0.1 / arm.link_inertia * 0.005, -0.1 / arm.motor_inertia * 0.005]
    assert held.physical[1, [1, 3]] == pytest.approx(speeds, rel=0.01)


def test_mismatch_changes_the_arm_but_not_its_start() -> None:
    scenario = replace(QUIET, mismatch=Mismatch(stiffness=0.2, gravity_torque=-0.1))
    true = ElasticJointArm(stiffness=12.0, gravity_torque=9.0)
    assert scenario.true_arm == true
    run = Plant(scenario).run(20)
    start = tuple(true.from_physical(run.physical[0]).tolist())
    other = Plant(replace(QUIET, arm=true, initial_state=start)).run(20)
    np.testing.assert_allclose(run.physical, other.physical, rtol=0.0, atol=1e-13)
    # Design coordinates are the nominal arm's, so their motor angle is k/J1 = 10 times the true.
    assert run.states[0] == pytest.approx([0.3, 0.0, 2.0, 0.0])
    weak, torque = replace(QUIET, mismatch=Mismatch(torque_gain=-0.2)), np.full((20, 1), 3.0)
    known = Plant(replace(QUIET, torque=TorquePath(gain=0.8)))
    run, other = Plant(weak).run(20, torque), known.run(20, torque)
    assert (run.physical == other.physical).all()
    assert (run.torques == torque).all()


def test_process_noise_has_the_stated_density() -> None:
    scenario = replace(QUIET, process_noise=ProcessNoise(4e-4, 9e-5))
    noisy = Plant(scenario, range(2000)).run(2).physical[:, 1]
    spread = (noisy - Plant(QUIET).run(2).physical[1]).std(axis=0)[[1, 3]]
    # Over 5 ms the spring carries almost nothing from one velocity to the other.
    np.testing.assert_allclose(spread, np.sqrt(np.array([4e-4, 9e-5]) * 0.005), rtol=0.05)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: replace(QUIET, rate=0.0), "rate"),
        (lambda: replace(QUIET, initial_state=(0.0, 0.0)), r"initial_state: expected shape \(4,\)"),
        (lambda: replace(QUIET, mismatch=Mismatch(stiffness=-1.0)), "stiffness"),
        (lambda: Sensor(outlier_probability=1.1), "sensor outlier_probability: expected"),
        (lambda: Sensor(outlier_size=math.inf), "sensor outlier_size: expected a finite number"),
        (lambda: Friction(motor_coulomb=-0.1), "friction motor_coulomb"),
        (
            lambda: Scenario(torque_disturbance=TorqueDisturbance(link=(StuckSensor(),))),
            "torque_disturbance link: expected torques",
        ),
        (lambda: Scenario(torque_error=(StuckSensor(),)), "torque_error: expected torques"),
        (
            lambda: Scenario(outputs=(SimulatedOutput("elbow"),)),
            r"outputs\[0\]: expected one of link_angle, .*, got 'elbow'",
        ),
        (
            lambda: Scenario(outputs=(SimulatedOutput(), SimulatedOutput())),
            r"outputs\[1\]: link_angle is listed already",
        ),
        (lambda: Plant(QUIET, -1), "seeds: expected integers of at least 0"),
        (lambda: Plant(QUIET, 1.5), "seeds: expected integers of at least 0"),
    ],
)
def test_senseless_numbers_are_refused(make: Callable[[], object], complaint: str) -> None:
    with pytest.raises(ModelError, match=complaint):
        make()


def test_start_and_noise_have_the_stated_statistics() -> None:
    runs = simulate(SCENARIOS["noise"], range(2000), 0.05)
    start = runs.states[:, 0]
    # 2000 runs: 1σ of a mean is 2.2 % of the spread, of a standard deviation 1.6 %.
    spread = np.array([0.05, 0.1, 0.5, 0.5])
    np.testing.assert_allclose((start.mean(axis=0) - [0.3, 0, 2, 0]) / spread, 0.0, atol=0.09)
    np.testing.assert_allclose(start.std(axis=0), spread, rtol=0.065)
    np.testing.assert_allclose(np.corrcoef(start.T), np.eye(4), atol=0.09)
    noise = runs.measurements[..., 0] - runs.states[..., 0]
    assert noise.std() == pytest.approx(0.028, rel=0.02)
    assert not runs.disturbances.any()


def test_an_arm_is_held_where_it_is() -> None:
    runs = simulate(replace(SCENARIOS["held"], process_noise=ProcessNoise(0.0, 0.0)), [0], 10.0)
    assert runs.physical[0, -1] == pytest.approx([0.5, 0.0, 0.5 + np.sin(0.5), 0.0], abs=1e-9)
