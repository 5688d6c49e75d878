# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `recorder` node: topics into an MCAP bag, and an account of what was missed.

topics:
  those that its parameters select (in), else all
  /diagnostics (out)  diagnostic_msgs/msg/DiagnosticArray: counts and losses, once a second

services, std_srvs/srv/Trigger:
  ~/pause             discard what arrives
  ~/resume            go on
  ~/toggle_paused     either of them
  ~/is_paused         `success` is whether it is paused
  ~/split_bagfile     go on in another file
  ~/snapshot          write the last seconds; with `snapshot_mode`
"""

from tsobs_ros.nodes.recorder.node import Recorder
from tsobs_ros.nodes.recorder.parameters import RecorderParameters as Parameters

create = Recorder

__all__ = ["Parameters", "Recorder", "create"]
