# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamps of messages as integers."""

from typing import Any

from rclpy.time import Time


def to_nanoseconds(stamp: Any) -> int:
    """Return a builtin_interfaces Time as nanoseconds."""
    return int(Time.from_msg(stamp).nanoseconds)


def to_stamp(nanoseconds: int) -> Any:
    """Return nanoseconds since the epoch as a builtin_interfaces Time."""
    return Time(nanoseconds=nanoseconds).to_msg()
