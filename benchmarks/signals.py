# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Clean ends of the executables on SIGINT, SIGTERM and SIGHUP, at any time.

The benchmark starts each executable repeatedly, alone and in pairs that are stopped together. It
signals them at a random time: while the interpreter starts, during the imports, while they join the
middleware, while they work; often a second time shortly after, while they end. An end is clean if
the exit code is 0, the output has no traceback or error, and a recorder's bag is closed. Every
deviation is printed with its output.

A signal that comes before an executable has its handlers in place, during the interpreter's own
start-up, ends the process as it ends any process. Such signals are recognised by the process's
signal mask in /proc just before they are sent, and are counted separately.
"""

import argparse
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from common import at_least, claim_domain, parser, show
from node_processes import Process, command_of
from tqdm import tqdm

from tsobs_ros.bag import BagReader, BagWriter
from tsobs_ros.errors import BagReadError

EXECUTABLES = ("plant_simulator", "observer", "recorder", "player")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Executables end a hang in Fast DDS after 5 s; this timeout is for other hangs.
STOP_TIMEOUT = 30.0
BAD_OUTPUT = ("Traceback", "\nerror", "[ERROR]", "[FATAL]")


@dataclass(frozen=True)
class Stop:
    """The end of one process.

    Attributes:
        what: The executable, and the other one that was stopped with it.
        signals: The signals by name, in order.
        after: Time from the process's start to the first signal [s].
        early: Whether the first signal came before the handlers were in place.
        took: Time from the first signal to the end [s].
        exit_code: Exit code; negative if a signal ended the process.
        output: Everything that the process printed.
    """

    what: str
    signals: tuple[str, ...]
    after: float
    early: bool
    took: float
    exit_code: int
    output: str

    @property
    def clean(self) -> bool:
        """Whether the process ended as it should."""
        return self.exit_code == 0 and not any(bad in f"\n{self.output}" for bad in BAD_OUTPUT)


class SignalledProcess(Process):
    """One executable as a child process.

    Args:
        name: Its name.
        parameters: ROS parameters by name.
        domain: ROS domain.
        folder: For logs and for the output, which goes to a file because a pipe could fill up.
    """

    def __init__(self, name: str, parameters: dict[str, Any], domain: int, folder: Path) -> None:
        self.began = time.monotonic()
        super().__init__(name, command_of(name, parameters), folder, domain)

    @property
    def running(self) -> bool:
        """Whether the process is still running."""
        return self._process.poll() is None

    @property
    def listens(self) -> bool:
        """Whether SIGTERM is caught or ignored, which no interpreter does by itself."""
        text = Path(f"/proc/{self._process.pid}/status").read_text(encoding="ascii")
        masks = dict(line.split(":\t", 1) for line in text.splitlines())
        handled = int(masks["SigCgt"], 16) | int(masks["SigIgn"], 16)
        return bool(handled >> (signal.SIGTERM - 1) & 1)

    def signal(self, number: int) -> None:
        """Send a signal, unless the process has ended."""
        self._process.send_signal(number)

    def finish(self, deadline: float) -> tuple[int, str]:
        """Return the exit code and the output; a process that hangs is killed."""
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.kill()
        return self._process.returncode, self.output


def parameters_of(name: str, folder: Path, bag: Path) -> dict[str, Any]:
    """Return the parameters with which an executable works until it is stopped."""
    if name == "recorder":
        return {"output": str(folder / "bag"), "flush_period": 0.1}
    if name == "player":
        return {"bag": str(bag), "loop": True, "wait_for_subscribers": 0}
    return {}


def stop_once(
    names: Sequence[str], chance: random.Random, until: float, bag: Path, domain: int
) -> list[Stop]:
    """Start executables, signal them together at a random time, and return how they end."""
    number = chance.choice(SIGNALS)
    after = chance.uniform(0.0, until)
    again = [
        (chance.expovariate(1 / 0.15), chance.choice(SIGNALS))
        for _ in range(chance.choice([0, 0, 1, 2]))
    ]
    with tempfile.TemporaryDirectory(prefix="tsobs_signals_") as name:
        folder = Path(name)
        processes = [
            SignalledProcess(n, parameters_of(n, folder, bag), domain, folder) for n in names
        ]
        time.sleep(after)
        early = [process.running and not process.listens for process in processes]
        signalled = time.monotonic()
        for process in processes:
            process.signal(number)
        for pause, other in again:
            time.sleep(pause)
            for process in processes:
                process.signal(other)
        ended: dict[int, float] = {}
        while len(ended) < len(processes) and time.monotonic() < signalled + STOP_TIMEOUT:
            for index, process in enumerate(processes):
                if index not in ended and not process.running:
                    ended[index] = time.monotonic() - signalled
            time.sleep(0.002)
        stops = []
        for index, process in enumerate(processes):
            exit_code, output = process.finish(signalled + STOP_TIMEOUT)
            if process.name == "recorder":
                output += unfinished(folder / "bag")
            others = [other for other in names if other != process.name]
            stops.append(
                Stop(
                    what=" with ".join([process.name, *others]),
                    signals=tuple(signal.Signals(n).name for n in (number, *(o for _, o in again))),
                    after=signalled - process.began,
                    early=early[index],
                    took=ended.get(index, STOP_TIMEOUT),
                    exit_code=exit_code,
                    output=output,
                )
            )
    return stops


def unfinished(bag: Path) -> str:
    """Return the error of a recorder's bag, if there is a bag and an error."""
    try:
        if bag.exists():
            BagReader(bag)
    except BagReadError as error:
        return f"\nerror: {error}"
    return ""


def window(name: str, bag: Path, domain: int) -> float:
    """Return for how long after its start a signal would still kill an executable [s]."""
    with tempfile.TemporaryDirectory(prefix="tsobs_signals_") as folder:
        process = SignalledProcess(
            name, parameters_of(name, Path(folder), bag), domain, Path(folder)
        )
        while not process.listens:
            time.sleep(0.0005)
        took = time.monotonic() - process.began
        process.signal(signal.SIGTERM)
        process.finish(time.monotonic() + STOP_TIMEOUT)
    return took


def make_bag(path: Path) -> Path:
    """Write a bag of a second for the player."""
    with BagWriter(path) as writer:
        writer.add_topic("/chatter", "std_msgs/msg/String")
        for index in range(100):
            data = b"\x00\x01\x00\x00\x02\x00\x00\x00x\x00"
            stamp = 10**18 + index * 10**7
            writer.write("/chatter", data, stamp, stamp)
    return path


def rows(stops: Iterable[Stop], windows: dict[str, list[float]]) -> list[dict[str, Any]]:
    """Summarise the stops of each kind."""
    kinds: dict[str, list[Stop]] = {}
    for stop in stops:
        kinds.setdefault(stop.what, []).append(stop)
    found = []
    for what, those in kinds.items():
        caught = [stop for stop in those if not stop.early]
        took = [stop.took for stop in caught] or [0.0]
        found.append(
            {
                "what": what,
                "signals": sum(len(stop.signals) for stop in those),
                "processes": len(those),
                "early": len(those) - len(caught),
                "exit codes of early": dict(Counter(s.exit_code for s in those if s.early)),
                "clean": sum(stop.clean for stop in caught),
                "deviations": sum(not stop.clean for stop in caught),
                "median stop [s]": statistics.median(took),
                "slowest stop [s]": max(took),
                "deaf at start [s]": statistics.median(windows[what]) if what in windows else None,
            }
        )
    return found


def text(table: Sequence[dict[str, Any]], deviations: Sequence[Stop]) -> str:
    """Return the results as a text for people."""
    lines = [
        f"{'':34}{'processes':>10}{'signals':>9}{'clean':>7}{'deviate':>9}{'early':>7}"
        f"{'stop p50':>10}{'slowest':>9}{'deaf for':>10}"
    ]
    for row in table:
        deaf = row["deaf at start [s]"]
        lines.append(
            f"{row['what']:34}{row['processes']:>10}{row['signals']:>9}{row['clean']:>7}"
            f"{row['deviations']:>9}{row['early']:>7}{row['median stop [s]']:>8.2f} s"
            f"{row['slowest stop [s]']:>7.2f} s"
            + (f"{deaf * 1e3:>7.0f} ms" if deaf is not None else "")
        )
    for stop in deviations:
        lines += [
            f"\n{stop.what}: {', '.join(stop.signals)} after {stop.after:.3f} s: exit code "
            f"{stop.exit_code} after {stop.took:.2f} s, and its output was",
            *(f"    {line}" for line in stop.output.splitlines() or ["nothing"]),
        ]
    return "\n".join(lines)


def arguments() -> argparse.Namespace:
    """Read the command line."""
    made = parser(__doc__, design=False)
    made.add_argument(
        "-n", "--stops", type=at_least(0, int), default=100, help="of each executable alone"
    )
    made.add_argument(
        "--pairs", type=at_least(0, int), default=50, help="stops of each pair together"
    )
    made.add_argument("--until", type=at_least(0.0), default=3.0, help="latest first signal [s]")
    made.add_argument("--jobs", type=at_least(1, int), default=2, help="stops at the same time")
    made.add_argument("--seed", type=at_least(0, int), default=1)
    made.add_argument("--only", nargs="+", choices=EXECUTABLES, default=EXECUTABLES)
    return made.parse_args()


def main() -> int:
    """Run the benchmark.

    Returns:
        1 if any process did not end as it should, else 0.
    """
    options = arguments()
    for number in SIGNALS:  # children inherit the signals that background jobs or nohup ignore
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    names = [name for name in options.only if find_spec(f"tsobs_ros.nodes.{name}")]
    kinds = [((name,), options.stops) for name in names]
    if len(names) > 1:
        # Each executable is in two pairs, signalled once as the first and once as the second.
        kinds += [(pair, options.pairs) for pair in pairwise([*names, names[0]])]
    free_domains: SimpleQueue[int] = SimpleQueue()
    for _ in range(options.jobs):
        free_domains.put(claim_domain())
    with tempfile.TemporaryDirectory(prefix="tsobs_signals_") as folder:
        bag = make_bag(Path(folder) / "bag")
        domain = claim_domain()
        windows = {name: [window(name, bag, domain) for _ in range(5)] for name in names}

        def stop(case: tuple[Sequence[str], int]) -> list[Stop]:
            domain = free_domains.get()
            try:
                chance = random.Random(f"{options.seed} {case}")
                return stop_once(case[0], chance, options.until, bag, domain)
            finally:
                free_domains.put(domain)

        cases = [(kind, index) for kind, number in kinds for index in range(number)]
        with ThreadPoolExecutor(options.jobs) as pool:
            stops = [
                one
                for group in tqdm(pool.map(stop, cases), total=len(cases), disable=options.json)
                for one in group
            ]
    table = rows(stops, windows)
    deviations = [stop for stop in stops if not (stop.clean or stop.early)]
    results = {"rows": table, "deviations": [asdict(stop) for stop in deviations]}
    show(results, text(table, deviations), options.json)
    return 1 if deviations else 0


if __name__ == "__main__":
    sys.exit(main())
