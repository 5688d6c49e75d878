# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a bag tells about one of its topics."""

from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Schema

from tsobs_ros.bag.qos import QosProfile, profiles_from_yaml
from tsobs_ros.errors import BagReadError


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a bag.

    Attributes:
        name: The full topic name.
        type: The message type, `package/msg/Type`.
        count: How many messages of it the bag holds.
        qos_profiles: What its publishers offered when it was registered.
        type_hash: The RIHS01 hash of its type, or an empty string.
        definition: The text that defines its type.
        definition_encoding: The language of that text: `ros2msg` in most bags.
    """

    name: str
    type: str
    count: int
    qos_profiles: tuple[QosProfile, ...]
    type_hash: str
    definition: str
    definition_encoding: str


def describe_topic(file: Path, channel: Channel, schema: Schema | None, count: int) -> TopicInfo:
    """Return the description of a channel of a file.

    Args:
        file: The file.
        channel: The channel.
        schema: Its schema; None if the file does not have it.
        count: How many messages of it the file holds.

    Raises:
        BagReadError: It is not encoded in CDR, has no type, or its QoS is malformed.
    """
    if channel.message_encoding != "cdr":
        raise BagReadError(
            f"{file}: {channel.topic} is encoded in '{channel.message_encoding}', not in cdr"
        )
    if schema is None:
        raise BagReadError(f"{file}: {channel.topic} has no type")
    try:
        qos_profiles = profiles_from_yaml(channel.metadata.get("offered_qos_profiles", ""))
    except ValueError as error:
        raise BagReadError(f"{file}: {channel.topic}: {error}") from error
    return TopicInfo(
        name=channel.topic,
        type=schema.name,
        count=count,
        qos_profiles=qos_profiles,
        type_hash=channel.metadata.get("topic_type_hash", ""),
        definition=schema.data.decode(errors="replace"),
        definition_encoding=schema.encoding,
    )
