# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics of a bag that a player publishes: which ones, and with which QoS."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
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

from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.metadata import QosProfile, QosTime, TopicInfo
from tsobs_ros.errors import BagWriteError, NodeError, ParameterError
from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.parameters import SelectingParameters
from tsobs_ros.nodes.wire import message_class
from tsobs_ros.settings import live_setting, setting

# The depth of ROS's default profile, for a latched publisher of unknown depth; and what another may
# leave waiting for slow reliable subscribers.
_USUAL_DEPTH, _DEPTH = 10, 1000
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
        0.0, "Start of each pass, from the bag's start", unit="s", minimum=0.0
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
        """Return which of a bag's topics to play.

        Raises:
            ParameterError: A listed topic is not in the bag, or none is left.
        """
        there, own = list(names), self.resolved(lambda name: f"/{name.removeprefix('/')}")
        has = f"the bag has {', '.join(there) or 'none'}"
        if missing := sorted(set(own.topics) - set(there)):
            raise ParameterError(f"parameter 'topics': no topic {', '.join(missing)}; {has}")
        selected = [
            name for name in there if own.takes(name) and not (self.clock and name == CLOCK)
        ]
        if there and not selected:
            raise ParameterError(f"the parameters leave no topic to play; {has}")
        return selected


def played_topics(
    node: ManagedNode[PlayerParameters], topics: Iterable[TopicInfo]
) -> dict[str, Publisher]:
    """Return publishers for topics of a bag, by their names in the bag.

    Those that cannot be published, or whose bytes subscribers would decode as something else, are
    left out with a warning.
    """
    publishers = {}
    for topic in topics:
        try:
            with suppress(BagWriteError):  # no message of its own file, such as a service's event
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
    # Not policies that a subscription is matched by, and often unknown from discovery.
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
