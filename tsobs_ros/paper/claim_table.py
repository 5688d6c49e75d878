# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Claims with a verdict, the number that decides it and the test that shows it, as tables."""

import enum
import html
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any


class Verdict(enum.Enum):
    """What became of a claim."""

    HOLDS = "holds"
    HOLDS_ONLY_IF = "holds only if"
    DOES_NOT_HOLD = "does not hold"


@dataclass(frozen=True)
class Claim:
    """A claim and what became of it.

    Attributes:
        claim: What is said, in one sentence.
        verdict: Decided by `number`.
        condition: For `HOLDS_ONLY_IF`: if what; else why, or nothing.
        number: What was measured, as text with its unit.
        test: The test that shows it, as pytest takes it.
    """

    claim: str
    verdict: Verdict
    condition: str
    number: str
    test: str

    @property
    def judgement(self) -> str:
        """Verdict and condition as one phrase."""
        if self.verdict is Verdict.HOLDS_ONLY_IF:
            return f"{self.verdict.value} {self.condition}"
        return f"{self.verdict.value}: {self.condition}" if self.condition else self.verdict.value

    def as_mapping(self) -> dict[str, Any]:
        """Return the claim as plain data."""
        return {
            "claim": self.claim,
            "verdict": self.verdict.value,
            "condition": self.condition,
            "number": self.number,
            "test": self.test,
        }


HEAD = ("claim", "verdict", "number", "test")


def claim_rows(claims: Iterable[Claim]) -> list[tuple[str, str, str, str]]:
    """Return one row of text a claim."""
    return [(each.claim, each.judgement, each.number, each.test) for each in claims]


def claims_text(claims: Sequence[Claim], width: int = 96) -> str:
    """Return the claims for a terminal, each with its verdict in front."""
    lines = []
    for each in claims:
        head = f"{each.verdict.value.upper():<15}{each.claim}"
        lines += textwrap.wrap(head, width, subsequent_indent=" " * 15)
        detail = f"{each.condition}; {each.number}" if each.condition else each.number
        lines += textwrap.wrap(detail, width, initial_indent=" " * 17, subsequent_indent=" " * 17)
    return "\n".join(lines)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in HTML; a cell that is a verdict gets a class of that name."""
    cells = "".join(f"<th>{html.escape(each)}</th>" for each in head)
    lines = ["<table>", f"<thead><tr>{cells}</tr></thead>", "<tbody>"]
    for row in rows:
        cells = "".join(f"<td{_class(each)}>{html.escape(each)}</td>" for each in row)
        lines.append(f"<tr>{cells}</tr>")
    return "\n".join([*lines, "</tbody>", "</table>"])


def _class(cell: str) -> str:
    # "holds only if" begins with "holds" and must be tried before it.
    for verdict in (Verdict.HOLDS_ONLY_IF, Verdict.DOES_NOT_HOLD, Verdict.HOLDS):
        if cell == verdict.value or cell.startswith((f"{verdict.value} ", f"{verdict.value}:")):
            return f' class="{verdict.name.lower()}"'
    return ' class="test"' if cell.startswith("test/") else ""
