# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `player` node: a bag onto its topics again, at the times it was recorded."""

from tsobs_ros.nodes.player.node import Player, create

__all__ = ["Player", "create"]
