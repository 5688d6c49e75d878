# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Designs for C and C++ programs: all that a tracker is made of, as one file that needs no Python.

The file is a head, the model record and the memory record of a new tracker, as little-endian words
of 8 bytes. core/tsobs.h has the functions that open it.
"""

import sys
from os import PathLike
from pathlib import Path

import numpy as np

from tsobs_ros.core import native
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.methods import ObserverSettings, make_tracker


def export_c(
    design: Design,
    output: str | PathLike[str],
    settings: ObserverSettings | None = None,
    *,
    max_steps: int = 1024,
) -> tuple[int, int]:
    """Write a design's estimator into a file for C and C++ programs, as `tsobs export-c`.

    Args:
        design: From `load_design` or `synthesise`.
        output: The file, which is replaced.
        settings: Method, gates and timeouts; the node's defaults if None.
        max_steps: Most measurements to which a late one can rewind, by default as many as the node.
            Each takes the room of a state.

    Returns:
        The bytes of the file, and those of the room that a tracker needs in the program.

    Raises:
        ModelError: The method cannot observe this model, or the number of measurements is not
            within 1 and a million.
        OSError: The file cannot be written.
    """
    if not 1 <= max_steps <= 10**6:
        raise ModelError(f"max_steps: expected 1 to 1000000, got {max_steps}")
    tracker = make_tracker(design, settings)
    tracker.memory["max_steps"] = max_steps
    model = tracker.estimator.model.view(np.int64)
    words = np.concatenate([[0, 0, len(model), 0], model, tracker.memory.view(np.int64)])
    native.exported_seal(words)
    room = native.exported_open(words)
    if sys.byteorder == "big":
        words = words.byteswap()
    Path(output).write_bytes(words.tobytes())
    return words.nbytes, 8 * room
