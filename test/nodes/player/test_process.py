# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The player as a process ends with the bag, with a signal, or with one line on what is wrong."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from player.bags import regular, texts, write_bag
from std_srvs.srv import Trigger

from tsobs_ros.bag import BagReader
from tsobs_ros.errors import BagReadError
from tsobs_ros.resources import config_path

Process = Callable[..., Any]


def test_it_ends_with_the_bag_and_follows_remappings(
    ros: Any, ros_process: Process, listener: Any, tmp_path: Path
) -> None:
    # The shipped parameters are the player's whatever its name.
    bag = write_bag(tmp_path / "bag", [*regular(50, 1.0), *regular(50, 1.0, "/b")])
    listener.listen("/new", "/b")
    listener.listen_to_clock()
    waiting = {"wait_for_subscribers": 2, "wait_timeout": 0.0, "start_paused": True}
    process = ros_process(
        "player",
        params_file=config_path("player.yaml"),
        parameters={"bag": str(bag), "clock": 100.0, **waiting},
        remap={"/a": "/new", "__node": "tape"},
    )
    # A subscription that the player knows may not know the player yet, and gets only what is kept:
    # of /clock ten stamps. So time stands still until it is heard. The answer does not matter.
    resume = listener.node.create_client(Trigger, "/tape/resume")
    ros.spin_until(lambda: listener.clock and resume.service_is_ready(), 30.0, "the pause")
    resume.call_async(Trigger.Request())
    ros.spin_until(lambda: len(listener.heard) >= 100, 30.0, "all messages")
    finished = process.finish()

    assert finished.exit_code == 0, finished.stderr
    assert "Traceback" not in finished.stderr
    assert listener.texts("/new") == texts(0, 50)
    assert listener.texts("/b") == texts(0, 50, "b")
    assert listener.clock[0] == 0.0
    assert "played 100 messages of 2 topics" in finished.stderr


def test_damage_is_an_error_after_all_before_it_has_arrived(
    ros: Any, ros_process: Process, listener: Any, tmp_path: Path
) -> None:
    # Two chunks, of which the second is damaged.
    entries = [each._replace(text=f"{each.text} {'x' * 8_000}") for each in regular(150, 1.0)]
    bag = write_bag(tmp_path / "bag", entries, compression="none")
    file, whole = bag / "bag_0.mcap", 0
    content = bytearray(file.read_bytes())
    content[content.index(b"a149 ") + 10] ^= 0xFF
    file.write_bytes(content)
    with suppress(BagReadError):
        for _ in BagReader(bag).messages():
            whole += 1
    assert 0 < whole < 150
    listener.listen("/a")
    player = ros_process("player", parameters={"bag": str(file)})
    ros.spin_until(lambda: len(listener.heard) >= whole, 30.0, "all before the damage")
    finished = player.finish()
    assert finished.exit_code == 1
    assert "Traceback" not in finished.stderr
    (line,) = [line for line in finished.stderr.splitlines() if line.startswith("error: ")]
    assert "bag_0.mcap: the file is damaged" in line
    assert [text.split()[0] for text in listener.texts()] == texts(0, whole)
