# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics are offered as they were recorded, and nothing latched is missed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from player.bags import LATCHED, Entry, regular, texts, write_bag
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from tsobs_ros.bag.metadata import INFINITE, QosProfile, QosTime
from tsobs_ros.nodes.player.topics import offered_qos

Play = Callable[..., Any]
BEST_EFFORT = QosProfile(reliability="best_effort")
LATE = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


RELIABLE = ("reliable", "volatile", 1000)


@pytest.mark.parametrize(
    ("profiles", "expected"),
    [
        ([], RELIABLE),
        ([QosProfile()], RELIABLE),
        ([BEST_EFFORT, BEST_EFFORT], ("best_effort", "volatile", 1000)),
        ([BEST_EFFORT, QosProfile()], RELIABLE),
        ([LATCHED, QosProfile()], RELIABLE),
        # Each of them may have latched as many as a default publisher keeps.
        ([LATCHED], ("reliable", "transient_local", 10)),
        ([LATCHED] * 3, ("reliable", "transient_local", 30)),
        ([replace(LATCHED, history="keep_last", depth=d) for d in (1, 4)],
         ("reliable", "transient_local", 5)),
        ([replace(LATCHED, history="keep_all")], ("reliable", "transient_local", 1000)),
        ([QosProfile(history="keep_last", depth=1)], RELIABLE),
        ([QosProfile(reliability="best_available", durability="unknown")], RELIABLE),
        ([QosProfile(reliability="system_default", liveliness="manual_by_node")], RELIABLE),
    ],
)  # fmt: skip
def test_what_all_publishers_offered_is_offered(
    profiles: list[QosProfile], expected: tuple[str, str, int]
) -> None:
    qos = offered_qos(tuple(profiles), 1000)
    assert qos.history.name == "KEEP_LAST"
    assert (qos.reliability.name.lower(), qos.durability.name.lower(), qos.depth) == expected


def test_times_of_a_profile_are_kept(ros: Any, play: Play, tmp_path: Path) -> None:
    profile = QosProfile(
        deadline=QosTime(3, 500_000_000), lifespan=QosTime(60, 0), liveliness="manual_by_topic",
        liveliness_lease_duration=QosTime(7, 0), reliability="best_effort",
    )  # fmt: skip
    endless = QosProfile(deadline=INFINITE, lifespan=QosTime(2**62, 0))
    offers = {"/a": [profile], "/b": [endless]}
    bag = write_bag(tmp_path / "bag", [Entry("/a", 0, ""), Entry("/b", 0, "")], offers)
    node = ros.node("other")
    play(bag, start_paused=True)
    ros.spin_until(lambda: node.count_publishers("/b") > 0, what="discovery")

    (found,) = [info.qos_profile for info in node.get_publishers_info_by_topic("/a")]
    assert found.deadline.nanoseconds == 3_500_000_000
    assert found.lifespan.nanoseconds == 60 * 10**9
    assert found.liveliness_lease_duration.nanoseconds == 7 * 10**9
    assert (found.liveliness.name, found.reliability.name) == ("MANUAL_BY_TOPIC", "BEST_EFFORT")
    (other,) = [info.qos_profile for info in node.get_publishers_info_by_topic("/b")]
    assert other.deadline.nanoseconds == other.lifespan.nanoseconds == 2**63 - 1


@pytest.fixture
def latched_bag(tmp_path: Path) -> Path:
    """Give a bag with 3 messages latched at 0, 20 and 60 ms, and a0 … a9, one every 10 ms."""
    entries = [Entry("/latched", at, f"l{at}") for at in (0, 20, 60)]
    offers = {
        "/latched": [QosProfile(history="keep_last", depth=1, durability="transient_local")],
    }
    return write_bag(tmp_path / "bag", [*entries, *regular(10)], offers)


def test_what_was_latched_before_the_start_is_published_first_even_in_a_pause(
    ros: Any, play: Play, listener: Any, latched_bag: Path
) -> None:
    player = play(latched_bag, start_paused=True, start_offset=0.05)
    ros.spin_until(lambda: player.messages == 1, what="the latched message's publication")
    listener.listen("/latched", qos=LATE)  # late subscribers get what is latched, too
    ros.spin_until(lambda: listener.texts("/latched") == ["l20"], what="the latched message")

    listener.listen("/a")
    player.resume()
    listener.hear_out(player)
    assert listener.texts("/latched") == ["l20", "l60"]
    assert listener.texts("/a") == texts(5, 10)


def test_what_was_latched_before_a_seek_is_published_at_once_even_in_a_pause(
    ros: Any, play: Play, listener: Any, latched_bag: Path
) -> None:
    listener.listen("/latched", "/a")
    player = play(latched_bag, start_paused=True, start_offset=0.065)
    ros.spin_until(lambda: listener.texts("/latched") == ["l60"], what="the latest")

    (result,) = player.set_parameters([Parameter("position", value=0.03)])
    # Before the start offset: playing stays within what it was asked for.
    assert result.successful
    assert player.position == pytest.approx(0.065)
    assert player.step() == (True, "/a at 0.070 s")  # first what is latched, then the step
    ros.spin_until(lambda: listener.texts("/a") == ["a7"], what="the step")
    ros.spin_until(lambda: listener.texts("/latched") == ["l60"] * 2, what="the latest again")


@pytest.mark.parametrize("reliability", ["reliable", "best_effort"])
def test_the_first_messages_are_not_lost_to_a_subscriber_that_is_just_being_discovered(
    ros: Any, play: Play, listener: Any, tmp_path: Path, reliability: str
) -> None:
    offers = {"/a": [QosProfile(reliability=reliability)]}
    bag = write_bag(tmp_path / "bag", regular(50, 0.5), offers)
    player = play(bag)
    qos = QoSProfile(depth=100, reliability=ReliabilityPolicy[reliability.upper()])
    listener.listen("/a", qos=qos)

    listener.hear_out(player)
    assert listener.texts() == texts(0, 50)
