# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hostile files: each one must be read or refused, soon and in little memory.

    python benchmarks/fuzz.py --inputs 100000

Each input is a good file with a few mutations. Reading it must end in a result or a TsobsError
within five seconds, in a process with a limited address space. Failing inputs are kept and listed.
"""

import argparse
import multiprocessing
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from common import at_least
from fuzz_targets import TARGETS, Target

from tsobs_ros.errors import TsobsError

_PATIENCE = 5.0
_GROWTH_LIMIT = 512 * 2**20
_KEPT = 5


@dataclass
class Outcome:
    """The outcomes of the inputs of one target.

    Attributes:
        target: Name of the target.
        results: Counts: read, refused, or the kind of the failure.
        failures: The first failures: traceback, and where the input is kept.
        slowest: Longest time for one input [s].
        growth: Growth of the process's memory from the first to the last input [MiB].
    """

    target: str
    results: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    slowest: float = 0.0
    growth: float = 0.0


class _HangError(Exception):
    """An input took too long."""


def fuzz(name: str, target: Target, inputs: int, seed: int, folder: Path, keep: Path) -> Outcome:
    """Read `inputs` mutated files and return the outcomes.

    Args:
        name: The target's name.
        target: The reader to fuzz.
        inputs: Number of files to read.
        seed: Of the mutations.
        folder: Folder for the file that is read.
        keep: Folder for inputs that failed.
    """
    outcome, random_ = Outcome(name), random.Random(f"{seed} {name}")
    path = folder / target.file_name
    for seed_file in target.seeds:  # loads beforehand everything that the first use loads
        path.write_bytes(seed_file)
        with suppress(TsobsError):
            target.read(path)
    signal.signal(signal.SIGALRM, _hang)
    memory = _memory()
    for number in range(inputs):
        chosen = random_.choice(target.seeds)
        data = target.mutate(chosen, target.seeds, random_)
        path.write_bytes(data)
        begun = time.monotonic()
        signal.setitimer(signal.ITIMER_REAL, _PATIENCE)
        try:
            target.read(path)
            result = "read"
        except TsobsError:
            result = "refused"
        except Exception as error:  # any such error is a finding
            result = f"{type(error).__name__}"
            _keep(outcome, keep / f"{name}_{number}", data)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        outcome.slowest = max(outcome.slowest, time.monotonic() - begun)
        outcome.results[result] += 1
        if number == min(200, inputs // 2):
            memory = _memory()  # everything that is loaded only once is loaded by now
    outcome.growth = (_memory() - memory) / 2**20
    return outcome


def _keep(outcome: Outcome, path: Path, data: bytes) -> None:
    if len(outcome.failures) < _KEPT:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        outcome.failures.append(f"{path}\n{traceback.format_exc()}")


def _hang(number: int, frame: FrameType | None) -> None:
    raise _HangError(f"not done after {_PATIENCE:g} s")


def _memory() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize()


def _in_process(job: tuple[str, int, int, Path]) -> Outcome:
    """Fuzz one target; its process's address space may grow by a limited amount only."""
    name, inputs, seed, keep = job
    with tempfile.TemporaryDirectory() as good, tempfile.TemporaryDirectory() as folder:
        target = TARGETS[name](Path(good))
        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        limit = used * resource.getpagesize() + _GROWTH_LIMIT
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        return fuzz(name, target, inputs, seed, Path(folder), keep)


def main() -> int:
    """Fuzz all targets and return 1 if any input ended in a forbidden way."""
    made = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    made.add_argument(
        "--inputs", type=at_least(1, int), default=100_000, help="in all (default: 100,000)"
    )
    made.add_argument(
        "--target", action="append", choices=TARGETS, help="only this one; may be given repeatedly"
    )
    made.add_argument("--seed", type=at_least(0, int), default=1)
    made.add_argument("--jobs", type=at_least(1, int), default=2)
    made.add_argument("--keep", type=Path, default=Path("fuzz_failures"), metavar="FOLDER")
    options = made.parse_args()
    names = options.target or list(TARGETS)
    each = -(-options.inputs // len(names))
    jobs = [(name, each, options.seed, options.keep) for name in names]
    with multiprocessing.get_context("spawn").Pool(options.jobs, maxtasksperchild=1) as pool:
        outcomes: list[Any] = pool.map(_in_process, jobs, chunksize=1)
    bad = 0
    print(
        f"{'target':<12}{'inputs':>9}{'read':>9}{'refused':>9}{'other':>7}{'slowest':>10}{'grew':>9}"
    )
    for one in outcomes:
        total = sum(one.results.values())
        other = total - one.results["read"] - one.results["refused"]
        bad += other
        print(
            f"{one.target:<12}{total:>9}{one.results['read']:>9}{one.results['refused']:>9}"
            f"{other:>7}{one.slowest * 1e3:>7.0f} ms{one.growth:>5.0f} MiB"
        )
    for one in outcomes:
        for failure in one.failures:
            print(f"\n{one.target}: {failure}", file=sys.stderr)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
