# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `player` node: playback of a bag onto its topics, with the recorded timing.

topics:
  the topics of the bag that the parameters select (out), by default all
  /clock (out)        rosgraph_msgs/msg/Clock: the time of the bag, with `clock`
  /diagnostics (out)  diagnostic_msgs/msg/DiagnosticArray: position and counts, once per second

services, std_srvs/srv/Trigger:
  ~/pause             stop at the present position
  ~/resume            continue from there
"""

import math
import sys
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from msgspec.structs import replace
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rosgraph_msgs.msg import Clock

from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.metadata import QosProfile, QosTime, TopicInfo
from tsobs_ros.bag.playback import Playback, read_passes
from tsobs_ros.bag.reader import UNCHECKED, BagMessage, BagReader
from tsobs_ros.errors import BagWriteError, NodeError, ParameterError
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.parameters import SelectingParameters, expanded
from tsobs_ros.nodes.runtime import Ticker
from tsobs_ros.nodes.wire import clock_message, message_class, wait_until_taken
from tsobs_ros.settings import live_setting, setting

_READ_AHEAD = 8 * 2**20
# Time that a due message waits for the interpreter while the reader's thread unpacks a chunk of
# the bag; Python's default of 5 ms is too long [s].
_SWITCH_INTERVAL = 0.0005
# Longest time of catching up without a break, while services wait [ns].
_MAX_BURST = 5_000_000
_WAIT_POLL = 10_000_000
_ACKNOWLEDGE_TIMEOUT = 5.0
# Longest wait between ticks, after which a change of the rate takes effect [s].
_MAX_WAIT = 0.02
# Time to wait after the last new subscriber [ns]: a best-effort one receives nothing before it has
# matched the publisher too, and others may be discovered at the same time.
_SETTLING = 200_000_000
# Depth of ROS's default profile, for latched publishers of unknown depth; and depth of the others,
# that is, how many messages may wait for slow reliable subscribers.
_USUAL_DEPTH, _DEPTH = 10, 1000
_HEADER_SIZE = 4  # of a message in CDR [bytes]
_FOREVER = 2**63 - 1

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
        0.0, "Start of each pass, from the bag's start", unit="s", minimum=0.0, maximum=1e9
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

    def select(self, names: Iterable[str]) -> list[str]:
        """Return the topics of a bag to play.

        Raises:
            ParameterError: A listed topic is not in the bag, or none is left.
        """
        there, own = list(names), self.resolved(lambda _, name: f"/{name.removeprefix('/')}")
        has = f"the bag has {', '.join(there) or 'none'}"
        if missing := sorted(set(own.topics) - set(there)):
            raise ParameterError(f"parameter 'topics': no topic {', '.join(missing)}; {has}")
        selected = [
            name for name in there if own.takes(name) and not (self.clock and name == CLOCK)
        ]
        if there and not selected:
            raise ParameterError(f"the parameters leave no topic to play; {has}")
        return selected


class Player(ManagedNode[PlayerParameters]):
    """Plays a bag while it is active; deactivating is a pause, cleaning up releases the bag.

    `bag.playback` schedules the messages; the node adds the time, the publishers and the controls:
    services with the names of rosbag2's player, and live parameters.
    """

    def configure(self) -> None:
        """Open the bag, offer its topics and read ahead."""
        parameters = self.parameters
        if not parameters.bag:
            raise ParameterError("parameter 'bag' must name a bag folder or an .mcap file")
        if self.get_parameter("use_sim_time").value:
            self.log(Level.WARN, "use_sim_time does not matter: the player makes the time")
        self._reader = reader = BagReader(expanded("bag", parameters.bag))
        self._start = reader.start_time or 0
        end = reader.end_time or self._start
        start = self._start + round(parameters.start_offset * 1e9)
        length = (end - self._start) * 1e-9
        if start > end:
            raise ParameterError(
                f"parameter 'start_offset' must be at most {length:.9g} s, the bag's length, got "
                f"{parameters.start_offset:g}"
            )
        selected = [reader.topics[name] for name in parameters.select(reader.topics)]
        self._played = played_topics(self, selected)
        self.at_cleanup(wait_until_taken, self._played.values(), _ACKNOWLEDGE_TIMEOUT)
        self._counts = dict.fromkeys(self._played, 0)
        self._clock_publisher: Any = None
        if parameters.clock:
            self._clock_publisher = self.create_publisher(Clock, CLOCK, 10)
        latched = {
            name: each.qos_profile.depth
            for name, each in self._played.items()
            if each.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        }
        messages = read_passes(reader, list(self._counts), latched, start, end, _READ_AHEAD)
        self.at_cleanup(messages.close)
        self.at_cleanup(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(_SWITCH_INTERVAL)
        self._playback = Playback(
            messages,
            start,
            end,
            time.monotonic_ns(),
            rate=parameters.rate,
            clock_rate=parameters.clock,
            loop=parameters.loop,
        )
        self._paused, self._is_awaited = parameters.start_paused, True
        self.offer_diagnostics(str(reader.path), self._statuses)
        acts = {"pause": partial(self._pause, True), "resume": partial(self._pause, False)}
        self.offer_triggers(acts)
        self.ticker = Ticker(self, _MAX_WAIT, self._play, executor_clock=self.steady)
        self.at_cleanup(self._log_end)
        self.log(
            Level.OK,
            f"opened {reader.path}: {sum(t.count for t in selected)} messages of "
            f"{len(selected)} topics, {length:.3f} s",
        )

    def activate(self) -> None:
        """Play as soon as there are subscribers, unless paused."""
        self._is_awaited = True
        self._activated = self._since = time.monotonic_ns()
        self._there = 0

    def deactivate(self) -> None:
        """Stand still."""
        self._playback.pause(time.monotonic_ns())

    def _log_end(self) -> None:
        """Log the number of messages played."""
        if self._reader.unchecked:
            self.log(Level.WARN, f"{self._reader.path}: {UNCHECKED}")
        self.log(Level.OK, f"played {self.messages} messages of {len(self._counts)} topics")

    def retune(self, parameters: PlayerParameters) -> None:
        """Play at another rate, with or without a loop."""
        self._playback.set_rate(parameters.rate, time.monotonic_ns())
        self._playback.loop = parameters.loop

    @property
    def messages(self) -> int:
        """The number of messages published since the node was configured."""
        return sum(self._counts.values())

    @property
    def position(self) -> float:
        """The present position, from the bag's start [s]."""
        return (self._playback.position(time.monotonic_ns()) - self._start) * 1e-9

    @property
    def doing(self) -> str:
        """The state, in words."""
        states = {
            "inactive": not self.active,
            "paused": self._paused,
            "waiting for subscribers": self._is_awaited,
            "ended": self._playback.ended,
        }
        return next((text for text, holds in states.items() if holds), "playing")

    def _play(self) -> int:
        """Publish all messages that are due; return the time until the next one [ns]."""
        playback, now = self._playback, time.monotonic_ns()
        if not self.active:
            return _WAIT_POLL
        if playback.paused and not (self._paused or playback.ended):
            if self._is_awaited and not self._may_start(now):
                return _WAIT_POLL
            playback.position(now)  # reads the first message, which may take a while
            now = time.monotonic_ns()
            playback.resume(now)
        burst_end = now + _MAX_BURST
        held_back = playback.held_back
        while now < burst_end and (event := playback.take(now)) is not None:
            if event.message is not None:
                self._publish(event.message)
            else:
                self._clock_publisher.publish(clock_message(event.time))
            now = time.monotonic_ns()
        if playback.held_back > held_back and self.is_due("lag"):
            self.log(
                Level.WARN,
                f"{(playback.held_back - held_back) * 1e-9:.3f} s behind: continuing from here, "
                "with nothing left out",
            )
        self.done = playback.ended
        return playback.wait(now)

    def _publish(self, message: BagMessage) -> None:
        """Publish a message; leave out what no message of its type is, with a warning per topic."""
        name = message.topic
        try:
            if (size := len(message.data)) < _HEADER_SIZE:  # subscribers wait for it for ever
                raise NodeError(f"expected at least {_HEADER_SIZE} bytes, got {size}")
            self._played[name].publish(message.data)
            self._counts[name] += 1
        except RuntimeError as error:  # rclpy does not export its own
            if self.is_due(f"unfit {name}", math.inf):
                unfit = f"leaving out messages of {name} that do not fit {message.type}"
                self.log(Level.WARN, f"{unfit}: {error}")

    def _may_start(self, now: int) -> bool:
        """Return whether enough subscribers are there and settled, or the wait is over."""
        wanted = self.parameters.wait_for_subscribers if self._counts else 0
        there = sum(each.get_subscription_count() for each in self._played.values())
        if there != self._there:
            self._there, self._since = there, now
        is_over = 0.0 < self.parameters.wait_timeout <= (now - self._activated) * 1e-9
        if is_over and there < wanted:
            self.log(Level.WARN, f"playing to {there} of {wanted} subscriptions")
        has_settled = there >= wanted and now - self._since >= _SETTLING
        self._is_awaited = wanted > 0 and not is_over and not has_settled
        return not self._is_awaited

    def _pause(self, paused: bool) -> str:
        self._paused = paused
        if paused:
            self._playback.pause(time.monotonic_ns())
        return f"{self.doing} at {self.position:.3f} s"

    def _statuses(self) -> list[Status]:
        values = {
            "position [s]": f"{self.position:.3f}",
            "rate": f"{self.parameters.rate:g}",
            "held back [s]": f"{self._playback.held_back * 1e-9:.3f}",
            "messages": str(self.messages),
            **{f"messages of {name}": str(count) for name, count in self._counts.items()},
        }
        return [Status("playing", Level.OK, self.doing, values)]


def played_topics(
    node: ManagedNode[PlayerParameters], topics: Iterable[TopicInfo]
) -> dict[str, Publisher]:
    """Return publishers for topics of a bag, by their names in the bag.

    Topics that cannot be published, or whose bytes subscribers would misinterpret, are left out
    with a warning.
    """
    publishers = {}
    for topic in topics:
        try:
            with suppress(BagWriteError):  # a type without its own file, such as a service's event
                installed = find_definition(topic.type).type_hash
                if topic.type_hash and installed and topic.type_hash != installed:
                    raise NodeError(f"another definition of {topic.type} is installed")
            qos = offered_qos(topic.qos_profiles)
            publishers[topic.name] = node.create_publisher(
                message_class(topic.type), topic.name, qos
            )
        except Exception as error:  # rclpy's errors on names, types and profiles are of many kinds
            node.log(Level.WARN, f"not playing {topic.name}: {error}")
    return publishers


def offered_qos(profiles: tuple[QosProfile, ...]) -> QoSProfile:
    """Return the profile to offer on a topic: the recorded one if all its publishers agree.

    If they do not, or nothing was recorded, it is reliable and volatile, as for rosbag2. The depth
    matters to late subscribers of latched topics: there it is the sum of the publishers' depths, as
    one publisher now stands for all of them.
    """
    # History and depth do not matter for matching, and discovery often leaves them unknown.
    alike = {replace(profile, history="unknown", depth=0) for profile in profiles}
    profile = alike.pop() if len(alike) == 1 else QosProfile()
    depth = _DEPTH
    if profile.durability == "transient_local" and all(p.history != "keep_all" for p in profiles):
        depth = sum(p.depth or _USUAL_DEPTH for p in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=_policy(ReliabilityPolicy, profile.reliability, "reliable"),
        durability=_policy(DurabilityPolicy, profile.durability, "volatile"),
        deadline=_duration(profile.deadline),
        lifespan=_duration(profile.lifespan),
        liveliness=_policy(LivelinessPolicy, profile.liveliness, "automatic"),
        liveliness_lease_duration=_duration(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )


def _policy(policies: Any, name: str, default: str) -> Any:
    """Return a policy by name; the default for a name such as `unknown`."""
    known = {"best_effort", "transient_local", "manual_by_topic"}
    return policies[(name if name in known else default).upper()]


def _duration(time: QosTime) -> Duration:
    return Duration(nanoseconds=min(time.sec * 10**9 + time.nsec, _FOREVER))


Parameters = PlayerParameters
create = partial(Player, "player", Parameters)
