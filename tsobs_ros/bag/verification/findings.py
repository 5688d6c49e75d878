# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Collecting what a check finds, without a line for each of a million messages."""

from typing import NamedTuple


class Finding(NamedTuple):
    """One thing that is not as it should be.

    Attributes:
        place: The file, or the file and the topic.
        text: What was expected and what is there, of the first such case.
        cases: How many such cases there are in this place.
    """

    place: str
    text: str
    cases: int

    def __str__(self) -> str:
        """Return one line for people."""
        more = f" (and {self.cases - 1} more)" if self.cases > 1 else ""
        return f"{self.place}: {self.text}{more}"


class Findings:
    """What was found so far: errors, at which a reader fails or loses something, and remarks."""

    def __init__(self) -> None:
        self._errors: dict[tuple[str, str], Finding] = {}
        self._remarks: dict[tuple[str, str], Finding] = {}

    @property
    def errors(self) -> tuple[Finding, ...]:
        """The errors, in the order of their first case."""
        return tuple(self._errors.values())

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """The remarks, in the order of their first case."""
        return tuple(self._remarks.values())

    def error(self, place: str, text: str, rule: str = "") -> None:
        """Add an error; those of one rule in one place are counted, and the first is told."""
        _add(self._errors, place, text, rule)

    def remark(self, place: str, text: str, rule: str = "") -> None:
        """Add a remark; those of one rule in one place are counted, and the first is told."""
        _add(self._remarks, place, text, rule)

    def expect(self, place: str, what: str, stated: object, actual: object) -> None:
        """Add an error if what is stated is not what is there."""
        if stated != actual:
            self.error(place, f"{what} is stated as {stated}, but is {actual}")


def _add(findings: dict[tuple[str, str], Finding], place: str, text: str, rule: str) -> None:
    key = (place, rule or text)
    known = findings.get(key)
    findings[key] = known._replace(cases=known.cases + 1) if known else Finding(place, text, 1)
