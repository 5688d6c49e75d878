# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hostile samples, settings and files for the compiled core: it refuses them, or stays finite.

    make fuzz FUZZ_ARGS="--inputs 100000"

Each input is a tracker of a random design, method and settings, and random batches of samples with
NaN, infinities and huge values, stamps of any order and size, and arrays of wrong lengths and
types; or an exported design that is cut, changed, or sealed again after a change. Published numbers
must be finite. Only a core with sanitizers detects accesses out of bounds; it then ends the
process, and the file of --note has the seed and the number of the input.
"""

import argparse
import faulthandler
import random
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "core"))

import other_build  # noqa: F401  # loads the core that TSOBS_NATIVE names

# isort: split
import numpy as np
from common import at_least

import tsobs_ros as ts
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import TsobsError
from tsobs_ros.methods import export_c, make_tracker
from tsobs_ros.model.arm import TorquePath
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path

_PATIENCE = 60.0
_REFUSED = (TsobsError, ValueError, TypeError, OverflowError)
_VALUES = (
    0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-308, 5e-324, 1e150, -1e150,
    1e9, 1e-9,
)  # fmt: skip
_STAMPS = (-(2**63), -1, 0, 1, 2**62, 2**63 - 1)
_FIRST = 10**9
_HEAD = 3
_HISTORY = record_type("history").itemsize // 8
_METHODS = ("certified", "ekf", "ekf_plain", "ekf_augmented", "high_gain", "proportional_integral")


@cache
def designs() -> tuple[ts.Design, ...]:
    """Return designs of all kinds of models."""
    adaptive = ts.load_design(config_path(SHIPPED_DESIGN))
    path = TorquePath(0.9, 0.5, 2.3 * adaptive.request.period)
    requests = ("ts_example", "contact_torque", "motor_encoder")
    return (
        adaptive,
        ts.load_design(config_path(FIXED_DESIGN)),
        ts.load_design(config_path("paper_example_1.design.yaml")),
        replace(adaptive, request=replace(adaptive.arm_request, torque=path)),
        *(ts.synthesise(ts.load_request(config_path(f"{name}.request.yaml"))) for name in requests),
    )


def _numbers(random_: random.Random, *shape: int) -> Any:
    """Return samples, most of them possible, sometimes of another shape or type."""
    count = int(np.prod(shape))
    values = [
        random_.gauss(0.0, 1.0) if random_.random() < 0.8 else random_.choice(_VALUES)
        for _ in range(count)
    ]
    made: Any = np.array(values).reshape(shape)
    spoilt = random_.random()
    if spoilt < 0.02:
        return made[..., :-1]
    if spoilt < 0.04:
        return made.astype(random_.choice((np.float32, np.int32, object, "U8")))
    return np.repeat(made, 2, axis=0)[::2] if spoilt < 0.1 else made


def attack_tracker(random_: random.Random) -> str:
    """Offer samples in any order, and read estimates; return the outcome."""
    design = random_.choice(designs())
    settings = ts.ObserverSettings(
        method=random_.choice(_METHODS),
        adapt=random_.random() < 0.8,
        history=random_.choice((1e-3, 0.1, 2.0)),
    )
    try:
        tracker = make_tracker(design, settings)
    except TsobsError:
        return "refused"
    shape, period = tracker.estimator.shape, round(design.request.period * 1e9)
    at, refused = _FIRST, 0
    for _ in range(random_.randint(1, 12)):
        count = random_.randint(0, 8)
        stamps = [at + (place + random_.randint(-3, 3)) * period for place in range(count)]
        if count and random_.random() < 0.1:
            stamps[random_.randrange(count)] = random_.choice(_STAMPS)
        y, u = _numbers(random_, count, shape.p), _numbers(random_, count, shape.m)
        try:
            tracker.offer_many(stamps, y, u, random_.choice((at + 10 * period, *_STAMPS)))
        except _REFUSED:
            refused += 1
        estimate = tracker.estimate(at + random_.randint(-9, 9) * period)
        if estimate is not None:
            for value in (estimate.state, estimate.disturbance, estimate.parameters):
                assert np.isfinite(value).all() or settings.method in _METHODS[4:], estimate
        at += random_.choice((count, 1, 20, 2_000_000)) * period
    return "stepped, refused in part" if refused else "stepped"


def attack_export(random_: random.Random, folder: Path) -> str:
    """Open an exported design that was changed; return the outcome."""
    path = folder / "design.tsobs"
    export_c(random_.choice(designs()), path, max_steps=random_.choice((1, 4, 1024)))
    words = np.frombuffer(path.read_bytes(), np.int64).copy()
    for _ in range(random_.randint(0, 3)):
        place = random_.randrange(len(words))
        # Sizes are at the beginning, the start of a history is at the end.
        place = random_.choice((place, place % 40, -1 - place % 24))
        change = random_.choice((-1, 0, 1, 1000, 2**31, 2**62, words[place] ^ 1 << place % 63))
        words[place] = change
    if random_.random() < 0.2:
        words = words[: random_.randrange(len(words))].copy()
    if len(words) >= _HEAD and random_.random() < 0.8:
        native.exported_seal(words)
    try:
        room = native.exported_open(words)
    except ValueError:
        return "refused"
    assert 0 < room < 2**48, room
    if room < 2**20:
        step_export(words, room)
    return "opened"


def step_export(words: Any, room: int) -> None:
    """Step a tracker of an exported design that was opened."""
    model, memory = words[_HEAD:-_HISTORY], words[-_HISTORY:]
    own = np.zeros(room)
    own[:_HISTORY] = memory.view(np.float64)
    stamps = np.array([3, 1, 2, 4, 1], np.int64) * 10**6
    samples = np.zeros((10, len(stamps) * 1000))
    native.history_offer(model, own, stamps, *samples[:2], 10**9, *samples[2:6].view(np.int64))
    if native.history_estimate(model, own, 5 * 10**6, row := np.zeros(100_000)):
        assert np.isfinite(row).all()


def fuzz(inputs: int, seed: int, note: Callable[[str], object]) -> tuple[Counter[str], float]:
    """Attack with many inputs; return the counts of the outcomes, and the longest time [s].

    Args:
        inputs: Number of inputs.
        seed: Of the changes.
        note: Called with the seed and the number of the next input.
    """
    results: Counter[str] = Counter()
    longest = 0.0
    designs()
    try:
        with TemporaryDirectory() as folder:
            for number in range(inputs):
                note(f"{seed} {number}\n")
                random_, begun = random.Random(f"{seed} {number}"), time.monotonic()
                faulthandler.dump_traceback_later(_PATIENCE, exit=True)  # C handles no signal
                of_file = random_.random() < 0.2
                with np.errstate(all="ignore"):
                    done = (
                        attack_export(random_, Path(folder)) if of_file else attack_tracker(random_)
                    )
                results[done] += 1
                longest = max(longest, time.monotonic() - begun)
    finally:
        faulthandler.cancel_dump_traceback_later()
    return results, longest


def main() -> None:
    """Fuzz, and print the outcomes of the inputs."""
    made = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    made.add_argument("--inputs", type=at_least(1, int), default=100_000)
    made.add_argument("--seed", type=at_least(0, int), default=1)
    made.add_argument("--note", type=Path, metavar="FILE", help="has the input that is attacked")
    options = made.parse_args()
    note = options.note.write_text if options.note else lambda text: None
    results, longest = fuzz(options.inputs, options.seed, note)
    counts = ", ".join(f"{count:,} {name}" for name, count in sorted(results.items()))
    print(f"{sum(results.values()):,} inputs: {counts}; the slowest took {longest:.2f} s")


if __name__ == "__main__":
    main()
