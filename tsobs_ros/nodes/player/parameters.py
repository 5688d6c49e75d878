# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The player's parameters, and which topics of a bag they select."""

from collections.abc import Iterable
from dataclasses import dataclass

from tsobs_ros.errors import ParameterError
from tsobs_ros.nodes.selection import SelectingParameters
from tsobs_ros.settings import live_setting, setting

CLOCK = "/clock"


@dataclass(frozen=True)
class PlayerParameters(SelectingParameters):
    """The node's parameters; `config/player.yaml` shows them with their reasons."""

    bag: str = setting("", "Bag folder or .mcap file to play")
    rate: float = live_setting(
        1.0, "Speed of the playback: seconds of the bag per second", minimum=0.01, maximum=100.0
    )
    loop: bool = live_setting(False, "Start again at the end")
    start_offset: float = setting(
        0.0, "Start of each pass, from the bag's start", unit="s", minimum=0.0
    )
    duration: float = setting(
        0.0, "How much of the bag a pass plays; 0: all that is left", unit="s", minimum=0.0
    )
    position: float = live_setting(
        0.0,
        "Set it to go there, back or forth, from the bag's start; playing starts there too",
        unit="s",
        minimum=0.0,
    )
    start_paused: bool = setting(False, "Start in a pause")
    clock: float = setting(
        0.0,
        "How often to publish the bag's time on /clock, in place of the bag's own; 0: never",
        unit="Hz",
        minimum=0.0,
        maximum=10_000.0,
    )
    wait_for_subscribers: int = setting(
        1, "Subscriptions to wait for before playing starts", minimum=0
    )
    wait_timeout: float = setting(5.0, "Longest wait for them; 0: no limit", unit="s", minimum=0.0)
    queue_depth: int = setting(
        1000,
        "Messages of a topic that slow subscribers may leave waiting",
        minimum=1,
        maximum=1_000_000,
    )

    def select(self, names: Iterable[str]) -> list[str]:
        """Return which of a bag's topics to play.

        Raises:
            ParameterError: A listed topic is not in the bag, or none is left.
        """
        there = list(names)
        listed, excluded = (
            {f"/{name.removeprefix('/')}" for name in given}
            for given in (self.topics, self.exclude_topics)
        )
        has = f"the bag has {', '.join(there) or 'none'}"
        if missing := sorted(listed - set(there)):
            raise ParameterError(f"parameter 'topics': no topic {', '.join(missing)}; {has}")
        if self.clock:
            excluded.add(CLOCK)
        default = set() if listed or self.regex else set(there)
        selected = [
            name for name in there if self.takes(name, name in listed | default, name in excluded)
        ]
        if there and not selected:
            raise ParameterError(f"the parameters leave no topic to play; {has}")
        return selected

    def window(self, start: int, end: int) -> tuple[int, int]:
        """Return where a pass of a bag from `start` to `end` starts and ends [ns].

        Raises:
            ParameterError: The offset is beyond the bag's end.
        """
        begin = start + round(self.start_offset * 1e9)
        if begin > end:
            raise ParameterError(
                f"parameter 'start_offset' must be at most {(end - start) * 1e-9:.9g} s, the bag's "
                f"length, got {self.start_offset:g}"
            )
        return begin, min(end, begin + round(self.duration * 1e9)) if self.duration else end
