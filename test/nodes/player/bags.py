# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags of Strings to play."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.serialization import serialize_message
from std_msgs.msg import String

from tsobs_ros.bag import BagWriter, QosProfile

MS = 1_000_000
START = 1_700_000_000 * 1000 * MS
STRING = "std_msgs/msg/String"
LATCHED = QosProfile(durability="transient_local")


class Entry(NamedTuple):
    """A String on a topic, so many ms after the start."""

    topic: str
    at: float
    text: str


def data_of(text: str) -> bytes:
    return bytes(serialize_message(String(data=text)))


def regular(count: int, period: float = 10.0, topic: str = "/a") -> list[Entry]:
    """Return a0, a1, … on /a, one every `period` ms."""
    return [Entry(topic, period * k, f"{topic[1:]}{k}") for k in range(count)]


def texts(first: int, last: int, name: str = "a") -> list[str]:
    """Return what `regular` says from one to before the other."""
    return [f"{name}{k}" for k in range(first, last)]


def write_bag(
    path: Path,
    entries: Sequence[Entry],
    qos: Mapping[str, Sequence[QosProfile]] | None = None,
    **options: Any,
) -> Path:
    """Write a bag; topics offer a default publisher's QoS unless told otherwise."""
    with BagWriter(path, **options) as writer:
        for entry in sorted(entries, key=lambda entry: entry.at):
            writer.add_topic(entry.topic, STRING, (qos or {}).get(entry.topic, [QosProfile()]))
            time = START + round(entry.at * MS)
            writer.write(entry.topic, data_of(entry.text), time, time)
    return path
