# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of the extension module; module.c and the python_*.c files have the functions."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

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
