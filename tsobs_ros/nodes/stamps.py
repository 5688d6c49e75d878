# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamps as integer nanoseconds, so that no arithmetic ever rounds them."""

from typing import Any

from builtin_interfaces.msg import Time

from tsobs_ros.estimation.records import NANOSECONDS


def to_nanoseconds(stamp: Any) -> int:
    """Return a builtin_interfaces Time (or Duration) as nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def set_stamp(stamp: Any, nanoseconds: int) -> None:
    """Write nanoseconds since the epoch into a builtin_interfaces Time in place."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, NANOSECONDS)


def to_stamp(nanoseconds: int) -> Any:
    """Return nanoseconds since the epoch as a new builtin_interfaces Time."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return Time(sec=seconds, nanosec=rest)
