# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Shared code of scenario benchmarks: options, tables in Markdown, and the page to write into."""

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Collection, Iterator, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any, NoReturn

from acceptance_demands import Demand
from common import at_least, show

_END = "<!-- end -->"


def row(*cells: str) -> str:
    """Return a row of a table."""
    return "| " + " | ".join(cells) + " |"


def head(*cells: str) -> Iterator[str]:
    """Yield the first two lines of a table."""
    yield row(*cells)
    yield "|---" * len(cells) + "|"


def verdicts(found: Sequence[Demand]) -> Iterator[str]:
    """Yield demands with their numbers and bars."""
    yield from head("scenario", "demand", "number", "bar", "", "median of the runs' ratios")
    for one in found:
        bar = f"{'≥' if one.at_least else '≤'} {one.bar:g}"
        verdict = "pass" if one.passed else "**fail**"
        median = "" if one.median is None else f"{one.median:.3f}"
        yield row(one.scenario, one.text, f"{one.value:.4g}", bar, verdict, median)


def options_of(made: ArgumentParser, known: Collection[str], runs: int = 40) -> Namespace:
    """Return the options of a benchmark, with the seeds of its runs of each scenario."""
    made.add_argument(
        "--runs", type=at_least(1, int), default=runs, help=f"number of runs, {runs} by default"
    )
    made.add_argument("--first-seed", type=at_least(0, int), default=9000)
    made.add_argument("--processes", type=at_least(1, int), default=2)
    made.add_argument("--update", type=Path, metavar="PAGE", help="also write into a page")
    if known:
        made.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="default: all")
    options = made.parse_args(namespace=Namespace(scenarios=[]))
    for name in options.scenarios:
        if name not in known:
            made.error(f"no scenario {name}; there is {', '.join(known)}")
    options.scenarios = options.scenarios or list(known)
    options.seeds = range(options.first_seed, options.first_seed + options.runs)
    return options


def end(
    options: Namespace, script: str, text: str, results: Mapping[str, Any], found: Sequence[Demand]
) -> NoReturn:
    """Show the results, also in the page of `--update`; fail if a demand is missed."""
    if options.update is not None:
        update(options.update, Path(script).name, text)
    listed = [
        {**one._asdict(), "value": one.value if isfinite(one.value) else None}
        | {"passed": one.passed}
        for one in found
    ]
    show({"runs": options.runs, **results, "demands": listed}, text, options.json)
    sys.exit(0 if all(one.passed for one in found) else 1)


def update(page: Path, script: str, text: str) -> None:
    """Replace the text between a page's marks for a script of this folder."""
    begin = f"<!-- begin: written by benchmarks/{script} -->"
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    _, end, after = rest.partition(_END)
    if not (found and end):
        sys.exit(f"{page}: expected the marks {begin} and {_END}")
    page.write_text(f"{before}{begin}\n\n{text}\n\n{end}{after}", encoding="utf-8")
