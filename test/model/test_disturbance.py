# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Disturbance models: their exosystems generate the signals they are named after."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from tsobs_ros.errors import ModelError
from tsobs_ros.model.disturbance import DisturbanceModel, DisturbanceTerm, per_channel, sum_of

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=15)
STATES = st.floats(-2.0, 2.0)
TIMES = st.floats(0.0, 20.0)


def term(kind: str, **parameters: float) -> DisturbanceTerm:
    return DisturbanceTerm(kind, parameters)


BIAS, CLEAN, RAMP = term("bias"), term("clean"), term("ramp")
TERMS = st.one_of(
    st.sampled_from([CLEAN, BIAS, RAMP]),
    st.builds(lambda f: term("sinusoid", frequency=f), st.floats(0.1, 20.0)),
    st.builds(lambda t: term("gauss_markov", time_constant=t), st.floats(0.1, 50.0)),
)


def generated(model: DisturbanceModel, start: Any, time: float) -> Array:
    """Return ω(t) = H e^{St} w(0)."""
    return np.asarray(model.H @ expm(model.S * time) @ np.asarray(start, dtype=np.float64))


@PROPERTY
@given(STATES, STATES, TIMES, st.floats(0.1, 20.0))
def test_exosystems_generate_their_signals(a: float, b: float, t: float, number: float) -> None:
    for each, start, value in (
        (BIAS, [a], a),
        (term("gauss_markov", time_constant=number), [a], a * np.exp(-t / number)),
        (
            term("sinusoid", frequency=number),
            [a, b],
            a * np.cos(number * t) + b * np.sin(number * t),
        ),
        (RAMP, [a, b], a + b * t),
    ):
        assert generated(each.model, start, t) == pytest.approx([value], abs=1e-11), each


@PROPERTY
@given(st.data(), TERMS, TERMS, TIMES)
def test_a_sum_generates_the_sum_of_its_signals(
    data: st.DataObject, one: DisturbanceTerm, other: DisturbanceTerm, t: float
) -> None:
    total, first, second = sum_of([one, other]), one.model, other.model
    start = [data.draw(STATES) for _ in range(total.state_count)]
    split = first.state_count
    parts = generated(first, start[:split], t) + generated(second, start[split:], t)
    np.testing.assert_allclose(generated(total, start, t), parts, atol=1e-10)
    state, step = expm(total.S * t) @ np.array(start), 1e-6
    change = generated(total, state, step) - generated(total, state, -step)
    np.testing.assert_allclose(total.H @ total.S @ state, change / 2e-6, rtol=1e-6, atol=1e-7)
    driven = total.G @ total.G.T
    assert (driven[:split, :split] == first.G @ first.G.T).all()
    assert (driven[split:, split:] == second.G @ second.G.T).all()
    assert not driven[:split, split:].any()


def test_channels_stand_side_by_side_and_act_through_a_matrix() -> None:
    model = per_channel([each.model for each in (BIAS, CLEAN, term("sinusoid", frequency=2.0))])
    assert (model.H == [[1, 0, 0], [0, 0, 0], [0, 1, 0]]).all()
    assert model.label == "bias, clean, sinusoid"
    assert sum_of([BIAS, term("arbitrary")]).arbitrary
    both = per_channel([BIAS.model, RAMP.model])
    mixed = both.through([[1.0, 0.0], [0.0, 2.0], [1.0, 1.0]])
    assert generated(mixed, [0.3, 0.5, 0.1], 2.0) == pytest.approx([0.3, 1.4, 1.0])


def test_a_wrong_number_or_matrix_is_named() -> None:
    two = per_channel([BIAS.model, BIAS.model])
    cases: list[tuple[Any, str]] = [
        (lambda: two.through([[1.0, 2.0], [2.0, 4.0]]), "D_s: expected full column rank"),
        (lambda: two.through([[1.0]]), r"D_s: expected shape \(1, 2\), got \(1, 1\)"),
        (lambda: term("bias", density=-1e-4), "bias density: expected .* at least 0, got -0.0001"),
        (lambda: term("gauss_markov", std=0.0), "gauss_markov std: expected a finite number above"),
        (lambda: term("sinusoid", frequency=0.0), "sinusoid frequency: expected .* above 0, got 0"),
        (lambda: term("ramp", rate_density=np.inf), "ramp rate_density: expected"),
        (lambda: term("bias", density="much"), "bias density: expected a finite number"),  # type: ignore[arg-type]
        (lambda: term("bias", size=1.0), "parameters of bias: expected some of density, .*'size'"),
        (lambda: term("sinusoid"), "frequency: missing, sinusoid has no default"),
        (lambda: term("wind"), "kind: expected one of clean, .* got 'wind'"),
    ]
    for build, message in cases:
        with pytest.raises(ModelError, match=message):
            build()
