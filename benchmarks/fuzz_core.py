# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Feed the compiled core hostile records and samples: it refuses them, or stays in its memory.

    make fuzz FUZZ_ARGS="--inputs 100000"

Each input is the model, memory and ring of a tracker, some of whose sizes, places and values are
changed, and samples with NaN, infinities and huge values. Places within states are not changed, as
only the core writes them. What is not refused is stepped. Only a
core with sanitizers shows what is read or written out of bounds; it ends the process then, and the
file that --note names has the seed and the number of the input.
"""

import argparse
import faulthandler
import math
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "core"))

import other_build  # noqa: F401  # loads the core that TSOBS_NATIVE names

# isort: split
import numpy as np
from common import at_least

import tsobs_ros as ts
from tsobs_ros.core import native
from tsobs_ros.exported import exported
from tsobs_ros.methods import make_tracker
from tsobs_ros.model.torque_path import TorquePath
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path

_PATIENCE = 60.0
_STEPS = 4
"""Most samples that a fuzzed history has room for, so that most states are in use."""
_COUNTS = (-1, 0, 1, 2, 3, 4, 5, 7, 13, 64, 999, 1000, 1001, 4096, 4097, 2**31, 2**40, 2**62)
_VALUES = (
    0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-308, 5e-324, 1e150, -1e150,
    1e9, 1e-9,
)  # fmt: skip
_FIRST = 10**9


@dataclass
class Subject:
    """What is fuzzed: the records of a tracker that is in use, as numbers.

    Attributes:
        name: Of the design and the method.
        model: The model record.
        memory: The record of its history.
        ring: Its states.
        scratch: Numbers of scratch.
        outputs: Number of outputs.
        inputs: Number of inputs.
        width: Numbers of an estimate.
        period: Of the samples [ns].
        words: All of it as an exported design.
        counts: Places of integers, which are sizes, places and flags, by the record.
        values: Places of all other numbers of the ring.
    """

    name: str
    model: Any
    memory: Any
    ring: Any
    scratch: int
    outputs: int
    inputs: int
    width: int
    period: int
    words: Any
    counts: dict[str, list[int]]
    values: list[int]


def _places_of_integers(kind: Any, begin: int = 0) -> list[int]:
    """Return the places of all integers in a record, in words."""
    if kind.subdtype is not None:
        inner, shape = kind.subdtype
        each, size = _places_of_integers(inner), inner.itemsize // 8
        return [begin + i * size + place for i in range(math.prod(shape)) for place in each]
    if kind.fields is not None:
        return [
            place
            for inner, offset, *_ in kind.fields.values()
            for place in _places_of_integers(inner, begin + offset // 8)
        ]
    return [begin] if kind == np.int64 else []


def subjects() -> list[Subject]:
    """Return trackers of all kinds of models, after samples that have woken all hypotheses."""
    adaptive = ts.load_design(config_path(SHIPPED_DESIGN))
    fixed = ts.load_design(config_path(FIXED_DESIGN))
    system = ts.synthesise(ts.load_request(config_path("ts_example.request.yaml")))
    torque = ts.synthesise(ts.load_request(config_path("contact_torque.request.yaml")))
    path = TorquePath(0.9, 0.5, 2.3 * adaptive.request.period)
    late = replace(adaptive, request=replace(adaptive.arm_request, torque=path))
    made = []
    for name, design, method in (
        ("adaptive", adaptive, "certified"),
        ("fixed", fixed, "certified"),
        ("system", system, "certified"),
        ("torque", torque, "certified"),
        ("late torque", late, "certified"),
        ("integrated", fixed, "proportional_integral"),
    ):
        settings = ts.ObserverSettings(method=method)
        made.append(_subject(name, design, settings))
    return made


def _subject(name: str, design: Any, settings: Any) -> Subject:
    words = exported(design, settings, max_steps=_STEPS)
    model_length, memory_length, ring, scratch, width = native.exported_open(words)
    begin = len(words) - model_length - memory_length
    tracker = make_tracker(design, settings)
    shape = tracker.estimator.shape
    subject = Subject(
        name,
        words[begin : begin + model_length].copy(),
        words[begin + model_length :].copy(),
        np.zeros(ring, np.int64),
        scratch,
        shape.p,
        shape.m,
        width,
        round(design.request.period * 1e9),
        words,
        {
            "model": [*range(9), *_places_of_integers(tracker.estimator.model.dtype)],
            "memory": _places_of_integers(tracker.memory.dtype),
        },
        [],
    )
    size = tracker.ring.dtype.itemsize // 8
    integers = {*_places_of_integers(tracker.ring.dtype)}
    subject.values = [place for place in range(ring) if place % size not in integers]
    begin = tracker.estimator.model.dtype.fields["flow"][1] // 8
    subject.counts["model"] += range(begin, begin + 12)  # the flow's own sizes
    numbers = np.random.default_rng(1)
    room = np.zeros(scratch)
    for sample in range(60):
        y = 0.01 * numbers.normal(size=(1, shape.p)) + (0.5 if sample % 7 == 6 else 0.0)
        _offer(subject, room, np.array([_FIRST + sample * subject.period]), y)
    return subject


def _offer(subject: Subject, room: Any, stamps: Any, y: Any, u: Any = None) -> None:
    count = len(stamps)
    inputs = np.zeros((count, subject.inputs)) if u is None else u
    codes, outputs = np.zeros(count, np.int64), np.zeros((count, subject.outputs), np.int64)
    native.history_offer(
        subject.model, subject.memory, subject.ring, room, stamps, y, inputs, 2**62, codes, outputs,
        np.zeros_like(y), np.zeros_like(y),
    )  # fmt: skip


def _changed(
    words: Any, random_: random.Random, most: int, counts: Sequence[int] = range(24)
) -> Any:
    """Return a copy of some words with up to so many of them changed, counts above all."""
    changed = words.copy()
    for _ in range(random_.randint(0, most)):
        if random_.random() < 0.5:
            changed[random_.choice(counts)] = random_.choice(_COUNTS)
            continue
        place = random_.randrange(len(words))
        if random_.random() < 0.2:
            changed[place] = random_.choice(_COUNTS)
        elif random_.random() < 0.8:
            changed.view(np.float64)[place] = random_.choice(_VALUES)
        else:
            changed[place] ^= 1 << random_.randrange(63)
    if random_.random() < 0.02:
        changed = changed[: random_.randrange(len(words) + 1)]
    return changed


def _values(random_: random.Random, rows: int, columns: int) -> Any:
    """Return samples, most of which are possible."""
    numbers = [
        random_.gauss(0.0, 1.0) if random_.random() < 0.8 else random_.choice(_VALUES)
        for _ in range(rows * columns)
    ]
    return np.array(numbers).reshape(rows, columns)


def attack(subject: Subject, random_: random.Random) -> str:
    """Change some records and step them; return whether they were refused, and where."""
    kind = random_.choice(("model", "state", "memory", "both", "export"))
    if kind in ("model", "export"):
        model = _changed(subject.model, random_, 3, subject.counts["model"])
        if kind == "export":
            return _attack_export(subject, model, random_)
        # States of another model are none of this one.
        memory, ring = subject.words[-len(subject.memory) :].copy(), np.zeros_like(subject.ring)
    else:
        most = 0 if kind == "state" else 3
        memory = _changed(subject.memory, random_, most, subject.counts["memory"])
        model, ring = subject.model, subject.ring.copy()
        for _ in range(0 if kind == "memory" else random_.randint(1, 4)):
            ring.view(np.float64)[random_.choice(subject.values)] = random_.choice(_VALUES)
    if len(memory) == len(subject.memory):
        # Gaps of years are settings, and only take long. So are counts that overflow.
        memory[5:] = np.clip(memory[5:], -(2**62), 2**62)
        np.minimum(memory[-5:-2], 2 * 10**8, out=memory[-5:-2])
    try:
        scratch = min(native.history_scratch_size(model, _STEPS + 4), 2**24)
    except ValueError:
        return "refused"
    return (
        "stepped"
        if _step((model, memory, ring, np.zeros(scratch)), subject, random_)
        else "refused"
    )


def _attack_export(subject: Subject, model: Any, random_: random.Random) -> str:
    words = _changed(subject.words, random_, 2)
    begin = len(subject.words) - len(subject.model) - len(subject.memory)
    if len(words) == len(subject.words) and len(model) == len(subject.model):
        words[begin : begin + len(model)] = model
        if random_.random() < 0.9:
            native.exported_seal(words)
    try:
        lengths = native.exported_open(words)
    except ValueError:
        return "refused"
    if sum(lengths) > 2**24:
        return "opened"
    _, _, ring, scratch, _ = lengths
    memory = words[-len(subject.memory) :].copy()
    np.minimum(memory[-5:-2], 2 * 10**8, out=memory[-5:-2])
    given = words[begin : begin + lengths[0]].copy()
    _step((given, memory, np.zeros(ring, np.int64), np.zeros(scratch)), subject, random_)
    return "stepped"


def _step(tracker: Any, subject: Subject, random_: random.Random) -> bool:
    """Offer samples in any order, and read estimates; return whether this was not refused."""
    sizes = tracker[0][:10]
    p, m = int(sizes[3]), int(sizes[4])
    width = 2 * int(sizes[2]) + 3 * p + 2 * int(sizes[5]) + 2 * int(sizes[6]) + 9
    at = _FIRST + 60 * subject.period
    for _ in range(random_.randint(1, 6)):
        count = random_.randint(0, 4)
        stamps = np.array(
            [at + random_.randint(-8, 8) * subject.period for _ in range(count)], np.int64
        )
        if count and random_.random() < 0.1:
            stamps[0] = random_.choice((-(2**63), -1, 0, 1, 2**62, 2**63 - 1))
        y, u = _values(random_, count, p), _values(random_, count, m)
        codes, outputs = np.zeros(count, np.int64), np.zeros((count, p), np.int64)
        now = random_.choice((at, 2**62, 0, -(2**63)))
        row = np.zeros(width)
        try:
            native.history_offer(
                *tracker, stamps, y, u, now, codes, outputs, np.zeros((count, p)),
                np.zeros((count, p)),
            )  # fmt: skip
            native.history_estimate(*tracker, at + random_.randint(-9, 9) * subject.period, row)
        except ValueError:
            return False
        at += random_.randint(0, 20) * subject.period
    return True


def fuzz(inputs: int, seed: int, note: Callable[[str], object]) -> tuple[Counter[str], float]:
    """Attack all subjects in turn; return what became of the inputs, and the longest time [s].

    Args:
        inputs: How many.
        seed: Of the changes.
        note: Called with what is attacked next.
    """
    results: Counter[str] = Counter()
    longest, targets = 0.0, subjects()
    try:
        for number in range(inputs):
            subject = targets[number % len(targets)]
            note(f"{seed} {number} {subject.name}\n")
            begun = time.monotonic()
            faulthandler.dump_traceback_later(_PATIENCE, exit=True)  # C handles no signal
            results[attack(subject, random.Random(f"{seed} {number}"))] += 1
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
