# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `player` node: a bag onto its topics again, at the times it was recorded.

topics:
  those of the bag that its parameters select (out), else all
  /clock (out)        rosgraph_msgs/msg/Clock: the time of the bag, with `clock`
  /diagnostics (out)  diagnostic_msgs/msg/DiagnosticArray: position and counts, once a second

services, std_srvs/srv/Trigger:
  ~/pause             stop there
  ~/resume            go on
  ~/toggle_paused     either of them
  ~/is_paused         `success` is whether it is paused
  ~/play_next         publish one message in a pause
"""

from tsobs_ros.nodes.player.node import Player
from tsobs_ros.nodes.player.parameters import PlayerParameters as Parameters

create = Player

__all__ = ["Parameters", "Player", "create"]
