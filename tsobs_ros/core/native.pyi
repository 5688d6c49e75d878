# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of the extension module; module.c and the python_*.c files have the functions."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

KIND_ARM: int
KIND_SYSTEM: int
KIND_INTEGRATED: int
GAIN_RICCATI: int
GAIN_CERTIFIED: int
HYPOTHESES: int
SOURCES: str

class Memory:
    """An array's address, looked up once; the array must stay as it is."""

    def __init__(self, array: Any) -> None: ...

def messages_split(data: Any, found: Any, /) -> int:
    """Write the fields of each message in some records, and return their number or -1."""

Layout = list[tuple[str, str, int, int]]
Numbers = NDArray[np.float64] | Memory
Counts = NDArray[np.int64] | Memory

def faults_layout() -> Layout: ...
def faults_add_samples(
    watches: Numbers,
    stamps: Counts,
    y: Numbers,
    codes: Counts,
    innovations: Numbers,
    expected_std: Numbers,
    /,
) -> None: ...
def faults_add_estimates(
    watches: Numbers, stamp: int, disturbances: Numbers, bounds: Numbers, /
) -> bool: ...
def scores_add_up(
    limits: Numbers,
    places: Counts,
    jumps: Numbers,
    claims: Counts,
    basis: int,
    times: Numbers,
    states: Numbers,
    disturbances: Numbers,
    torques: Numbers,
    last_measured: Counts,
    rows: Numbers,
    settled: Numbers,
    claimed: Numbers,
    counts: Counts,
    reach: Numbers,
    scratch: Numbers,
    /,
) -> None: ...
def sine(angle: float, /) -> float:
    """Return sin of an angle [rad], with the same bits on every CPU."""

def cosine(angle: float, /) -> float:
    """Return cos of an angle [rad]."""

def unbranched_sine(angle: float, /) -> float:
    """Return what `sine` returns up to 10⁶ rad, NaN beyond, as vectorised loops have it."""

def exponential(x: float, /) -> float:
    """Return exp x for x ≤ 0; NaN of NaN."""

def logarithm(x: float, /) -> float:
    """Return the natural logarithm of x > 0; NaN of other numbers."""

def multiply(a: Any, b: Any, result: Any, rows: int, inner: int, columns: int, /) -> None:
    """Write a b into `result`."""

def congruence(
    a: Any, s: Any, added: Any, scratch: Any, result: Any, rows: int, inner: int, /
) -> None:
    """Write a s aᵀ + `added`, symmetric, into `result`, which may be s; scratch (rows, inner)."""

def joseph_form(
    C: Any, R: Any, covariance: Any, gain: Any, scratch: Any, result: Any, n: int, p: int, /
) -> None:
    """Write (I − KC) Σ (I − KC)ᵀ + K R Kᵀ; scratch has 3 n max(n, p) numbers."""

def solve(s: Any, b: Any, factor: Any, result: Any, n: int, columns: int, /) -> None:
    """Write s⁻¹ b into `result`, which may be b; factor is scratch (n, n)."""

def is_below(s: Any, bound: Any, scratch: Any, n: int, /) -> bool:
    """Return whether s ⪯ bound, for symmetric matrices (n, n)."""

def grades_and_slopes(shape: int, parameters: Any, z: Any, grades: Any, slopes: Any, /) -> None:
    """Write the grade of one membership function at every z, and its derivative."""

def weights_and_slopes_of_each(
    shapes: Any, parameters: Any, z: Any, weights: Any, slopes: Any, r: int, q: int, /
) -> None:
    """Write the rules' weights at z (samples, q), and their slopes (samples, r, q)."""

def weights_of_each(shapes: Any, parameters: Any, z: Any, weights: Any, r: int, q: int, /) -> None:
    """Write the rules' weights at z (samples, q)."""

def normalise_each(grades: Any, r: int, /) -> None:
    """Divide the grades of r rules by their sum, for each sample, in place."""

def fill_series(
    A: Any, B: Any, W: Any, reach: float, series: Any, scratch: Any, n: int, m: int, /
) -> int:
    """Write the Taylor coefficients of a linear flow, and return the number of rows that matter."""

def flow_over(
    series: Any,
    terms: int,
    reach: float,
    duration: float,
    phi: Any,
    gamma: Any,
    noise: Any,
    scratch: Any,
    n: int,
    m: int,
    /,
) -> None:
    """Write Φ, Γ and Q over a duration [s]; scratch has n (4 n + 2 m) numbers."""

def cut_into_steps(duration: float, period: float, /) -> tuple[int, float]:
    """Return the number of nominal steps in `duration` [s] and the length of a last one [s]."""

def flow_layout(
    n: int, m: int, inputs: int, p: int, k: int, plant: int, rules: int, premises: int, /
) -> list[tuple[str, str, int, int]]:
    """Return name, kind, rows and columns of each field of a model's record."""

def flow_scratch_size(
    n: int, m: int, inputs: int, p: int, k: int, plant: int, rules: int, premises: int, /
) -> int:
    """Return how many numbers of scratch a step of a model needs."""

def advance_all(
    flow: Any,
    x: Any,
    upsilon: Any,
    covariance: Any,
    theta: Any,
    y: Any,
    u: Any,
    duration: float,
    scratch: Any,
    /,
) -> None:
    """Move states (batch, n), Υᵀ (batch, k, n) and covariances (batch, n, n) over a time [s].

    No covariance is moved if there are no numbers of it; y is read by integrated observers only.
    """

def simulated_arm_layout() -> Layout: ...
def simulated_system_layout(sizes: Counts, /) -> Layout: ...
def simulate_arms(
    arms: Numbers,
    carried: Counts,
    inputs: Numbers,
    kicks: Numbers,
    present: Numbers,
    states: Numbers,
    torques: Numbers,
    /,
) -> None: ...
def simulate_systems(
    sizes: Counts,
    system: Numbers,
    inputs: Numbers,
    kicks: Numbers,
    present: Numbers,
    states: Numbers,
    truths: Numbers,
    /,
) -> None: ...
def gauss_markov(decay: float, strength: float, present: Numbers, series: Numbers, /) -> None: ...
def take_sines(angles: Numbers, /) -> None: ...
def take_cosines(angles: Numbers, /) -> None: ...
def history_layout() -> Layout: ...
def history_scratch_size(model: Numbers, slots: int, /) -> int: ...
def history_is_sound(
    model: Numbers, memory: Numbers, ring: Numbers, scratch: Numbers, /
) -> bool: ...
def history_offer(
    model: Numbers,
    memory: Numbers,
    ring: Numbers,
    scratch: Numbers,
    stamps: Counts,
    y: Numbers,
    u: Numbers,
    now: int,
    outcomes: Counts,
    output_codes: Counts,
    innovations: Numbers,
    expected_std: Numbers,
    /,
) -> None: ...
def history_estimate(
    model: Numbers,
    memory: Numbers,
    ring: Numbers,
    scratch: Numbers,
    stamp: int,
    row: Numbers,
    /,
) -> bool: ...
def history_follow(
    model: Numbers,
    memory: Numbers,
    ring: Numbers,
    scratch: Numbers,
    stamps: Counts,
    y: Numbers,
    u: Numbers,
    rows: Numbers,
    /,
) -> None: ...
def history_copy(
    model: Numbers,
    memory: Numbers,
    ring: Numbers,
    scratch: Numbers,
    other_model: Numbers,
    other_memory: Numbers,
    other_ring: Numbers,
    other_scratch: Numbers,
    /,
) -> None: ...
def history_forget(model: Numbers, memory: Numbers, ring: Numbers, scratch: Numbers, /) -> None: ...
def replay_advance(
    model: Numbers,
    memory: Numbers,
    ring: Numbers,
    scratch: Numbers,
    stamps: Counts,
    y: Numbers,
    u: Numbers,
    evidence: Counts,
    begins: Counts,
    tick_stamps: Counts,
    now: Counts,
    min_known: Counts,
    max_known: Counts,
    reset_after: Counts,
    estimates: Numbers,
    outcomes: Counts,
    output_codes: Counts,
    innovations: Numbers,
    expected_std: Numbers,
    ticks_of_use: Counts,
    newest: Counts,
    there: Counts,
    counts: Counts,
    rows: Numbers,
    begin: int,
    end: int,
    stale_after: int,
    /,
) -> int: ...
def estimator_layouts(
    n: int,
    width: int,
    plant: int,
    p: int,
    m: int,
    k: int,
    t: int,
    hypotheses: int,
    flow_size: int,
    scratch: int,
    /,
) -> dict[str, list[tuple[str, str, int, int]]]:
    """Return the fields of each of an estimator's records, by its name; see estimator.h."""

def bank_constants() -> list[tuple[str, float, str]]:
    """Return name, value and meaning of each constant of the bank."""

def estimator_correct(model: Any, states: Any, y: Any, corrections: Any, /) -> None:
    """Use one measurement (p) for each state, in place, and write its effect."""

def estimator_predict(
    model: Any, states: Any, u: Any, duration: float, between_samples: bool, work: Any, /
) -> None:
    """Predict each state over a time [s] with its inputs (m), in place."""

def estimator_read(model: Any, states: Any, rows: Any, work: Any, /) -> None:
    """Write the estimate of each state."""

def estimator_observe(
    model: Any,
    states: Any,
    y: Any,
    u: Any,
    duration: float,
    samples: int,
    correction: Any,
    work: Any,
    rows: Any,
    /,
) -> None:
    """Step each state through its samples (samples, p), and write a row after each."""

def exported_layout() -> Layout:
    """Return the fields of an exported design's head; see tsobs.h."""

def exported_seal(words: Any, /) -> None:
    """Complete the head of an exported design, whose lengths and text are there."""

def exported_open(words: Any, /) -> tuple[int, int, int, int, int]:
    """Return the lengths of model, memory, ring, scratch and of an estimate's row."""
