# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Random streams: good samples, bad ones of every sort, and a clock that does what it likes.

Hypothesis chooses the mixture, in which it can find the worst and shrink it; a seeded generator
makes the thousands of messages of it.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st

from staging.arm import Arm
from tsobs_ros.estimation.records import Measurement
from tsobs_ros.series import NANOSECONDS

_MS = 1_000_000
_LARGEST_STAMP = (2**31 - 1) * NANOSECONDS + 2**32 - 1
_NUMBERS = (math.nan, math.inf, -math.inf, 1.8e308, -1.7e308, 1e154, 5e-324, -0.0, 0.0, 1e6)
SORTS = (
    "good",
    "any number for the angle",
    "any number for the torque",
    "outlier",
    "the same angle",
    "any stamp",
    "a stamp nearby",
    "a stamp again",
    "late",
    "gap",
    "no sample",
)


class Mix(NamedTuple):
    """What a stream is made of.

    Attributes:
        seed: Of everything random in it.
        weights: How often each of the sorts comes, relative to the others.
        period: Time between samples [ns].
        bias: Disturbance of the sensor [rad].
    """

    seed: int
    weights: tuple[int, ...]
    period: int
    bias: float


class Arrival(NamedTuple):
    """A sample that arrives, or a message without one.

    Attributes:
        at: When it arrives [ns].
        measurement: What it says; None if there is none in it.
    """

    at: int
    measurement: Measurement | None


def mixes() -> st.SearchStrategy[Mix]:
    """Return a strategy of mixtures in which some samples are good; the simplest has it all."""
    others = st.tuples(*[st.sampled_from([1, 0, 2, 4])] * (len(SORTS) - 1))
    return st.builds(
        Mix,
        seed=st.integers(0, 2**32 - 1),
        weights=st.builds(lambda good, rest: (good, *rest), st.integers(4, 20), others),
        period=st.sampled_from([5, 1, 3, 7, 20]).map(_MS.__mul__),
        bias=st.sampled_from([0.0, 0.1, -0.4]),
    )


def arrivals(mix: Mix, arm: Arm, begin: int, count: int) -> list[Arrival]:
    """Return so many arrivals of a mixture, in the order of arrival.

    Args:
        mix: The mixture.
        arm: Whose samples the good ones are.
        begin: Stamp from which on they are taken [ns].
        count: How many.
    """
    return sorted(_arrivals(mix, arm, begin, count), key=lambda arrival: arrival.at)


def _arrivals(mix: Mix, arm: Arm, begin: int, count: int) -> Iterator[Arrival]:
    rng = np.random.default_rng(mix.seed)
    shares = np.array(mix.weights) / sum(mix.weights)
    stamp, before = begin, arm.measurement(begin)
    for sort in rng.choice(len(SORTS), count, p=shares):
        # Two samples of the arm may be one here; so each has noise of its own.
        sample = arm.measurement(stamp)
        sample = sample._replace(y=sample.y + mix.bias + rng.normal(0.0, 0.01, 1))
        name = SORTS[sort]
        at = stamp
        if name == "any number for the angle":
            sample = sample._replace(y=_any_number(rng))
        elif name == "any number for the torque":
            sample = sample._replace(u=_any_number(rng))
        elif name == "outlier":
            sample = sample._replace(y=sample.y + rng.normal(0.0, 3.0))
        elif name == "the same angle":
            sample = sample._replace(y=before.y)
        elif name == "any stamp":
            sample = sample._replace(stamp=int(rng.integers(-(2**31), _LARGEST_STAMP)))
        elif name == "a stamp nearby":
            sample = sample._replace(stamp=stamp + int(rng.normal(0.0, 0.3 * NANOSECONDS)))
        elif name == "a stamp again":
            sample = sample._replace(stamp=before.stamp)
        elif name == "late":
            # Of every millisecond a rewind repeats a step: not too many of the latest ones.
            at += int(rng.exponential(rng.choice([0.01, 0.2], p=[0.9, 0.1])) * NANOSECONDS)
        elif name == "gap":
            stamp += int(rng.exponential(_gap(rng)))
        yield Arrival(at, None if name == "no sample" else sample)
        before = sample
        stamp += mix.period


def _gap(rng: np.random.Generator) -> float:
    """Return a length of gaps [ns]: mostly a few samples, now and then beyond all patience."""
    return float(rng.choice([0.05, 1.0, 10.0], p=[0.97, 0.02, 0.01])) * NANOSECONDS


def _any_number(rng: np.random.Generator) -> np.ndarray:
    """Return one of the notorious numbers, or any of the 2^64 doubles."""
    if rng.random() < 0.5:
        return np.array([rng.choice(_NUMBERS)])
    return np.frombuffer(rng.bytes(8), np.float64)
