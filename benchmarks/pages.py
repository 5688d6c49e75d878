# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables in Markdown, and the part of a page that a benchmark writes."""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from acceptance_demands import Demand

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


def update(page: Path, script: str, text: str) -> None:
    """Put a text between the marks that a page has for a script of this folder."""
    begin = f"<!-- begin: written by benchmarks/{script} -->"
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    _, end, after = rest.partition(_END)
    if not (found and end):
        sys.exit(f"{page}: expected the marks {begin} and {_END}")
    page.write_text(f"{before}{begin}\n\n{text}\n\n{end}{after}", encoding="utf-8")
