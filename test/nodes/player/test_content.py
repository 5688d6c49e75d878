# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is played is what was recorded: all of it, to the byte, in order, whatever kind of bag."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from player.bags import LATCHED, MS, START, STRING, Entry, data_of, regular, texts, write_bag
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from staging import start

from tsobs_ros.bag import BagReader, BagWriter, QosProfile
from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.errors import BagReadError, ParameterError
from tsobs_ros.nodes.player import offered_qos
from tsobs_ros.resources import config_path

Play = Callable[..., Any]


def test_a_split_bag_is_played_in_order_of_log_time(
    play: Play, listener: Any, tmp_path: Path
) -> None:
    entries = [*regular(20), Entry("/b", 55, "b0"), Entry("/b", 155, "b1"), Entry("/b", 155, "b2")]
    entries.sort(key=lambda entry: entry.at)
    bag = write_bag(tmp_path / "bag", entries, max_duration_ns=45 * MS)
    assert len(list(bag.glob("*.mcap"))) == 4
    listener.listen("/a", "/b")
    listener.hear_out(play(bag, wait_for_subscribers=2))

    heard = [said for _, said in sorted(zip(listener.sent, listener.heard, strict=True))]
    assert heard == [(entry.topic, entry.text) for entry in entries]


def test_what_was_recorded_played_and_recorded_again_is_the_same(
    ros: Any, play: Play, tmp_path: Path
) -> None:
    offers = {"/latched": [LATCHED], "/best_effort": [QosProfile(reliability="best_effort")]}
    entries = [
        Entry("/latched", 0, "the map"),
        *regular(100, 1.0, "/a"),
        *regular(50, 2.0, "/best_effort"),
        Entry("/a", 50.5, ""),
        Entry("/a", 60.5, "Größe θ̂ ≤ 1 😀" * 1000),
    ]
    first = BagReader(write_bag(tmp_path / "first", entries, offers))
    recorder = start(ros, "recorder", output=str(tmp_path / "second"), topics=list(first.topics))
    player = play(first.path, wait_for_subscribers=3)
    ros.spin_until(lambda: player.finished, what="the end")
    ros.spin_until(lambda: recorder.messages >= first.message_count, what="the recording")
    recorder.close()

    second = BagReader(tmp_path / "second")
    for topic, info in first.topics.items():
        assert [m.data for m in second.messages([topic])] == [
            m.data for m in first.messages([topic])
        ]
        assert second.topics[topic].qos_profiles == info.qos_profiles
        assert second.topics[topic].type_hash == info.type_hash


@pytest.mark.parametrize(
    ("parameters", "played"),
    [
        ({"topics": ["/a", "b"]}, {"/a", "/b"}),
        ({"exclude_regex": "b", "clock": 10.0}, {"/a", "/clock"}),
    ],
)
def test_topics_are_selected(
    play: Play, tmp_path: Path, parameters: dict[str, Any], played: set[str]
) -> None:
    names = ("/a", "/ab", "/b", "/clock")
    bag = write_bag(tmp_path / "bag", [Entry(name, 0, "") for name in names])
    player = play(bag, start_paused=True, **parameters)
    assert {p.topic_name for p in player.publishers if p.topic_name in names} == played


def test_what_cannot_be_published_is_left_out_with_a_warning_that_commands_no_terminal(
    play: Play, listener: Any, tmp_path: Path, capfd: Any,
    hostile: str, check_shown: Callable[[str], None],
) -> None:  # fmt: skip
    changed = find_definition(STRING)._replace(type_hash="RIHS01_" + "0" * 64)
    strange = {
        "/package": MessageDefinition("no_such_msgs/msg/Thing", "int32 x\n", ""),
        "/name": MessageDefinition("std_msgs/msg/Nothing", "int32 x\n", ""),
        "/changed": changed,
        "/service": MessageDefinition("std_srvs/srv/Trigger", "", ""),
        f"/{hostile}": MessageDefinition(STRING, "", ""),
        "/type": MessageDefinition(f"std_msgs/msg/{hostile}", hostile, ""),
        "/hash": MessageDefinition(STRING, "", hostile),
    }
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/a", STRING)
        for k in range(3):
            writer.write("/a", data_of(f"a{k}"), START + k, START)
        for topic, definition in strange.items():
            writer.add_topic(topic, definition.type, definition=definition)
            writer.write(topic, b"\0\1\0\0\0\0\0\0", START, START)
    listener.listen("/a")
    listener.hear_out(play(tmp_path / "bag"))

    assert listener.texts() == texts(0, 3)
    printed = capfd.readouterr().err
    check_shown(printed)
    assert printed.count("not playing") == len(strange)
    for topic, reason in (
        ("/package", "no_such_msgs/msg/Thing is not installed"),
        ("/name", "the Python module of std_msgs"),
        ("/changed", "another definition of std_msgs/msg/String"),
    ):
        (line,) = [each for each in printed.splitlines() if f"not playing {topic}: " in each]
        assert reason in line


def test_messages_that_do_not_fit_their_type_are_left_out(
    ros: Any, play: Play, listener: Any, tmp_path: Path, capfd: Any
) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for topic, kind in (("/a", STRING), ("/number", "std_msgs/msg/Int32")):
            writer.add_topic(topic, kind, [QosProfile()])
        for k, data in enumerate([data_of("a0"), b"", b"\0\1", data_of("a1")]):
            writer.write("/a", data, START + k, START)
        for k, size in enumerate([4, 104, 104, 4]):
            writer.write("/number", b"\0\1\0\0" + bytes(size), START + k, START)
    listener.listen("/a")
    player = play(tmp_path / "bag")
    ros.spin_until(lambda: player.finished and len(listener.heard) == 2, what="the end")

    assert listener.texts() == texts(0, 2)
    assert player.messages == 4
    printed = capfd.readouterr().err
    assert printed.count("leaving out messages of ") == 2
    assert "leaving out messages of /a that do not fit std_msgs/msg/String: expected" in printed


BEST_EFFORT = QosProfile(reliability="best_effort")
LATE = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RELIABLE = ("reliable", "volatile", 1000)


@pytest.mark.parametrize(
    ("profiles", "expected"),
    [
        ([], RELIABLE),
        ([BEST_EFFORT, QosProfile()], RELIABLE),
        # Each of them may have latched as many as a default publisher keeps.
        ([LATCHED] * 3, ("reliable", "transient_local", 30)),
        ([replace(LATCHED, history="keep_last", depth=d) for d in (1, 4)],
         ("reliable", "transient_local", 5)),
        ([replace(LATCHED, history="keep_all")], ("reliable", "transient_local", 1000)),
        ([QosProfile(reliability="system_default")], RELIABLE),
    ],
)  # fmt: skip
def test_what_all_publishers_offered_is_offered(
    profiles: list[QosProfile], expected: tuple[str, str, int]
) -> None:
    qos = offered_qos(tuple(profiles))
    assert qos.history.name == "KEEP_LAST"
    assert (qos.reliability.name.lower(), qos.durability.name.lower(), qos.depth) == expected


def test_what_was_latched_before_the_start_is_published_first_even_in_a_pause(
    ros: Any, play: Play, listener: Any, call: Any, tmp_path: Path
) -> None:
    entries = [*regular(10), *(Entry("/latched", at, f"l{at}") for at in (0, 20, 60))]
    offers = {"/latched": [replace(LATCHED, history="keep_last", depth=1)]}
    bag = write_bag(tmp_path / "bag", entries, offers)
    player = play(bag, start_paused=True, start_offset=0.05)
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


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"bag": ""}, "parameter 'bag' must name a bag folder or an .mcap file"),
        ({"rate": 0.001}, "parameter 'rate': expected a finite number of at least 0.01"),
        ({"topics": ["/c"]}, "parameter 'topics': no topic /c; the bag has /a, /b"),
        ({"exclude_regex": "."}, "the parameters leave no topic to play; the bag has /a, /b"),
        ({"start_offset": 0.05}, "'start_offset' must be at most 0.04 s, the bag's length"),
    ],
)
def test_senseless_parameters_are_refused(
    play: Play, tmp_path: Path, parameters: dict[str, Any], reason: str
) -> None:
    bag = write_bag(tmp_path / "bag", [*regular(5), Entry("/b", 7, "b")])

    with pytest.raises(ParameterError, match=reason):
        play(bag, **parameters)


def test_a_bag_without_an_end_is_refused_with_the_shipped_parameters(
    play: Play, tmp_path: Path
) -> None:
    file = write_bag(tmp_path / "bag", regular(5)) / "bag_0.mcap"
    file.write_bytes(file.read_bytes()[:-100])
    shipped = ["--ros-args", "--params-file", str(config_path("player.yaml"))]
    with pytest.raises(BagReadError, match=r"bag_0.mcap: the file has no end"):
        play(tmp_path / "bag", options={"cli_args": shipped})
