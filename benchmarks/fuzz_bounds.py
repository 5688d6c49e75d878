# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Largest cost of crafted bags: processor time and memory of each command.

    python benchmarks/fuzz_bounds.py

Each bag is small compared with the work that it causes. Each command runs in a separate process; a
process that exceeds the bounds of docs/security.md is reported.
"""

import argparse
import multiprocessing
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

MAX_MEMORY = 600
"""Largest resident size of a command [MB]."""

SECONDS = 5.0
SECONDS_PER_MB = 1.0
SECONDS_PER_GB = 2.0
"""Processor time of a command: a constant, plus a share per stored MB and per GB of the file."""

COMMANDS = ("info", "verify", "recover", "read")


def seconds_of(file: Path) -> float:
    """Return the largest processor time for a file [s]."""
    if not file.is_file():
        return SECONDS
    found = file.stat()
    stored, size = found.st_blocks * 512, found.st_size
    return SECONDS + SECONDS_PER_MB * stored / 1e6 + SECONDS_PER_GB * size / 1e9


def run(command: str, bag: Path, patience: float = 600.0) -> tuple[float, float, int, str]:
    """Run a command in a separate process.

    Args:
        command: One of `COMMANDS`; `read` reads all messages, and the last ones of each topic.
        bag: The bag to run it on.
        patience: Processor time after which the process is killed [s].

    Returns:
        Processor time [s], largest resident size [MB], exit code, and the last line of its output.
    """
    code = [sys.executable, __file__, "--one", command, str(bag), "--patience", str(patience)]
    try:
        # A process that waits for ever uses no processor time.
        done = subprocess.run(
            code, capture_output=True, text=True, check=False, timeout=20.0 * patience
        )
    except subprocess.TimeoutExpired:
        return patience, float("nan"), -1, "hangs"
    *lines, measured = done.stdout.splitlines() or [""]
    if not measured.startswith("cost "):
        return patience, float("nan"), done.returncode, (done.stderr.splitlines() or [""])[-1]
    seconds, memory = map(float, measured.split()[1:])
    text = [*lines, *done.stderr.splitlines()]
    return seconds, memory, done.returncode, text[-1] if text else ""


def _one(command: str, bag: Path, patience: float) -> int:
    """Run a command in this process and print its cost."""
    resource.setrlimit(resource.RLIMIT_CPU, (int(patience) + 1, int(patience) + 2))
    from tsobs_ros.bag.reader import BagReader
    from tsobs_ros.cli.main import main as tsobs
    from tsobs_ros.errors import TsobsError

    output = bag.parent / "recovered"
    if command == "read":
        code = 0
        try:
            reader = BagReader(bag)
            print(sum(1 for _ in reader.messages()), "messages")
            reader.last_before(2**63, depth=2**31)
        except TsobsError as error:
            print(f"error: {error}")
            code = 1
    else:
        extra = ["--output", str(output)] if command == "recover" else []
        code = tsobs(["bag", command, str(bag), *extra])
    shutil.rmtree(output, ignore_errors=True)
    sys.stdout.flush()
    usage = resource.getrusage(resource.RUSAGE_SELF)
    status = Path("/proc/self/status").read_text(encoding="ascii")
    peak = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    print("cost", usage.ru_utime + usage.ru_stime, peak / 1e3)
    return code


def _make(name: str, folder: Path) -> None:
    from fuzz_bags import BAGS

    BAGS[name](folder)


def measure(names: list[str]) -> Iterator[tuple[str, str, float, float, float, int, str]]:
    """Yield name, command, limit [s], seconds, memory [MB], exit code and the last line."""
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            bag = Path(folder) / "bag"
            bag.mkdir()
            # In another process, so that the measured processes do not inherit its memory.
            maker = multiprocessing.get_context("spawn").Process(target=_make, args=(name, bag))
            maker.start()
            maker.join()
            (file,) = bag.iterdir()
            target = bag if file.name == "metadata.yaml" else file
            limit = seconds_of(file)
            for command in COMMANDS:
                yield name, command, limit, *run(command, target)


def main() -> int:
    """Measure all and return 1 if a bound is exceeded."""
    made = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    made.add_argument("--bag", action="append", help="only this one; may be given repeatedly")
    made.add_argument("--one", nargs=2, metavar=("COMMAND", "BAG"), help=argparse.SUPPRESS)
    made.add_argument("--patience", type=float, default=600.0, help=argparse.SUPPRESS)
    options = made.parse_args()
    if options.one:
        return _one(options.one[0], Path(options.one[1]), options.patience)
    from fuzz_bags import BAGS

    bad = 0
    print(f"{'bag':<28}{'command':<9}{'CPU s':>7}{'of':>7}{'MB':>7}  result")
    for name, command, limit, seconds, memory, code, text in measure(options.bag or list(BAGS)):
        over = seconds > limit or not memory < MAX_MEMORY or code not in (0, 1)
        bad += over
        print(
            f"{name:<28}{command:<9}{seconds:>7.1f}{limit:>7.1f}{memory:>7.0f}"
            f"{' !' if over else '  '}{code} {text[:70]}",
            flush=True,
        )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
