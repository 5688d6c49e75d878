# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""diagnostic_msgs/DiagnosticArray from the bytes on the wire, without ROS."""

import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

from tsobs_ros.bag.cdr import CdrReader
from tsobs_ros.errors import MessageError
from tsobs_ros.series import NANOSECONDS

DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


class RecordedStatus(NamedTuple):
    """A status of a recorded array.

    Attributes:
        stamp: Of the array's header, ns since the epoch.
        level: 0 OK, 1 WARN, 2 ERROR, 3 STALE.
        name: Parts of its name, such as the node and the concern.
        hardware: Its hardware, such as a joint.
        values: By their keys.
    """

    stamp: int
    level: int
    name: tuple[str, ...]
    hardware: str
    values: dict[str, str]


def read_statuses(data: bytes) -> Iterator[RecordedStatus]:
    """Yield the statuses of a message in CDR bytes, up to where it is malformed.

    Any node publishes on /diagnostics, so a malformed message is no error.
    """
    with suppress(MessageError):
        reader = CdrReader(data)
        at = reader.place
        reader.skip(8, "stamp")
        seconds, nanoseconds = struct.unpack_from(f"{reader.order}iI", data, at)
        stamp = seconds * NANOSECONDS + nanoseconds
        reader.text("frame_id")
        for _ in range(reader.count("status", 1)):
            at = reader.place
            reader.skip(1, "level")
            name, _, hardware = (reader.text(field) for field in ("name", "message", "hardware_id"))
            values = {}
            for _ in range(reader.count("values", 8)):
                key = reader.text("key")
                values[key] = reader.text("value")
            yield RecordedStatus(stamp, data[at], tuple(name.split(": ")), hardware, values)
