# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of the extension module.

module.c has the functions.
"""

from typing import Any

KIND_ARM: int
KIND_SYSTEM: int
GAIN_OPEN: int
GAIN_RICCATI: int
GAIN_CERTIFIED: int
WRONG_TORQUE: int
JUMPED: int
HIT: int
MOVED: int
SERIES_TERMS: int
MOST_STEPS: int
HYPOTHESES: int
BANK_CONSTANTS: list[tuple[str, float, str]]
"""Name, value and meaning of each constant of the bank."""
SOURCES: str

Numbers = Any
"""Contiguous 8-byte numbers: an array of floats, or of integers for counts, codes and stamps."""

def layout(record: str, sizes: Numbers, /) -> list[tuple[str, str, int, int]]:
    """Return name, kind, rows and columns of the fields of a record, as layout.h has them."""

def elementary(function: str, values: Numbers, /) -> None:
    """Replace numbers by a function of them; see `functions.evaluate`."""

def weights_of_each(
    shapes: Numbers, parameters: Numbers, z: Numbers, weights: Numbers, r: int, q: int, /
) -> None:
    """Write the weights (samples, r) of r rules at z (samples, q)."""

def flow_over(flow: Numbers, duration: float, step: Numbers, /) -> None:
    """Write the linear flow of a step of a duration [s]."""

def simulate(*arguments: Any) -> None:
    """Move plants over samples by their sizes and record; see simulate.h."""

def messages_split(data: bytes | memoryview, found: Numbers, /) -> int:
    """Write the fields of each message in some records, and return their number or -1."""

def exported_seal(words: Numbers, /) -> None:
    """Write the head of an exported design, the first three words."""

def exported_open(words: Numbers, /) -> int:
    """Return how many numbers of room a tracker of an exported design needs."""

def tracker_room(model: Numbers, max_steps: int, /) -> int:
    """Return how many numbers of room a tracker of `max_steps` measurements needs; see tsobs.h."""

def history_offer(*arguments: Any) -> None:
    """Use measurements, or refuse them; see `offer` in tsobs.h."""

def history_estimate(*arguments: Any) -> bool:
    """Write the estimate at a stamp [ns]; return whether there is one."""

def history_advance(*arguments: Any) -> None:
    """Offer measurements and estimate at ticks; see `advance` in tsobs.h.

    The first argument is a tuple with the trackers' records. All have equal shares of each array.
    """

def estimator_correct(model: Any, states: Any, y: Any, corrections: Any, /) -> None:
    """Use one measurement (p), in place, and write its effect."""

def estimator_predict(
    model: Any, states: Any, u: Any, duration: float, between_samples: bool, work: Any, /
) -> None:
    """Predict a state over a time [s] with inputs (m), in place."""

def estimator_read(model: Any, states: Any, rows: Any, work: Any, /) -> None:
    """Write the estimate of a state."""

def estimator_innovations(*arguments: Any) -> None:
    """Write the innovations of a log; see estimator.h."""
