# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a recovery kept of a bag, and what was lost."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_SHOWN = 10


@dataclass
class DamagedPart:
    """A part of a file that is lost, or cut off.

    Attributes:
        offset: Where in the file it begins, bytes.
        size: How large it is, bytes.
        reason: What is wrong with it.
        messages: How many messages it held; None where nothing tells.
    """

    offset: int
    size: int
    reason: str
    messages: int | None = None

    def __str__(self) -> str:
        """Return one line for people."""
        held = "" if self.messages is None else f", {self.messages} messages"
        return f"bytes {self.offset} to {self.offset + self.size}{held}: {self.reason}"


@dataclass
class FileRecovery:
    """What was found in one file.

    Attributes:
        name: The file's name.
        size: How much of it was read, bytes.
        is_finished: Whether its recorder had closed it.
        kept: The messages kept, by topic.
        dropped: The messages found and not kept, by reason.
        damage: The parts that are lost.
        stated: The messages the file itself claims to hold, by topic; None if that is lost.
        start_ns: The smallest log time kept, ns since the epoch; None without messages.
        end_ns: The largest log time kept, ns since the epoch; None without messages.
        error: Why it was not read at all; empty if it was.
    """

    name: str
    size: int = 0
    is_finished: bool = False
    kept: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    damage: list[DamagedPart] = field(default_factory=list)
    stated: Mapping[str, int] | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    error: str = ""

    def keep(self, topic: str, log_time: int) -> None:
        """Count a message."""
        self.kept[topic] += 1
        self.start_ns = log_time if self.start_ns is None else min(log_time, self.start_ns)
        self.end_ns = log_time if self.end_ns is None else max(log_time, self.end_ns)

    @property
    def missing(self) -> dict[str, int]:
        """How many messages of a topic are not there, as far as the file tells."""
        stated = self.stated or {}
        return {topic: n - self.kept[topic] for topic, n in stated.items() if n > self.kept[topic]}

    @property
    def is_whole(self) -> bool:
        """Whether nothing is known to be lost."""
        return not (self.error or self.damage or self.dropped or self.missing)

    @property
    def reason(self) -> str:
        """Why something is lost, in a few words."""
        if self.error or not self.size:
            return self.error or "it is empty"
        parts = [str(part) for part in self.damage[:1]]
        parts += [f"{count} messages {reason}" for reason, count in self.dropped.items()]
        return ", ".join(parts[:2]) or "it holds no messages"

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "name": self.name,
            "bytes_read": self.size,
            "finished": self.is_finished,
            "error": self.error,
            "kept": dict(self.kept),
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
            "dropped": dict(self.dropped),
            "missing": self.missing,
            "damage": [vars(part) for part in self.damage],
            "bytes_damaged": sum(part.size for part in self.damage),
        }

    def lines(self) -> list[str]:
        """Return lines for people."""
        if self.error:
            return [f"{self.name}: not read: {self.error}"]
        state = "finished" if self.is_finished else "without what its recorder had not flushed"
        lines = [f"{self.name}: {self.size} bytes, {state}: {self.kept.total()} messages kept"]
        lines += [f"  kept {count} of {topic}" for topic, count in sorted(self.kept.items())]
        if self.start_ns is not None and self.end_ns is not None:
            duration = (self.end_ns - self.start_ns) * 1e-9
            lines.append(f"  from {self.start_ns} ns to {self.end_ns} ns ({duration:.3f} s)")
        lines += [f"  lost {count} of {topic}" for topic, count in self.missing.items()]
        lines += [f"  dropped {count}: {reason}" for reason, count in self.dropped.items()]
        lines += [f"  damaged: {part}" for part in self.damage[:_SHOWN]]
        if len(self.damage) > _SHOWN:
            lines.append(f"  damaged: {len(self.damage) - _SHOWN} more parts")
        return lines


@dataclass(frozen=True)
class Recovery:
    """What a recovery did.

    Attributes:
        source: The damaged bag.
        output: The bag made of it.
        files: What was found, file by file.
        remarks: What else is to be known.
    """

    source: Path
    output: Path
    files: tuple[FileRecovery, ...]
    remarks: tuple[str, ...]

    @property
    def message_count(self) -> int:
        """How many messages were kept."""
        return sum(file.kept.total() for file in self.files)

    @property
    def is_whole(self) -> bool:
        """Whether nothing is known to be lost."""
        return all(file.is_whole for file in self.files)

    def reasons(self) -> str:
        """Return why something is lost, for each file the first reason, in one line."""
        return "; ".join(f"{file.name}: {file.reason}" for file in self.files)

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "source": str(self.source),
            "output": str(self.output),
            "messages": self.message_count,
            "whole": self.is_whole,
            "remarks": list(self.remarks),
            "files": [file.as_mapping() for file in self.files],
        }

    def text(self) -> str:
        """Return the same for people to read."""
        lines = [line for file in self.files for line in file.lines()]
        verdict = "nothing known to be lost" if self.is_whole else "NOT EVERYTHING, see above"
        return "\n".join(
            [*self.remarks, *lines, f"{self.message_count} messages in {self.output}: {verdict}"]
        )
