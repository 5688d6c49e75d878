# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The quality of service a recorded topic was offered with, in the form rosbag2 writes it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import yaml

from tsobs_ros.yaml_files import load_yaml, whole_number

# In the order of the RMW's enumerations: bags from before Jazzy name a policy by its number.
POLICIES: Mapping[str, tuple[str, ...]] = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": (
        "system_default",
        "automatic",
        "manual_by_node",
        "manual_by_topic",
        "unknown",
        "best_available",
    ),
}


class QosTime(NamedTuple):
    """A span of time: `sec` seconds and `nsec` nanoseconds."""

    sec: int
    nsec: int


INFINITE = QosTime(9223372036, 854775807)


@dataclass(frozen=True)
class QosProfile:
    """One publisher's offer; the defaults are what Fast DDS tells about a default publisher.

    Attributes:
        history: A name of `POLICIES["history"]`; `unknown` where discovery does not tell.
        depth: The history's depth in messages; 0 where discovery does not tell.
        reliability: A name of `POLICIES["reliability"]`.
        durability: A name of `POLICIES["durability"]`.
        deadline: The longest time promised between two messages.
        lifespan: The age at which a message is dropped.
        liveliness: A name of `POLICIES["liveliness"]`.
        liveliness_lease_duration: The longest time between two signs of life.
        avoid_ros_namespace_conventions: Whether the DDS topic is named without ROS prefixes.
    """

    history: str = "unknown"
    depth: int = 0
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline: QosTime = INFINITE
    lifespan: QosTime = INFINITE
    liveliness: str = "automatic"
    liveliness_lease_duration: QosTime = INFINITE
    avoid_ros_namespace_conventions: bool = False

    def __post_init__(self) -> None:
        """Refuse what a rosbag2 reader would refuse.

        Raises:
            ValueError: A policy has no such name, or a depth or time is negative.
        """
        for policy, names in POLICIES.items():
            if (name := getattr(self, policy)) not in names:
                raise ValueError(f"{policy} is '{name}', but must be one of {', '.join(names)}")
        times = (*self.deadline, *self.lifespan, *self.liveliness_lease_duration)
        if min(self.depth, *times) < 0:
            raise ValueError(f"depth and times of a QoS profile must not be negative: {self}")

    def to_map(self) -> dict[str, Any]:
        """Return the profile as the map of metadata version 9."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {k: v._asdict() if isinstance(v, QosTime) else v for k, v in values.items()}

    @classmethod
    def from_map(cls, values: Mapping[str, Any]) -> "QosProfile":
        """Return the profile a map describes, with policies by name or by number.

        Raises:
            ValueError: A key is missing, or a value is not one.
        """
        try:
            known = {field.name: values[field.name] for field in fields(cls)}
            for policy, names in POLICIES.items():
                if isinstance(known[policy], int):
                    known[policy] = names[whole_number(values, policy)]
            known["depth"] = whole_number(values, "depth")
            for name in ("deadline", "lifespan", "liveliness_lease_duration"):
                time = values[name]
                known[name] = QosTime(whole_number(time, "sec"), whole_number(time, "nsec"))
            if not isinstance(known["avoid_ros_namespace_conventions"], bool):
                raise TypeError("avoid_ros_namespace_conventions is neither true nor false")
            return cls(**known)
        except (KeyError, IndexError, TypeError) as error:
            raise ValueError(f"not a QoS profile ({error!r}): {values}") from error


def profiles_to_yaml(profiles: Iterable[QosProfile]) -> str:
    """Return the offers as the YAML list that is a channel's `offered_qos_profiles`."""
    maps = [profile.to_map() for profile in profiles]
    return str(yaml.safe_dump(maps, sort_keys=False)).rstrip("\n")


def profiles_from_yaml(text: str) -> tuple[QosProfile, ...]:
    """Return the offers a channel's `offered_qos_profiles` lists; none for an empty text.

    Raises:
        ValueError: The text is not a YAML list of QoS profiles.
    """
    try:
        maps = load_yaml(text) or []
    except ValueError as error:
        raise ValueError(f"not a list of QoS profiles: {error}") from error
    if not isinstance(maps, list):
        raise ValueError(f"not a list of QoS profiles: {text}")
    return tuple(QosProfile.from_map(values) for values in maps)
