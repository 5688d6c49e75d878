# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every torque and every disturbance against its formula."""

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tsobs_ros.checks import Array
from tsobs_ros.errors import TsobsError
from tsobs_ros.simulation.plant import Plant
from tsobs_ros.simulation.scenarios import arm_with
from tsobs_ros.simulation.signals import (
    EXCITATIONS,
    KINDS,
    BiasStep,
    Chirp,
    Constant,
    GaussMarkov,
    Multisine,
    Pulses,
    Ramp,
    Signal,
    Sine,
    Sinusoid,
    Square,
    StuckSensor,
    signal_of,
)

TIMES = [0.0, 1.0, 1.999, 2.0, 2.5, 3.0, 10.0, 29.995, 30.0, 59.0]


def disturbances(components: tuple[Signal, ...], seeds: Any, samples: int) -> Array:
    return Plant(arm_with(*components), seeds).run(samples).disturbances[..., 0]


def test_drift_obeys_its_recursion_and_leaves_zero_at_its_start() -> None:
    period, tau, std = 0.005, 2.0, 0.3
    values = disturbances((GaussMarkov(std, tau, 0.1),), range(300), 1000).T
    assert not values[:21].any()
    assert values[21].all()
    steps = values[21:] - math.exp(-period / tau) * values[20:-1]
    assert steps.std() == pytest.approx(std * math.sqrt(1 - math.exp(-2 * period / tau)), rel=6e-3)
    assert abs(np.mean(steps[1:] * steps[:-1])) < 8e-3 * steps.var()
    # 300 independent runs, 4.9 s on: 1σ of the estimate is 4 %.
    assert values[-1].std() == pytest.approx(std, rel=0.14)


def test_drifts_of_different_generations_and_places_are_independent() -> None:
    drift, nothing = GaussMarkov(), BiasStep(0.0)
    plant = Plant(arm_with(drift), 3)
    first = plant.run(50).disturbances
    plant.exchange(arm_with())
    plant.exchange(arm_with(drift))
    second = plant.run(50).disturbances

    assert (first[:, 0] == disturbances((drift,), 3, 50)).all()
    assert (first[:, 0] == disturbances((drift, nothing), 3, 50)).all()
    assert not (first[1:, 0] == disturbances((nothing, drift), 3, 50)[1:]).any()
    assert second[0] == 0.0
    assert not (first[1:] == second[1:]).any()


@pytest.mark.parametrize(
    ("signal", "formula"),
    [
        (BiasStep(0.1, 30.0), lambda t: 0.1 * (t >= 30.0)),
        (Sinusoid(0.2, 3.0, 2.0), lambda t: 0.2 * math.sin(3 * (t - 2)) * (t >= 2)),
        (Ramp(0.004, 10.0), lambda t: 0.004 * (t - 10.0) * (t >= 10.0)),
        (GaussMarkov(), lambda t: 0.0),
        (StuckSensor(), lambda t: 0.0),
        (Pulses(0.5, 1.0, 0.4, 1.5), lambda t: 0.5 * (t >= 1.0 and (t - 1.0) % 1.5 < 0.4)),
        (Pulses(0.5, 1.0, 0.4, 0.0), lambda t: 0.5 * (1.0 <= t < 1.4)),
        (Signal(), lambda t: 0.0),
        (Constant(-1.5), lambda t: -1.5),
        (Sine(2.0, 3.0), lambda t: 2.0 * math.sin(3.0 * t)),
    ],
)
def test_signals_follow_their_formulas(signal: Signal, formula: Callable[[float], float]) -> None:
    expected = [formula(time) for time in TIMES]
    np.testing.assert_allclose(signal.values(np.array(TIMES)), expected, atol=1e-12)


def test_signals_may_be_too_large_for_a_sine() -> None:
    with warnings.catch_warnings(action="error"):
        run = Plant(arm_with(Sinusoid(1.0, 1e308, 0.0), inputs=(Sine(1.0, 1e308),))).run(400)
    assert np.isnan(run.disturbances[-1])
    assert np.isnan(run.torques[-1])


def test_multisine_has_the_stated_power_and_a_moderate_crest() -> None:
    signal = Multisine(amplitude=2.0, lowest=0.5, highest=6.0, tones=12)  # period 4π
    torque = signal.values(np.arange(4000) * (4 * math.pi / 4000))
    assert torque.std() == pytest.approx(2.0 / math.sqrt(2.0), rel=1e-6)
    assert np.abs(torque).max() < 2.5 * torque.std()


def test_a_square_changes_its_sign_and_a_chirp_its_frequency() -> None:
    times = np.arange(4000) * 0.005
    square = Square(2.0, math.pi).values(times + 1e-6)  # period 2 s, beside its edges
    np.testing.assert_array_equal(square, np.where((times + 1e-6) % 2.0 < 1.0, 2.0, -2.0))
    chirp = Chirp(1.0, 1.0, 5.0, 10.0).values(times)
    phase = times[:2000] + 0.2 * times[:2000] ** 2
    np.testing.assert_allclose(chirp[:2000], np.sin(phase), atol=1e-12)
    np.testing.assert_allclose(chirp[2000:], chirp[:2000], atol=1e-9)


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        ("offset", "kind: expected one of none, .*, bias_step, .*, got 'offset'"),
        ({"amplitude": 1.0}, "kind: expected one of none, .*, bias_step, .*, got None"),
        ({"kind": ["ramp"]}, r"kind: expected one of none, .*, got \['ramp'\]"),
        ({"kind": "ramp", "slope": 1.0}, "unknown entry 'slope'"),
        ({"kind": "gauss_markov", "std": -1.0}, "gauss_markov std: expected a finite number of"),
        ({"kind": "gauss_markov", "time_constant": 0.0}, "gauss_markov time_constant: expected"),
        ({"kind": "multisine", "lowest": 2.0, "highest": 1.0}, "multisine highest"),
    ],
)
def test_entries_of_no_signal_are_refused(entry: Any, complaint: str) -> None:
    with pytest.raises(TsobsError, match=complaint):
        signal_of({**EXCITATIONS, **KINDS}, entry)
