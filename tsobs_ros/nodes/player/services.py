# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The player's services: those of rosbag2's player by name, with types that pip installs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tsobs_ros.nodes.player import Player


def offer_services(player: Player) -> None:
    """Let others pause, resume and step; every answer says what came of it.

    Args:
        player: The player, being configured.
    """

    def state() -> str:
        return f"{player.doing} at {player.position:.3f} s"

    def pause() -> tuple[bool, str]:
        player.pause()
        return True, state()

    def resume() -> tuple[bool, str]:
        player.resume()
        return True, state()

    def toggle_paused() -> tuple[bool, str]:
        return resume() if player.paused else pause()

    def is_paused() -> tuple[bool, str]:
        return player.paused, state()

    answers = {
        "pause": pause,
        "resume": resume,
        "toggle_paused": toggle_paused,
        "is_paused": is_paused,
        "play_next": player.step,
    }
    player.offer_triggers(answers)
