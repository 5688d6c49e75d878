# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""MCAP bags of ROS 2 Jazzy: writers and readers that need no ROS import.

Each name is imported on first use, so that the observer can encode messages without the libraries
that bag files need.
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
