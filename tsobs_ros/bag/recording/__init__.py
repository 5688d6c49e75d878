# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recording a bag, without ROS: snapshots, latched messages, losses, safety on the disk."""

from tsobs_ros.bag.recording.bag import Recording, RecordingOptions
from tsobs_ros.bag.recording.losses import LossCounter
from tsobs_ros.bag.recording.snapshot import BufferedMessage

__all__ = ["BufferedMessage", "LossCounter", "Recording", "RecordingOptions"]
