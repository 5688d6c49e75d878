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
from tsobs_ros.model.disturbance import (
    DisturbanceModel,
    arbitrary,
    bias,
    clean,
    gauss_markov,
    per_channel,
    ramp,
    sinusoid,
)

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=15)
STATES = st.floats(-2.0, 2.0)
TIMES = st.floats(0.0, 20.0)
MODELS = st.one_of(
    st.builds(clean), st.builds(bias), st.builds(ramp),
    st.builds(gauss_markov, st.floats(0.01, 1.0), st.floats(0.1, 50.0)),
    st.builds(sinusoid, st.floats(0.1, 20.0)),
)  # fmt: skip


def generated(model: DisturbanceModel, start: Any, time: float) -> Array:
    """Return ω(t) = H e^{St} w(0)."""
    return np.asarray(model.H @ expm(model.S * time) @ np.asarray(start, dtype=np.float64))


@PROPERTY
@given(STATES, STATES, TIMES, st.floats(0.1, 20.0))
def test_exosystems_generate_their_signals(a: float, b: float, t: float, number: float) -> None:
    expected = {
        "bias": (bias(), [a], a),
        "drift": (gauss_markov(0.1, number), [a], a * np.exp(-t / number)),
        "tone": (sinusoid(number), [a, b], a * np.cos(number * t) + b * np.sin(number * t)),
        "ramp": (ramp(), [a, b], a + b * t),
    }
    for name, (model, start, value) in expected.items():
        assert generated(model, start, t) == pytest.approx([value], abs=1e-11), name


@PROPERTY
@given(st.data(), MODELS, MODELS, TIMES)
def test_a_sum_generates_the_sum_of_its_signals(
    data: st.DataObject, first: DisturbanceModel, second: DisturbanceModel, t: float
) -> None:
    total = first + second
    start = [data.draw(STATES) for _ in range(total.state_count)]
    split = first.state_count
    parts = generated(first, start[:split], t) + generated(second, start[split:], t)
    np.testing.assert_allclose(generated(total, start, t), parts, atol=1e-10)
    state, step = expm(total.S * t) @ np.array(start), 1e-6
    change = generated(total, state, step) - generated(total, state, -step)
    np.testing.assert_allclose(total.rate_map @ state, change / 2e-6, rtol=1e-6, atol=1e-7)
    driven = total.G @ total.G.T
    assert (driven[:split, :split] == first.G @ first.G.T).all()
    assert (driven[split:, split:] == second.G @ second.G.T).all()
    assert not driven[:split, split:].any()


def test_channels_stand_side_by_side_and_act_through_a_matrix() -> None:
    model = per_channel([bias(), clean(), sinusoid(2.0)])
    assert (model.H == [[1, 0, 0], [0, 0, 0], [0, 1, 0]]).all()
    assert model.label == "bias, clean, sinusoid"
    assert per_channel([bias(), arbitrary()]).arbitrary
    mixed = per_channel([bias(), ramp()]).through([[1.0, 0.0], [0.0, 2.0], [1.0, 1.0]])
    assert mixed.channel_count == 3
    assert generated(mixed, [0.3, 0.5, 0.1], 2.0) == pytest.approx([0.3, 1.4, 1.0])


TWO = per_channel([bias(), bias()])


def test_a_wrong_number_or_matrix_is_named() -> None:
    cases: list[tuple[Any, str]] = [
        (lambda: TWO.through([[1.0, 2.0], [2.0, 4.0]]), "D_s: expected full column rank"),
        (lambda: bias().through([[1.0, 0.0]]), r"D_s: expected shape \(1, 1\), got \(1, 2\)"),
        (lambda: bias() + clean(2), "same number of channels, got 1 and 2"),
        (lambda: per_channel([]), "at least one disturbance model"),
        (lambda: bias(-1e-4), "bias density: expected a finite number of at least 0, got -0.0001"),
        (lambda: gauss_markov(std=0.0), "gauss_markov std: expected a finite number above 0"),
        (lambda: sinusoid(0.0), "sinusoid frequency: expected a finite number above 0, got 0.0"),
        (lambda: ramp(rate_density=np.inf), "ramp rate_density: expected"),
    ]
    for build, message in cases:
        with pytest.raises(ModelError, match=message):
            build()
