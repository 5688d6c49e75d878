# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics are offered as they were recorded, and nothing latched is missed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from player.bags import LATCHED, Entry, regular, texts, write_bag
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from tsobs_ros.bag.metadata import QosProfile
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


@pytest.fixture
def latched_bag(tmp_path: Path) -> Path:
    """Give a bag with 3 messages latched at 0, 20 and 60 ms, and a0 … a9, one every 10 ms."""
    entries = [Entry("/latched", at, f"l{at}") for at in (0, 20, 60)]
    offers = {
        "/latched": [QosProfile(history="keep_last", depth=1, durability="transient_local")],
    }
    return write_bag(tmp_path / "bag", [*entries, *regular(10)], offers)


def test_what_was_latched_before_the_start_is_published_first_even_in_a_pause(
    ros: Any, play: Play, listener: Any, call: Any, latched_bag: Path
) -> None:
    player = play(latched_bag, start_paused=True, start_offset=0.05)
    ros.spin_until(lambda: player.messages == 1, what="the latched message's publication")
    listener.listen("/latched", qos=LATE)  # late subscribers get what is latched, too
    ros.spin_until(lambda: listener.texts("/latched") == ["l20"], what="the latched message")

    listener.listen("/a")
    call("resume")
    listener.hear_out(player)
    assert listener.texts("/latched") == ["l20", "l60"]
    assert listener.texts("/a") == texts(5, 10)


def test_the_first_messages_are_not_lost_to_a_subscriber_that_is_just_being_discovered(
    play: Play, listener: Any, tmp_path: Path
) -> None:
    bag = write_bag(tmp_path / "bag", regular(50, 0.5), {"/a": [BEST_EFFORT]})
    player = play(bag)
    qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    listener.listen("/a", qos=qos)

    listener.hear_out(player)
    assert listener.texts() == texts(0, 50)
