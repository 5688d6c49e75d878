# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Playing a bag, without a clock or ROS: what is read ahead, and when it is due."""

from tsobs_ros.bag.playback.schedule import Event, Playback
from tsobs_ros.bag.playback.source import BagSource

__all__ = ["BagSource", "Event", "Playback"]
