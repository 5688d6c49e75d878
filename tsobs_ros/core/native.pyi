# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of the extension module; module.c and the python_*.c files have the functions."""

from typing import Any

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

Numbers = NDArray[Any] | Memory
"""Contiguous 8-byte numbers: floats, or integers for counts, codes and stamps."""

def layout(record: str, sizes: Numbers, /) -> list[tuple[str, str, int, int]]:
    """Return name, kind, rows and columns of the fields of a record, as layout.h has them."""

def elementary(function: str, values: Numbers, /) -> None:
    """Write a function of numbers over them; see `functions.evaluate`."""

def grades_and_slopes(
    shape: int, parameters: Numbers, z: Numbers, grades: Numbers, slopes: Numbers, /
) -> None:
    """Write the grade of one membership function at every z, and its derivative."""

def weights_and_slopes_of_each(
    shapes: Numbers,
    parameters: Numbers,
    z: Numbers,
    weights: Numbers,
    slopes: Numbers,
    r: int,
    q: int,
    /,
) -> None:
    """Write the rules' weights at z (samples, q), and their slopes (samples, r, q)."""

def normalise_each(grades: Numbers, r: int, /) -> None:
    """Divide the grades of r rules by their sum, for each sample, in place."""

def flow_over(
    series: Numbers,
    terms: int,
    reach: float,
    duration: float,
    phi: Numbers,
    gamma: Numbers,
    noise: Numbers,
    scratch: Numbers,
    n: int,
    m: int,
    /,
) -> None:
    """Write Φ, Γ and Q over a duration [s]; scratch has n (4 n + 2 m) numbers."""

def advance_all(
    flow: Numbers,
    x: Numbers,
    upsilon: Numbers,
    covariance: Numbers,
    theta: Numbers,
    y: Numbers,
    u: Numbers,
    duration: float,
    scratch: Numbers,
    /,
) -> None:
    """Move states (batch, n), Υᵀ (batch, k, n) and covariances (batch, n, n) over a time [s].

    No covariance is moved if there are no numbers of it; y is read by integrated observers only.
    """

def simulate_arms(
    arms: Numbers,
    carried: Numbers,
    inputs: Numbers,
    kicks: Numbers,
    present: Numbers,
    states: Numbers,
    torques: Numbers,
    /,
) -> None:
    """Move two arms' records, without and with the payload, over samples; see simulate.h."""

def simulate_systems(
    sizes: Numbers,
    system: Numbers,
    inputs: Numbers,
    kicks: Numbers,
    present: Numbers,
    states: Numbers,
    truths: Numbers,
    /,
) -> None:
    """Move T–S systems over samples; see simulate.h."""

def gauss_markov(decay: float, strength: float, present: Numbers, series: Numbers, /) -> None:
    """Write Gauss–Markov processes over their normal numbers (runs, samples)."""

def messages_split(data: bytes | memoryview, found: Numbers, /) -> int:
    """Write the fields of each message in some records, and return their number or -1."""

def exported_seal(words: Numbers, /) -> None:
    """Complete the head of an exported design, whose lengths and text are there."""

def exported_open(words: Numbers, /) -> tuple[int, int, int, int, int]:
    """Return the lengths of model, memory, ring, scratch and of an estimate's row."""

def history_scratch_size(model: Numbers, slots: int, /) -> int:
    """Return the numbers of scratch of a tracker whose ring has so many states."""

def history_offer(
    model: Numbers,
    memory: Numbers,
    ring: Numbers,
    scratch: Numbers,
    stamps: Numbers,
    y: Numbers,
    u: Numbers,
    now: int,
    codes: Numbers,
    output_codes: Numbers,
    innovations: Numbers,
    expected_std: Numbers,
    /,
) -> None:
    """Use measurements, or refuse them; see `estimation.history.History.offer`."""

def history_estimate(
    model: Numbers, memory: Numbers, ring: Numbers, scratch: Numbers, stamp: int, row: Numbers, /
) -> bool:
    """Write the estimate at a stamp [ns]; return whether there is one."""

def history_advance(
    model: Numbers,
    memory: Numbers,
    ring: Numbers,
    scratch: Numbers,
    stamps: Numbers,
    y: Numbers,
    u: Numbers,
    codes: Numbers,
    output_codes: Numbers,
    innovations: Numbers,
    expected_std: Numbers,
    tick_stamps: Numbers,
    now: Numbers,
    known: Numbers,
    newest: Numbers,
    there: Numbers,
    rows: Numbers,
    stale_after: int,
    /,
) -> None:
    """Offer measurements and estimate at ticks; see `advance` in history.h."""

def faults_add_samples(
    watches: Numbers,
    stamps: Numbers,
    y: Numbers,
    codes: Numbers,
    innovations: Numbers,
    expected_std: Numbers,
    /,
) -> None:
    """See `estimation.faults.add_samples`."""

def faults_add_estimates(
    watches: Numbers, stamp: int, disturbances: Numbers, bounds: Numbers, /
) -> bool:
    """See `estimation.faults.add_estimates`."""

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

def estimator_innovations(
    model: Any,
    durations: Any,
    y: Any,
    u: Any,
    link_friction: float,
    motor_friction: float,
    gate: float,
    corrected_until: int,
    innovations: Any,
    variances: Any,
    states: Any,
    scratch: Any,
    /,
) -> None:
    """Write the innovations of a log; see innovations.h. No states are written if there is no room.

    Python's lock is not held meanwhile.
    """
