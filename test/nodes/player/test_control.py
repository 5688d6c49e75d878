# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pausing, looping and changing the rate while a bag is played."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from player.bags import regular, texts, write_bag
from rclpy.parameter import Parameter

Play = Callable[..., Any]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Give a bag of 100 messages on /a, one every 10 ms."""
    return write_bag(tmp_path / "bag", regular(100))


def set_parameter(player: Any, name: str, value: Any) -> None:
    (result,) = player.set_parameters([Parameter(name, value=value)])
    assert result.successful, result.reason


def test_a_pause_lasts_until_it_is_over_and_nothing_is_left_out(
    ros: Any, play: Play, listener: Any, call: Any, bag: Path
) -> None:
    player = play(bag, rate=0.01)
    listener.listen("/a")
    ros.spin_until(lambda: len(listener.heard) >= 1, what="the first message")

    answer, position = call("pause"), player.position
    assert (answer.success, answer.message) == (True, f"paused at {position:.3f} s")
    assert call("pause").success  # once more changes nothing
    assert player.position == position

    set_parameter(player, "rate", 1)
    (refused,) = player.set_parameters([Parameter("rate", value=0.0)])
    assert "out of range" in refused.reason
    assert call("resume").message.startswith("playing at")
    listener.hear_out(player)
    assert listener.texts() == texts(0, 100)


def test_in_a_loop_the_clock_jumps_back_to_the_start(
    ros: Any, play: Play, listener: Any, call: Any, bag: Path
) -> None:
    listener.listen("/a")
    listener.listen_to_clock()
    player = play(bag, start_offset=0.94, loop=True, clock=200.0, rate=0.5, start_paused=True)
    # Only a subscription of /clock that is matched hears every pass of it.
    ros.spin_until(lambda: bool(listener.clock), what="the clock in the pause")
    call("resume")
    ros.spin_until(lambda: len(listener.heard) >= 15, what="two passes and a half")
    assert not player.finished
    set_parameter(player, "loop", False)
    listener.hear_out(player)
    passed = len(listener.heard) // 6
    assert passed >= 3
    assert listener.texts() == texts(94, 100) * passed

    def jumps() -> list[tuple[float, float]]:
        return [(first, second) for first, second in pairwise(listener.clock) if second < first]

    ros.spin_until(
        lambda: len(jumps()) == passed - 1 and listener.clock[-1] == 990.0, what="the last pass"
    )
    assert all(second == 940.0 for _, second in jumps())
    assert listener.clock[0] == 940.0
    assert max(listener.clock) <= 990.0
    # 200 Hz of real time at half the rate.
    steps = {round(b - a, 3) for a, b in pairwise(listener.clock) if b > a}
    assert 2.5 in steps


def test_deactivating_stands_still_and_configuring_starts_again(
    ros: Any, play: Play, listener: Any, manage: Any, bag: Path
) -> None:
    listener.listen("/a")
    player = play(bag, autostart=False)
    manager = manage(player)
    for _ in range(2):
        assert manager.change("configure", "activate")
        ros.spin_until(lambda: player.messages >= 3, what="some messages")
        assert manager.change("deactivate")
        stopped, position = player.messages, player.position
        assert manager.change("activate")
        assert player.position >= position
        ros.spin_until(lambda n=stopped: player.messages > n, what="more messages")
        assert manager.change("deactivate")
        total = player.messages
        assert manager.change("cleanup")
        ros.spin_until(lambda n=total: len(listener.heard) >= n, what="all messages")
        assert listener.texts() == texts(0, total)
        listener.heard.clear()


def test_without_subscribers_it_plays_after_a_while_whatever_the_simulated_time(
    ros: Any, play: Play, tmp_path: Path, capfd: Any
) -> None:
    bag = write_bag(tmp_path / "short", regular(3))
    player = play(bag, wait_timeout=0.1, use_sim_time=True)
    ros.spin_until(lambda: player.finished, what="the end")

    assert player.messages == 3
    log = capfd.readouterr().err
    assert log.count("playing to 0 of 1 subscriptions") == 1
    assert "use_sim_time does not matter" in log
