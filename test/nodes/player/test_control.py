# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pausing, stepping, seeking, looping and changing the rate while a bag is played."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from player.bags import regular, texts, write_bag
from rclpy.parameter import Parameter

Play = Callable[..., Any]
S = 10**9


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
    player = play(bag)
    answer = call("play_next")
    assert not answer.success
    assert answer.message.startswith("only a paused player steps; it is ")
    listener.listen("/a")
    ros.spin_until(lambda: len(listener.heard) >= 3, what="the first messages")

    assert call("pause").success
    assert call("is_paused").success
    position, heard = player.position, player.messages
    assert call("is_paused").message == f"paused at {position:.3f} s"
    assert call("pause").success  # once more changes nothing
    assert (player.position, player.messages) == (position, heard)

    assert call("toggle_paused").message.startswith("playing at")
    assert not call("is_paused").success
    assert call("toggle_paused").message.startswith("paused at")
    assert call("resume").success
    listener.hear_out(player)
    assert listener.texts() == texts(0, 100)


def test_steps_publish_one_message_each(
    ros: Any, play: Play, listener: Any, call: Any, tmp_path: Path
) -> None:
    listener.listen("/a").listen_to_clock()
    player = play(write_bag(tmp_path / "short", regular(3)), start_paused=True, clock=100.0)
    ros.spin_until(lambda: len(listener.clock) >= 3, what="the clock")
    assert set(listener.clock) == {0.0}
    for number in range(3):
        answer = call("play_next")
        assert answer.success
        assert answer.message == f"/a at {0.01 * number:.3f} s"
        ros.spin_until(lambda n=number: len(listener.heard) == n + 1, what="a message")

    answer = call("play_next")
    assert (answer.success, answer.message) == (False, "the bag has ended")
    assert not player.finished
    ros.spin_until(lambda: 20.0 in listener.clock, what="the clock at the last message")
    assert list(dict.fromkeys(listener.clock)) == [0.0, 10.0, 20.0]
    call("resume")
    listener.hear_out(player)
    assert listener.texts() == texts(0, 3)


def test_setting_the_position_goes_there_however_often(
    ros: Any, play: Play, listener: Any, bag: Path
) -> None:
    listener.listen("/a")
    player = play(bag, start_paused=True)
    for position, first in ((0.9, 90), (0.2, 20), (0.2, 20), (0.985, 99)):
        set_parameter(player, "position", position)
        assert player.position == pytest.approx(position)
        player.step()
        ros.spin_until(lambda n=first: listener.texts()[-1:] == [f"a{n}"], what="the message there")
    for name, value, reason in (
        ("position", 1.0, "parameter 'position' must be at most 0.99 s, the bag's length"),
        ("position", "there", "DOUBLE"),
        ("rate", 0.0, "out of range"),
    ):
        (result,) = player.set_parameters([Parameter(name, value=value)])
        assert not result.successful
        assert reason in result.reason
    assert player.position == pytest.approx(0.99)


def test_seeking_and_another_rate_while_playing_go_on_playing_from_there(
    ros: Any, play: Play, listener: Any, bag: Path
) -> None:
    listener.listen("/a")
    player = play(bag, position=0.5, rate=0.01)
    ros.spin_until(lambda: player.position > 0.5005, what="some of the bag")
    assert player.position < 0.9
    set_parameter(player, "rate", 1)
    ros.spin_until(lambda: len(listener.heard) >= 3, what="the first messages")
    set_parameter(player, "position", 0.9)
    listener.hear_out(player)
    numbers = [int(text[1:]) for text in listener.texts()]
    assert numbers[0] == 50
    assert numbers == [*range(50, numbers[-11] + 1), *range(90, 100)]

    set_parameter(player, "position", 0.95)
    assert not player.finished
    listener.hear_out(player)
    assert listener.texts()[-5:] == texts(95, 100)


def test_in_a_loop_the_clock_jumps_back_to_the_start(
    ros: Any, play: Play, listener: Any, call: Any, bag: Path
) -> None:
    listener.listen("/a").listen_to_clock()
    part = {"start_offset": 0.9, "duration": 0.05, "loop": True}
    player = play(bag, **part, clock=200.0, rate=0.5, start_paused=True)
    # Only a subscription of /clock that is matched hears every pass of it.
    ros.spin_until(lambda: bool(listener.clock), what="the clock in the pause")
    call("resume")
    ros.spin_until(lambda: len(listener.heard) >= 15, what="two passes and a half")
    assert not player.finished
    set_parameter(player, "loop", False)
    listener.hear_out(player)
    passed = len(listener.heard) // 6
    assert passed >= 3
    assert listener.texts() == texts(90, 96) * passed

    def jumps() -> list[tuple[float, float]]:
        return [(first, second) for first, second in pairwise(listener.clock) if second < first]

    ros.spin_until(
        lambda: len(jumps()) == passed - 1 and listener.clock[-1] == 950.0, what="the last pass"
    )
    assert all(second == 900.0 for _, second in jumps())
    assert listener.clock[0] == 900.0
    assert max(listener.clock) <= 950.0
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
