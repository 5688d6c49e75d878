# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs estimate`: observers over a recording, and a new bag of what they estimate."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tsobs_ros.cli.observer_options import add_observer_options, observers_of, source_of
from tsobs_ros.cli.options import Words, add_json
from tsobs_ros.cli.output import complain, progress, show
from tsobs_ros.errors import BagWriteError

if TYPE_CHECKING:
    from tsobs_ros.replay.estimate import Run
    from tsobs_ros.replay.source import Source


def add_parser(words: Words) -> None:
    """Add the word `estimate`."""
    estimate = words.add_parser(
        "estimate", help="run observers over a bag or a log, and write a bag of their estimates"
    )
    add_observer_options(estimate, ())
    estimate.add_argument(
        "--output", type=Path, metavar="NEWBAG", help="folder to make (default: BAG_estimates)"
    )
    estimate.add_argument(
        "--estimates-only", action="store_true", help="leave measurements and truth out of it"
    )
    add_json(estimate)
    estimate.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Run observers over a recording."""
    bag = options.bag.absolute()
    stem = bag.stem if bag.is_file() else bag.name
    output = options.output or bag.with_name(f"{stem}_estimates")
    if output.exists():
        raise BagWriteError(f"{output}: exists already, bags are not overwritten")
    return estimate(options, output, estimates_only=options.estimates_only)


def estimate(
    options: argparse.Namespace, output: Path | None, *, estimates_only: bool = False
) -> int:
    """Run the observers that the options name, show what came out, and return the exit code."""
    from tsobs_ros.replay.estimate import make_runs, run_all

    begun = time.monotonic()
    source = source_of(options)
    observers = observers_of(options, source.joints)
    as_live = options.rate is None and options.at != "measurements"
    runs = make_runs(source, observers, rate=options.rate, as_live=as_live)
    with progress(source.samples.count * len(runs), " samples", quiet=options.json) as told:
        run_all(source, runs, output, estimates_only=estimates_only, progress=told)
    result = _Result(source, runs, output, time.monotonic() - begun)
    show(result.as_mapping(), result.text(), options.json)
    if source.damage is not None:
        complain(f"{source.damage}; estimated up to there")
    return 0 if source.damage is None else 1


class _Result:
    """What came out, for people and programs."""

    def __init__(
        self, source: "Source", runs: "list[Run]", output: Path | None, seconds: float
    ) -> None:
        self._source, self._runs, self._output = source, runs, output
        self._seconds = seconds
        times = source.samples.log_times
        self._duration = float(times.max() - times.min()) * 1e-9
        agreements = [run.agreement() for run in runs]
        # Of several observers at most one was the live one.
        self._agreement = max(
            (one for one in agreements if one is not None),
            key=lambda one: one.reproduced,
            default=None,
        )
        from tsobs_ros.report.comparison import compare_runs

        self._errors = compare_runs(source, runs) if len(runs) > 1 else []

    def text(self) -> str:
        source = self._source
        lines = [
            f"{source.path}: {source.samples.count:,} measurements of {', '.join(source.joints)} "
            f"over {self._duration:.1f} s, in {self._seconds:.1f} s"
        ]
        width = max(len(run.observer.name) for run in self._runs)
        for run in self._runs:
            rejected = ", ".join(
                f"{n:,} {reason.value}" for reason, n in run.replay.rejected.items()
            )
            lines.append(
                f"{run.observer.name:<{width}}  {run.table.done.sum():,} estimates from "
                f"{run.replay.used:,} measurements; rejected: {rejected or 'none'}"
            )
        lines += source.remarks
        if self._agreement is not None:
            lines.append(self._agreement.text())
        if self._errors:
            from tsobs_ros.report.comparison import render_comparison

            lines += ["", render_comparison(self._errors)]
        if self._output is not None:
            lines += [f"wrote {self._output}"]
        return "\n".join(lines)

    def as_mapping(self) -> dict[str, Any]:
        source = self._source
        return {
            "source": str(source.path),
            "output": None if self._output is None else str(self._output),
            "joints": list(source.joints),
            "measurements": source.samples.count,
            "duration": self._duration,
            "seconds": self._seconds,
            "observers": [
                {
                    "name": run.observer.name,
                    "method": run.observer.settings.method,
                    "estimates": int(run.table.done.sum()),
                    "used": run.replay.used,
                    "rejected": {r.value: n for r, n in run.replay.rejected.items()},
                    "rewinds": run.replay.rewinds,
                    "failures": run.replay.failures,
                }
                for run in self._runs
            ],
            "live": None if self._agreement is None else self._agreement._asdict(),
            "errors": [one.as_mapping() for one in self._errors],
            "remarks": list(source.remarks),
            "damage": None if source.damage is None else str(source.damage),
        }
