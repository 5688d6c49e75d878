# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder's selection of topics, its diagnostics and its count of losses."""

from collections import Counter
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsobs_ros.bag.recording import BufferedMessage, SnapshotBuffer
from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.recorder.parameters import RecorderParameters
from tsobs_ros.nodes.recorder.status import LossCounter, RecorderStatistics, statuses

# A robot's topics, with hidden ones and the events of two services and an action.
GRAPH: Mapping[str, str] = {
    "/arm/joints": "sensor_msgs/msg/JointState",
    "/arm/torque": "sensor_msgs/msg/JointState",
    "/camera/image": "sensor_msgs/msg/Image",
    "/arm/_raw": "std_msgs/msg/String",
    "/_internal/state": "std_msgs/msg/String",
    "/go/_action/feedback": "my_msgs/action/Go_FeedbackMessage",
    "/arm/reset/_service_event": "std_srvs/srv/Trigger_Event",
    "/camera/set/_service_event": "std_srvs/srv/SetBool_Event",
    "/odd/_service_event": "std_msgs/msg/String",
}

VISIBLE = {"/arm/joints", "/arm/torque", "/camera/image"}
HIDDEN = {"/arm/_raw", "/_internal/state", "/go/_action/feedback", "/odd/_service_event"}
EVENTS = {"/arm/reset/_service_event", "/camera/set/_service_event"}


def full(name: str) -> str:
    return name if name.startswith("/") else f"/arm/{name}"


def selected(**parameters: Any) -> set[str]:
    selection = RecorderParameters(**parameters).resolved(full, full)
    return {name for name, type in GRAPH.items() if selection.wants(name, [type])}


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({}, VISIBLE | EVENTS),
        ({"topics": ("*", "_raw")}, VISIBLE | {"/arm/_raw"}),
        ({"topics": ("joints", "/camera/image")}, {"/arm/joints", "/camera/image"}),
        ({"services": ("reset",)}, {"/arm/reset/_service_event"}),
        ({"services": ("*",)}, EVENTS),
        ({"topics": ("/arm/reset/_service_event",)}, {"/arm/reset/_service_event"}),
        ({"regex": "^/arm"}, {"/arm/joints", "/arm/torque", "/arm/reset/_service_event"}),
        ({"regex": "torque|set$", "topics": ("joints",)},
         {"/arm/joints", "/arm/torque"} | EVENTS),
        ({"include_hidden": True}, VISIBLE | HIDDEN | EVENTS),
        ({"include_hidden": True, "regex": "/_"}, HIDDEN),
        ({"exclude_topics": ("joints",)}, (VISIBLE | EVENTS) - {"/arm/joints"}),
        ({"exclude_services": ("reset",)}, (VISIBLE | EVENTS) - {"/arm/reset/_service_event"}),
        ({"exclude_regex": "^/camera"},
         {"/arm/joints", "/arm/torque", "/arm/reset/_service_event"}),
        ({"topics": ("joints", "torque"), "exclude_regex": "q"}, {"/arm/joints"}),
    ],
)  # fmt: skip
def test_what_is_selected_is_recorded(parameters: dict[str, Any], expected: set[str]) -> None:
    assert selected(**parameters) == expected


LOSSY = LossCounter()

LOSSY.lost = 3


def buffer(refused: int = 0) -> SnapshotBuffer:
    """Return one with two messages of 1.5 MiB, 1.5 s apart."""
    made = SnapshotBuffer(10**10, 4 * 2**20)
    for size, count in ((3 * 2**19, 2), (2**23, refused)):
        for k in range(count):
            made.add(BufferedMessage("/a", bytes(size - 256), k * 1_500_000_000, 0))
    return made


def counted_so(
    free: float = 1e4, sync_age: float = 1.0, snapshot: Any = None, **changes: Any
) -> RecorderStatistics:
    recording: Any = SimpleNamespace(
        counts=Counter({"/a": 100}), snapshot=snapshot, sync_age=sync_age,
        bytes=0, discarded=0, file_count=1,
    )  # fmt: skip
    values: dict[str, Any] = {
        "topics": {"/a": LossCounter()}, "recording": recording, "free_disk": free,
        "parameters": RecorderParameters(), "is_recording": True, "awaits_clock": False,
        "missing": (),
    }  # fmt: skip
    return RecorderStatistics(**values | changes)


@pytest.mark.parametrize(
    ("changes", "level", "message"),
    [
        ({}, Level.OK, "recording"),
        ({"is_recording": False}, Level.OK, "paused"),
        ({"snapshot": buffer()}, Level.OK, "keeping the last seconds"),
        ({"awaits_clock": True, "missing": ("/b",)}, Level.WARN, "waiting for /clock"),
        ({"sync_age": 9.0}, Level.OK, "recording"),
        ({"sync_age": 11.0}, Level.WARN, "the disk has not kept up for 11 s"),
        ({"free": 511.0, "sync_age": 11.0}, Level.WARN, "511 MiB of disk space are left"),
        ({"snapshot": buffer(refused=2), "free": 511.0}, Level.WARN,
         "2 messages too large for the snapshot buffer"),
        ({"topics": {"/a": LOSSY}, "free": 511.0}, Level.WARN, "3 messages lost"),
    ],
)  # fmt: skip
def test_the_worst_comes_first(changes: dict[str, Any], level: Level, message: str) -> None:
    recording, _ = statuses(counted_so(**changes), 12.34)
    assert (recording.name, recording.level, recording.message) == ("recording", level, message)


A, B = b"a", b"b"
AB = A + B


def counted(*steps: tuple[bytes, list[int | None]]) -> tuple[int, bool, int]:
    """Count numbers that arrive while publishers are there, each looked at twice in between."""
    counter = LossCounter()
    for publishers, numbers in steps:
        there = frozenset(bytes([p]) for p in publishers)
        counter.add(numbers, lambda there=there: there)
        counter.see(there)
        counter.see(there)
    return counter.lost, counter.is_exact, counter.earlier


# What arrives of one publisher after the other, in order, some numbers missing.
arrivals = st.lists(st.sets(st.integers(1, 40), min_size=1).map(sorted), max_size=5)


@given(arrivals)
def test_what_is_missing_of_publishers_that_follow_each_other_is_lost(
    arrived: list[list[int]],
) -> None:
    steps = [(bytes([k]), numbers) for k, numbers in enumerate(arrived)]
    gone: tuple[bytes, list[int | None]] = (b"", [])
    expected = sum(numbers[-1] - numbers[0] + 1 - len(numbers) for numbers in arrived)

    earlier = sum(numbers[0] - 1 for numbers in arrived)
    found = counted(*(step for pair in steps for step in (pair, gone)))

    assert found == (expected, True, earlier)


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        # A publisher that restarts between two looks is neither lost nor hides a loss.
        ([(A, [5, 6, 9]), (B, [12, 1, 2, 5])], (2 + 2, False, 4)),
        ([(A, [5, 6, 9]), (B, [1, 2, 5])], (2 + 2, True, 4)),
        ([(A, [5, 6, 9]), (B, [3, 4])], (2, True, 4 + 2)),
        ([(A, [5, 6, 9]), (b"", [11])], (2 + 1, True, 4)),
        # Several make losses unknown and are not counted.
        ([(AB, [1, 2, 3])], (0, False, 0)),
        ([(A, [100]), (AB, [1, 101, 2, 102])], (0, False, 99)),
        # One came and went before it could be seen.
        ([(A, [100]), (A, [1, 101, 102])], (0, False, 99)),
        # One is killed and still announced when the next one has come.
        ([(A, [100, 102]), (AB, [1, 3]), (B, [4, 7, 9])], (1 + 3, False, 99)),
        # The middleware gives no numbers.
        ([(A, [None, None])], (0, False, 0)),
    ],
)
def test_losses_are_exact_while_there_is_one_publisher(
    steps: list[tuple[bytes, list[int | None]]], expected: tuple[int, bool, int]
) -> None:
    assert counted(*steps) == expected
