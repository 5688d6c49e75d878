# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The plant: what a sample means, what a seed means, and what can be changed on the way."""

import hashlib
import math
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import t

from tsobs_ros.checks import Array
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.fuzzy import Always, Gaussian, RuleBase, SineUpper
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.simulation.integrator import ArmIntegrator, Friction, Payload
from tsobs_ros.simulation.plant import (
    Mismatch,
    Plant,
    PlantScenario,
    Sample,
    Scenario,
    SimulatedOutput,
    TorqueDisturbance,
    Trajectories,
)
from tsobs_ros.simulation.scenarios import simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import (
    BiasStep,
    Chirp,
    GaussMarkov,
    Multisine,
    NoTorque,
    Pulses,
    Signal,
    Sine,
    Sinusoid,
    Square,
    StuckSensor,
    TwoTone,
)
from tsobs_ros.simulation.systems import SystemScenario

QUIET = Scenario(
    initial_spread=(0.0,) * 4, process_noise=ProcessNoise(0.0, 0.0), sensor=Sensor(noise_std=0.0)
)


BUSY = Scenario(
    disturbance=(
        Sinusoid(0.2, 3.0, 0.3),
        GaussMarkov(0.1, 5.0, 0.5),
        TwoTone(0.4, 0.7),
        GaussMarkov(),
        StuckSensor(1.0, 0.2),
    ),
    excitation=Multisine(1.7, 0.4, 6.5, 8),
    sensor=Sensor(
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
    mismatch=Mismatch(stiffness=0.2, motor_damping=-0.1),
    friction=Friction(0.1, 0.05, 0.3, 0.15),
    torque_error=(Pulses(50.0, 1.0, 0.005, 0.0),),
    torque_disturbance=TorqueDisturbance(
        motor=(Sinusoid(0.3, 5.0, 0.2, 0.7), GaussMarkov(0.2, 1.0)),
        link=(BiasStep(2.0, 0.4), GaussMarkov(1.0, 0.5, 0.1), GaussMarkov(0.5, 2.0)),
    ),
    payload=Payload(0.3, 3.0, 0.6, 0.5),
)
MANY = replace(
    BUSY,
    disturbance=(),
    sensor=Sensor(),
    outputs=(
        SimulatedOutput("motor_angle", Sensor(0.001, noise_degrees=2), (GaussMarkov(0.1, 2.0),)),
        SimulatedOutput("link_angle", BUSY.sensor, BUSY.disturbance),
        SimulatedOutput("motor_velocity", Sensor(0.1, latency=0.02, dropout_interval=0.4)),
    ),
)
SYSTEM = SystemScenario(
    TSModel(
        A=np.array([[[0.0, 1.0], [-9.81, -0.2]], [[0.0, 1.0], [-4.0, -0.2]]]),
        B=np.array([[0.0], [1.0]]),
        C=np.eye(2),
        rule_base=RuleBase(((Gaussian(0.0, 0.5), SineUpper(1.2)), (Gaussian(1.0, 0.7), Always()))),
        premise=np.array([[1.0, 0.0], [0.5, 0.0]]),
        schedule=np.array([[0.3], [0.0]]),
    ),
    tuple(replace(each, measures=name) for each, name in zip(MANY.outputs, "ab", strict=False)),
    initial_state=(0.4, 0.0),
    initial_spread=(0.1, 0.2),
    process_noise=(1e-4, 1e-3),
    inputs=(Multisine(), Sine(0.5)),
    change=np.full((2, 2, 3), 0.01),
)


def digests() -> list[str]:
    """Return a digest of the runs of each excitation."""
    excitations = (BUSY.excitation, NoTorque(), Sine(1.1, 0.7), Square(2.0, 3.0), Chirp(sweep=1.3))
    scenarios = [replace(BUSY, excitation=each) for each in excitations]
    runs = [Plant(each, [4, 9]).run(300) for each in (*scenarios, MANY, SYSTEM)]
    return [hashlib.sha256(b"".join(map(bytes, run))).hexdigest() for run in runs]


def run(scenario: Scenario, count: int, seeds: Any = 0) -> list[Sample]:
    plant = Plant(scenario, seeds)
    return [plant.step() for _ in range(count)]


def stack(samples: list[Sample], name: str) -> NDArray[np.float64]:
    return np.stack([getattr(sample, name) for sample in samples])


def test_samples_are_what_the_integrator_and_the_formulas_say() -> None:
    scenario = replace(QUIET, disturbance=(Sinusoid(0.2, 3.0, 0.1),))
    integrator, x = ArmIntegrator(scenario.arm, 0.005), scenario.arm.to_physical((0.3, 0, 2, 0))
    for k, sample in enumerate(run(scenario, 100)):
        time = k / 200.0
        d = 0.2 * np.sin(3.0 * (time - 0.1)) if time >= 0.1 else 0.0
        assert (sample.index, sample.time, sample.lost) == (k, time, False)
        assert sample.torque == pytest.approx([np.sin(time)])
        assert sample.physical == pytest.approx(x, abs=1e-13)
        assert sample.state == pytest.approx(scenario.arm.from_physical(x), abs=1e-12)
        assert sample.disturbance == pytest.approx([d], abs=1e-12)
        assert sample.measurement == pytest.approx([x[0] + d], abs=1e-12)
        x = integrator.advance(x, sample.torque)


@pytest.mark.parametrize(
    ("scenario", "seeds"), [(BUSY, range(700)), (MANY, [4, 9, 2]), (SYSTEM, [4, 9, 2])]
)
def test_a_run_is_the_same_bits_in_a_batch_alone_in_one_call_and_sample_by_sample(
    scenario: PlantScenario, seeds: Any
) -> None:
    # Random numbers are drawn 256 samples at a time, of 700 runs 93.
    batch, stepped = Plant(scenario, seeds).run(600), Plant(scenario, seeds)
    stepping = [stepped.step() for _ in range(600)]
    for place, seed in list(enumerate(seeds))[:3]:
        single, parted = Plant(scenario, seed).run(600), Plant(scenario, seed)
        parts = [parted.run(count) for count in (1, 299, 0, 213, 87)]
        for field in Trajectories._fields:
            whole = getattr(single, field)
            assert np.concatenate([getattr(p, field) for p in parts]).tobytes() == whole.tobytes()
            if field != "times":
                assert getattr(batch, field)[place].tobytes() == whole.tobytes()
                steps = stack(stepping, field.removesuffix("s"))[:, place]
                assert steps.tobytes() == whole.tobytes()


def test_a_run_is_the_same_bits_on_another_cpu() -> None:
    features = np.show_config(mode="dicts")["SIMD Extensions"]["found"]
    other = {
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2",
        "NPY_DISABLE_CPU_FEATURES": " ".join(features),
    }
    printed = subprocess.run(
        [sys.executable, "-W", "error", __file__],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), **other},
        check=True,
        capture_output=True,
        text=True,
    )
    assert printed.stdout.split() == digests()


def test_what_others_make_of_torques_and_disturbances_is_used() -> None:
    class Stairs(Signal):
        def _at(self, times: Array) -> Array:
            return np.floor(4.0 * times)

    @dataclass(frozen=True)
    class LouderSine(Sine):
        def _at(self, times: Array) -> Array:
            return 2.0 * super()._at(times)

    class Growth(Signal):
        def _at(self, times: Array) -> Array:
            return times * times

    scenario = replace(QUIET, disturbance=(Growth(), BiasStep(0.5, 0.25)), excitation=LouderSine())
    run, times = Plant(scenario).run(300), np.arange(300) / 200.0
    np.testing.assert_allclose(run.torques[:, 0], 2.0 * np.sin(times), atol=1e-15)
    added = times**2 + 0.5 * (times >= 0.25)
    np.testing.assert_allclose(run.disturbances[:, 0], added, atol=1e-15)
    plant, other = Plant(scenario, [0, 1]), Plant(replace(scenario, disturbance=()), [0, 1])
    for one in (plant, other):
        one.run(100)
        one.exchange_excitation(Stairs())
    later = plant.run(100)
    assert later.torques[1, :, 0].tolist() == [float(k // 50) for k in range(100, 200)]
    added = times[100:200, np.newaxis] ** 2 + 0.5
    assert later.disturbances[0] == pytest.approx(added)
    assert (other.run(100).physical == later.physical).all()


def test_an_arm_that_moves_out_of_all_bounds_is_nan_and_no_exception() -> None:
    plant = Plant(Scenario(disturbance=(StuckSensor(0.0, 1.0),)), [0, 1])
    run = plant.run(4000, np.array([[1e308], [0.0]]).repeat(4000, axis=1)[..., np.newaxis])
    assert np.isnan(run.physical[0, -1]).any()
    assert np.isfinite(run.physical[1]).all()
    assert not plant.step().lost


def test_reset_starts_as_fresh_even_after_changes() -> None:
    scenario = Scenario(disturbance=(GaussMarkov(),))
    plant = Plant(scenario, 7)
    fresh = [plant.step() for _ in range(300)]
    plant.exchange_disturbance((GaussMarkov(1.0), StuckSensor(0.0)))
    plant.exchange_sensor(Sensor(1.0))
    plant.exchange_excitation(NoTorque())
    plant.step(5.0)
    plant.reset()
    assert (plant.index, plant.time) == (0, 0.0)
    again = [plant.step() for _ in range(300)]
    for name in ("physical", "disturbance", "measurement", "torque"):
        assert (stack(fresh, name) == stack(again, name)).all()


@pytest.mark.parametrize(
    "change",
    [
        {"disturbance": (GaussMarkov(0.5, 1.0),)},
        {"sensor": Sensor(0.1, outlier_probability=0.3)},
        {"excitation": NoTorque(), "process_noise": ProcessNoise(1e-6, 1e-6)},
    ],
)
def test_changing_one_source_leaves_the_numbers_of_the_others(change: dict[str, Any]) -> None:
    base = Scenario(disturbance=(GaussMarkov(),))
    before, after = run(base, 200, 3), run(replace(base, **change), 200, 3)

    def noise(samples: list[Sample], scale: float) -> NDArray[np.float64]:
        rest = stack(samples, "measurement") - stack(samples, "disturbance")
        return np.asarray((rest[:, 0] - stack(samples, "physical")[:, 0]) / scale)

    if "sensor" in change:
        assert (stack(before, "physical") == stack(after, "physical")).all()
        assert (stack(before, "disturbance") == stack(after, "disturbance")).all()
        hit = np.abs(noise(after, 0.1) - noise(before, 0.028)) > 1e-6
        assert 30 < hit.sum() < 90  # the outliers, 60 ± 6.5
    else:
        np.testing.assert_allclose(noise(after, 0.028), noise(before, 0.028), atol=1e-12)
        assert (before[0].physical == after[0].physical).all()
        changed = "disturbance" if "disturbance" in change else "physical"
        kept = "physical" if "disturbance" in change else "disturbance"
        assert (stack(before, kept) == stack(after, kept)).all()
        assert not np.allclose(stack(before, changed), stack(after, changed), atol=1e-3)


def test_a_command_takes_the_place_of_the_excitation() -> None:
    commanded, plain = Plant(QUIET), Plant(replace(QUIET, excitation=NoTorque()))
    for _ in range(20):
        assert commanded.step(0.0).physical == pytest.approx(plain.step().physical, abs=0.0)
    assert commanded.step(2.5).torque == [2.5]
    assert commanded.step().torque == pytest.approx([np.sin(21 / 200)])


def test_senseless_commands_are_refused_and_change_nothing() -> None:
    plant, other = Plant(Scenario(), [1, 2]), Plant(Scenario(), [1, 2])
    with pytest.raises(ModelError, match="torque of sample 0: expected finite"):
        plant.step(np.nan)
    with pytest.raises(ModelError, match=r"torque: expected shape \(2, 1\), got \(3, 1\)"):
        plant.step(np.zeros((3, 1)))
    assert (plant.step().measurement == other.step().measurement).all()


def test_a_stuck_sensor_freezes_the_measured_value() -> None:
    scenario = Scenario(disturbance=(BiasStep(0.1, 0.0), StuckSensor(0.5, 0.25)))
    samples = run(scenario, 200)
    measured = stack(samples, "measurement")[:, 0]
    angle, d = stack(samples, "physical")[:, 0], stack(samples, "disturbance")[:, 0]
    assert (measured[100:150] == measured[100]).all()
    assert len(np.unique(measured)) == 151
    np.testing.assert_allclose(d[100:150], measured[100] - angle[100:150], atol=1e-15)
    np.testing.assert_allclose(np.delete(d, np.s_[100:150]), 0.1)
    unstuck = stack(run(replace(scenario, disturbance=(BiasStep(0.1, 0.0),)), 200), "measurement")
    assert (unstuck[150:, 0] == measured[150:]).all()
    forever = stack(
        run(replace(scenario, disturbance=(StuckSensor(0.5, math.inf),)), 200), "measurement"
    )
    assert (forever[100:] == forever[100]).all()


def test_a_disturbance_put_in_on_the_way_counts_its_own_time() -> None:
    plant = Plant(QUIET)
    for _ in range(100):
        plant.step()
    plant.exchange_disturbance((BiasStep(0.2, 0.05),))
    values = [plant.step().disturbance.item() for _ in range(20)]
    assert values == [0.0] * 10 + [0.2] * 10


def test_dropouts_come_when_they_should() -> None:
    sensor = Sensor(dropout_interval=0.3, dropout_duration=0.1)
    samples = run(replace(QUIET, sensor=sensor), 240)
    lost = {k for start in (60, 120, 180) for k in range(start, start + 20)}
    assert {s.index for s in samples if s.lost} == lost
    assert {s.index for s in samples if np.isnan(s.measurement).any()} == lost
    assert np.isfinite(stack(samples, "disturbance")).all()


def noise_of(sensor: Sensor, seeds: Any = range(20), seconds: float = 10.0) -> NDArray[np.float64]:
    """Return what a sensor adds to the angle, shape (runs, samples)."""
    runs = simulate(Scenario(sensor=sensor), seeds, seconds)
    return np.asarray(runs.measurements[..., 0] - runs.physical[..., 0])


def test_correlated_noise_has_the_stated_spread_and_memory() -> None:
    noise = noise_of(Sensor(0.1, noise_time_constant=0.05))
    ages = np.arange(0, 40, 5)
    products = [np.mean(noise[:, age:] * noise[:, : noise.shape[1] - age]) for age in ages]
    np.testing.assert_allclose(products, 0.01 * np.exp(-ages * 0.005 / 0.05), atol=4e-4)
    np.testing.assert_allclose(noise_of(Sensor(0.1), range(4000), 0.0).std(), 0.1, rtol=0.05)


def test_noise_of_students_t_has_its_tails() -> None:
    noise = np.sort(np.abs(noise_of(Sensor(0.1, noise_degrees=3)).ravel()))
    shares = np.array([0.5, 0.9, 0.99, 0.999])
    expected = 0.1 * t.ppf(0.5 + 0.5 * shares, 3)
    np.testing.assert_allclose(np.quantile(noise, shares), expected, rtol=0.08)


def test_noise_is_louder_in_bursts() -> None:
    burst = Sensor(0.1, burst_interval=2.0, burst_duration=0.5, burst_factor=3.0)
    noise, calm = noise_of(burst, [3]), noise_of(Sensor(0.1), [3])
    times = np.arange(noise.shape[1]) / 200.0
    loud = (times >= 2.0) & (times % 2.0 < 0.5)
    np.testing.assert_allclose(noise, np.where(loud, 3.0, 1.0) * calm, atol=1e-12)


def test_outliers_may_have_any_size_up_to_the_stated_one() -> None:
    kind = Sensor(0.0, outlier_probability=0.2, outlier_size=3.0, outlier_is_uniform=True)
    noise = noise_of(kind).ravel()
    added = noise[np.abs(noise) > 1e-12]
    assert len(added) / len(noise) == pytest.approx(0.2, rel=0.05)
    counts, _ = np.histogram(added, bins=6, range=(-3.0, 3.0))
    np.testing.assert_allclose(counts / len(added), 1 / 6, rtol=0.1)


def test_an_old_angle_is_measured_in_steps() -> None:
    sensor = Sensor(0.0, latency=0.02, resolution=0.01)
    plant = Plant(replace(QUIET, disturbance=(BiasStep(0.1, 0.5),), sensor=sensor))
    run = plant.run(300)
    angle, d = run.physical[:, 0], run.disturbances[:, 0]
    old = np.concatenate([np.full(4, angle[0]), angle[:-4]])
    np.testing.assert_allclose(run.measurements[:, 0], 0.01 * np.round((old + d) / 0.01))
    # The angles before a change of the latency are not known any more.
    plant.exchange_sensor(Sensor(0.0, latency=0.01))
    later = plant.run(10)
    now = later.physical[:, 0]
    expected = np.concatenate([np.full(2, now[0]), now[:-2]]) + 0.1
    np.testing.assert_allclose(later.measurements[:, 0], expected)


def test_the_arm_does_not_feel_an_error_of_the_reported_torque() -> None:
    right = Plant(QUIET).run(100)
    wrong = Plant(replace(QUIET, torque_error=(Pulses(50.0, 0.1, 0.01, 0.2),))).run(100)
    assert (wrong.physical == right.physical).all()
    changed = wrong.torques[:, 0] - right.torques[:, 0]
    assert np.flatnonzero(changed).tolist() == [20, 21, 60, 61]
    np.testing.assert_allclose(changed[changed != 0.0], 50.0)


def test_each_output_measures_its_quantity_by_its_own_sensor() -> None:
    names = ("motor_velocity", "link_angle", "motor_angle", "link_velocity")
    sensors = [
        Sensor(0.5, dropout_interval=0.3, dropout_duration=0.1),
        Sensor(0.0, resolution=0.01, dropout_interval=0.3, dropout_duration=0.2),
        Sensor(0.001),
        Sensor(0.001),
    ]
    outputs = [
        SimulatedOutput(name, sensor, (BiasStep(0.1 * k, 0.5),))
        for k, (name, sensor) in enumerate(zip(names, sensors, strict=True))
    ]
    scenario = replace(QUIET, sensor=Sensor(), outputs=tuple(outputs))
    plant = Plant(scenario, 5)
    samples = [plant.step() for _ in range(400)]
    truth, y = stack(samples, "physical")[:, [3, 0, 2, 1]], stack(samples, "measurement")
    late = np.arange(400) >= 100
    expected = late[:, np.newaxis] * 0.1 * np.arange(4)
    np.testing.assert_allclose(stack(samples, "disturbance"), expected, atol=1e-15)
    noise = y - truth - expected
    gone = [(np.arange(400) % 60 < n) & (np.arange(400) >= 60) for n in (20, 40, 0, 0)]
    assert (np.isnan(y) == np.stack(gone, axis=1)).all()
    assert not any(sample.lost for sample in samples)
    assert np.nanmax(np.abs(noise[:, 1])) <= 0.005 + 1e-12
    np.testing.assert_allclose(np.nanstd(noise, axis=0)[[0, 2, 3]], [0.5, 1e-3, 1e-3], rtol=0.1)
    assert abs(np.corrcoef(noise[:, 2], noise[:, 3])[0, 1]) < 0.2
    # A plant with the first of them alone has the same numbers.
    alone = Plant(replace(scenario, outputs=(outputs[0],)), 5).run(400)
    assert alone.measurements[:, 0].tobytes() == y[:, 0].tobytes()
    plant.exchange_sensor(Sensor(0.0), 2)
    plant.exchange_disturbance((BiasStep(0.7, 0.0),), 2)
    later = plant.step()
    assert later.measurement[2] == later.physical[2] + 0.7
    assert later.disturbance[[1, 3]] == pytest.approx([0.1, 0.3])


def test_torques_that_the_model_lacks_are_what_moves_the_arm_otherwise() -> None:
    arm = ElasticJointArm(link_damping=0.2, motor_damping=0.3, gravity_torque=9.0)
    # At 5 kHz a difference of speeds is the acceleration that the truth speaks of.
    scenario = replace(
        QUIET,
        arm=arm,
        mismatch=Mismatch(stiffness=0.2),
        rate=5000.0,
        friction=Friction(0.1, 0.05, 0.3, 0.15),
        payload=Payload.point(0.5, 0.8, 0.4, 0.5),
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


def test_a_payload_makes_another_arm_for_a_while() -> None:
    payload = Payload(0.3, 4.0, start=0.5, duration=0.25)
    run = Plant(replace(QUIET, payload=payload)).run(201)
    nominal = ArmIntegrator(ElasticJointArm(), 0.005)
    heavy = ArmIntegrator(ElasticJointArm(link_inertia=1.3, gravity_torque=14.0), 0.005)
    for k in range(200):
        integrator = heavy if 100 <= k < 150 else nominal
        assert (integrator.advance(run.physical[k], run.torques[k]) == run.physical[k + 1]).all()
    assert not run.torque_disturbances[:100].any()
    assert not run.torque_disturbances[150:].any()
    assert run.torque_disturbances[100:150, 1].all()
    assert not run.torque_disturbances[:, 0].any()


def test_play_frees_the_spring_within_it_and_is_a_torque_that_the_nominal_arm_lacks() -> None:
    still = replace(QUIET, initial_state=(0.0,) * 4, excitation=NoTorque(), backlash=0.04)
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


def test_samples_get_lost_each_by_itself_and_no_outlier_does() -> None:
    sensor = Sensor(0.0, outlier_probability=0.5, loss_probability=0.2)
    run = Plant(replace(QUIET, sensor=sensor), [1, 2, 3]).run(4000)
    lost = np.isnan(run.measurements[..., 0])
    far = np.abs(run.measurements - run.physical[..., :1])[..., 0] > 0.5
    assert lost.mean() == pytest.approx(0.2, abs=0.02)
    assert (lost[:, 1:] & lost[:, :-1]).mean() == pytest.approx(0.04, abs=0.01)
    assert far.mean() == pytest.approx(0.5, abs=0.03)
    with pytest.raises(ModelError, match="loss_probability: expected 0 to 1, got"):
        Sensor(loss_probability=1.5)


def test_torque_disturbances_are_exchanged_on_the_way_and_move_an_arm_without_gravity() -> None:
    arm = ElasticJointArm(gravity_torque=0.0)
    rest = replace(QUIET, arm=arm, excitation=NoTorque(), initial_state=(0.0,) * 4)
    plant = Plant(rest)
    assert not plant.run(100).physical.any()
    plant.exchange_torque_disturbance((Pulses(2.0, 0.1, 0.1, 0.0),), 1)
    run = plant.run(400)
    assert np.flatnonzero(run.torque_disturbances[:, 1]).tolist() == list(range(20, 40))
    # What the pulse gave both inertias stays.
    momentum = run.physical[:, 1] * arm.link_inertia + run.physical[:, 3] * arm.motor_inertia
    np.testing.assert_allclose(momentum[40:], 0.2, atol=1e-9)


def test_mismatch_changes_the_arm_but_not_its_start() -> None:
    changes = Mismatch(stiffness=0.2, gravity_torque=-0.1)
    scenario = replace(QUIET, mismatch=changes)
    assert scenario.true_arm == ElasticJointArm(stiffness=12.0, gravity_torque=9.0)
    first, second = run(scenario, 2)
    assert first.state == pytest.approx([0.3, 0.0, 2.0, 0.0])
    x = ArmIntegrator(scenario.true_arm, 0.005).advance(first.physical, first.torque)
    assert second.physical == pytest.approx(x, abs=1e-15)
    # Design coordinates are the nominal arm's, so their motor angle is k/J1 = 10 times the true.
    assert second.state[2] == pytest.approx(10.0 * x[2])


def test_process_noise_has_the_stated_density() -> None:
    scenario = Scenario(
        initial_spread=(0.0,) * 4, process_noise=ProcessNoise(4e-4, 9e-5), excitation=Sine()
    )
    noisy = run(scenario, 2, range(4000))[1].physical
    calm = run(replace(scenario, process_noise=ProcessNoise(0.0, 0.0)), 2)[1].physical
    spread = (noisy - calm).std(axis=0)[[1, 3]]
    # Over 5 ms the spring carries almost nothing from one velocity to the other.
    np.testing.assert_allclose(spread, np.sqrt(np.array([4e-4, 9e-5]) * 0.005), rtol=0.05)


def test_a_seed_repeats_out_of_an_array_too_and_another_does_not() -> None:
    first, again, other = (
        stack(run(Scenario(), 50, seed), "measurement") for seed in (1, np.arange(3)[1], 2)
    )
    assert (first == again).all()
    assert not (first == other).any()


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: replace(QUIET, rate=0.0), "rate"),
        (lambda: replace(QUIET, duration=-1.0), "duration"),
        (lambda: replace(QUIET, initial_state=(0.0, 0.0)), "initial_state: expected four"),
        (
            lambda: replace(QUIET, initial_spread=(0.0, 0.0, 0.0, np.nan)),
            "initial_spread: expected four finite",
        ),
        (lambda: Mismatch(stiffness=-1.0), "mismatch stiffness: expected a finite number above -1"),
        (lambda: Sensor(outlier_probability=1.1), "outlier_probability: expected 0 to 1"),
        (lambda: Sensor(noise_std=-0.1), "noise_std"),
        (lambda: Sensor(latency=-0.1), "latency"),
        (lambda: Friction(motor_coulomb=-0.1), "friction motor_coulomb"),
        (lambda: Payload(-0.1), "payload link_inertia: expected a finite number of at least 0"),
        (lambda: Payload.point(1.0, math.nan), "payload distance: expected a finite number"),
        (lambda: TorqueDisturbance(link=(StuckSensor(),)), "torque_disturbance link: expected"),
        (
            lambda: replace(QUIET, outputs=(SimulatedOutput("motor_angle"),)),
            "outputs: expected none beside `sensor`",
        ),
        (
            lambda: Scenario(outputs=(SimulatedOutput("elbow"),)),
            r"outputs\[0\].measures: expected one of link_angle, .*, got 'elbow'",
        ),
        (
            lambda: Scenario(outputs=(SimulatedOutput(), SimulatedOutput())),
            r"outputs\[1\].measures: link_angle is listed twice",
        ),
        (lambda: Plant(QUIET, -1), "seeds: expected integers of at least 0"),
        (lambda: Plant(QUIET, []), "seeds: expected integers of at least 0"),
        (lambda: Plant(QUIET, [3, -2]), "seeds: expected integers of at least 0"),
    ],
)
def test_senseless_numbers_are_refused(make: Callable[[], object], complaint: str) -> None:
    with pytest.raises(ModelError, match=complaint):
        make()


if __name__ == "__main__":
    print(*digests())
