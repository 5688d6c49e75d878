# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags: recording to, and reading from, the MCAP bags of ROS 2 Jazzy; no ROS import needed."""

from tsobs_ros.bag.metadata import QosProfile, TopicInfo
from tsobs_ros.bag.reader import BagMessage, BagReader, DecodedMessage
from tsobs_ros.bag.writer import BagWriter

__all__ = [
    "BagMessage",
    "BagReader",
    "BagWriter",
    "DecodedMessage",
    "QosProfile",
    "TopicInfo",
]
