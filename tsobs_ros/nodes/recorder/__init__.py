# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `recorder` node: topics into an MCAP bag, and an account of what was missed."""

from tsobs_ros.nodes.recorder.node import Recorder, create

__all__ = ["Recorder", "create"]
