# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How punctual a player is, and what it says of itself."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tsobs_ros.estimation.health import Level, Status


class PlayerState(NamedTuple):
    """Where a player is.

    Attributes:
        doing: What it is doing, for people.
        position: From the bag's start [s].
        length: The bag's [s].
        rate: Seconds of the bag per second.
        paused: Whether its user wants a pause.
        held_back: For how long the end was put off in total, as publishing was too slow [s].
        messages: How many have been published, by topic.
    """

    doing: str
    position: float
    length: float
    rate: float
    paused: bool
    held_back: float
    messages: Mapping[str, int]


class LagMeter:
    """Collects how late messages are published; `status` reads it out and restarts."""

    def __init__(self) -> None:
        self._lags: list[int] = []
        self._held_back = 0.0

    def add(self, lag: int) -> None:
        """Note by how much a message was published after it was due [ns]."""
        self._lags.append(lag)

    def status(self, state: PlayerState) -> Status:
        """Return the player's status since the last call."""
        lags, self._lags = self._lags, []
        late = state.held_back > self._held_back
        self._held_back = state.held_back
        values = {
            "position [s]": f"{state.position:.3f}",
            "length [s]": f"{state.length:.3f}",
            "rate": f"{state.rate:g}",
            "paused": str(state.paused).lower(),
            "held back [s]": f"{state.held_back:.3f}",
        }
        if lags:
            median, high = np.percentile(lags, (50, 99)) * 1e-6
            values |= {"lag p50 [ms]": f"{median:.3f}", "lag p99 [ms]": f"{high:.3f}"}
        values["messages"] = str(sum(state.messages.values()))
        values |= {f"messages of {name}": str(n) for name, n in state.messages.items()}
        level = Level.WARN if late else Level.OK
        return Status("playing", level, "too slow for the rate" if late else state.doing, values)
