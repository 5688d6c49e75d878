# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags: recording to, and reading from, the MCAP bags of ROS 2 Jazzy; no ROS import needed.

Names are imported when they are first used: the observer encodes messages without the libraries
that files take.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tsobs_ros.bag.metadata import QosProfile as QosProfile
    from tsobs_ros.bag.reader import BagReader as BagReader
    from tsobs_ros.bag.writer import BagWriter as BagWriter

_HOMES = {"BagReader": "reader", "BagWriter": "writer", "QosProfile": "metadata"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
