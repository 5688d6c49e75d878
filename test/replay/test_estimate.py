# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates over bags: those of the trackers, and those of a recorded run to the last bit."""

from operator import itemgetter
from pathlib import Path

import numpy as np
import pytest

from tsobs_ros.bag import BagReader, BagWriter
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateDecoder, JointStateEncoder
from tsobs_ros.bag.verification import verify
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import BagReadError
from tsobs_ros.estimation.records import Measurement, RejectReason
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.replay.estimate import Run
from tsobs_ros.replay.source import BagSource

START, PERIOD, LATENCY = 1_700_000_000_000_000_000, 5_000_000, 300_000
DECODE = JointStateDecoder()
LOG_TIME = itemgetter(2)


def outlier(message: tuple[str, bytes, int]) -> tuple[str, bytes, int]:
    """Return the measurement with an angle far off."""
    topic, data, time = message
    stamp, names, _, _, effort, _ = DECODE(data)
    return topic, JointStateEncoder(names)(stamp, [100.0] * len(names), (), effort), time


def observed(bag: Path) -> list[tuple[str, bytes, int]]:
    return [
        (one.topic, one.data, one.publish_time)
        for one in BagReader(bag).messages()
        if "/observer/" in one.topic
    ]


def states(run: Run, joint: int = 0) -> np.ndarray:
    return run.values(joint, "state")


def test_a_tick_includes_only_what_has_arrived(arms, design, write_bag, estimate) -> None:
    run = estimate(write_bag(arms.messages()), rate=100.0)

    tracker = make_tracker(design, ObserverSettings())
    offered = 0
    for k, stamp in enumerate(run.window.ticks.stamps[run.done].tolist()):
        assert stamp == START + LATENCY + k * 10_000_000
        while offered < 300 and START + offered * PERIOD + LATENCY <= stamp:
            sample = Measurement(START + offered * PERIOD, arms.y[offered, :1], arms.u[offered, :1])
            tracker.offer(sample, stamp)
            offered += 1
        assert states(run)[k].tolist() == tracker.estimate(stamp).state.tolist()
    assert offered == 299
    # The last one is used without a tick.
    assert run.used == 300


@pytest.mark.parametrize(
    ("lost", "method", "reason", "counts"),
    [
        (
            "measurements",
            "certified",
            "used 2 measurements that the bag lacks",
            {"not_recorded": 2},
        ),
        ("ticks", "certified", "its tick log lacks 2 ticks", {"lost_ticks": 2, "not_received": 2}),
        ("", "high_gain", "it had another design, other parameters", {}),
    ],
)
def test_the_reason_of_a_difference_is_named(
    arms, write_bag, estimate, tmp_path, lost, method, reason, counts
) -> None:
    messages = arms.messages(100)
    estimate(write_bag(messages), output="live", settings=ObserverSettings(method=method))
    made = observed(tmp_path / "live")
    gone = [one for one in (*messages, *made) if lost and one[0].endswith(lost)][40:42]
    both = [one for one in (*messages, *made) if one not in gone]

    agreement = estimate(write_bag(sorted(both, key=LOG_TIME), "other")).agreement()

    assert agreement.reproduced < agreement.recorded == 100
    assert reason in agreement.text()
    for name in ("not_recorded", "lost_ticks", "not_received"):
        assert getattr(agreement, name) == counts.get(name, 0)
    if lost == "measurements":
        assert agreement.first_difference == START + 40 * PERIOD


@pytest.mark.parametrize(("joints", "window"), [(1, 2**31), (2, 16)])
def test_what_the_live_observer_did_not_receive_is_left_out(
    arms, write_bag, estimate, tmp_path, joints, window
) -> None:
    unheard = [*range(30), 50, *range(70, 75), *range(90, 100)]
    messages = arms.messages(100, joints)
    messages[60] = outlier(messages[60])
    heard = [message for k, message in enumerate(messages) if k not in unheard]
    estimate(write_bag(heard), output="live")
    bag = write_bag(sorted([*messages, *observed(tmp_path / "live")], key=LOG_TIME), "other")

    run = estimate(bag, output="again", window=window)

    agreement = run.agreement()
    assert agreement.reproduced == agreement.recorded == 54, agreement.text()
    assert agreement.not_received == len(unheard)
    assert run.used == (99 - len(unheard)) * joints
    assert f"without {len(unheard)} measurements that did not reach it" in agreement.text()


def test_an_observer_that_had_run_before_is_recognised(arms, write_bag, estimate, tmp_path) -> None:
    messages = arms.messages(100)
    estimate(write_bag(messages), output="live")
    later = [one for one in observed(tmp_path / "live") if one[2] >= messages[50][2]]
    bag = write_bag(sorted([*messages[50:], *later], key=LOG_TIME), "other")

    agreement = estimate(bag).agreement()

    assert agreement.reproduced == 0
    assert "the live observer had run before the recording of it began" in agreement.text()
    assert "design" not in agreement.text()


def test_without_a_tick_log_estimates_are_at_the_measurements_and_a_note_says_so(
    arms, write_bag, estimate, tmp_path
) -> None:
    estimate(write_bag(arms.messages(100)), output="live", rate=77.0)
    made = [one for one in observed(tmp_path / "live") if one[0] != "/observer/ticks"]
    bag = write_bag(sorted([*arms.messages(100), *made], key=LOG_TIME), "other")

    source = BagSource(bag)
    run = estimate(source)

    assert run.agreement() is None
    assert run.window.ticks.stamps.tolist() == [START + k * PERIOD for k in range(100)]
    assert [one for one in source.remarks if "no tick log" in one]


def test_runs_that_log_times_mix_are_warned_about(arms, design, tmp_path) -> None:
    """Of a recorder that let them go back with simulated time."""
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/joint_measurements", JOINT_STATE)
        for again in (0, 10_000_000_000):
            for topic, data, time in arms.messages(50):
                writer.write(topic, data, time, time + again)

    source = BagSource(tmp_path / "bag")
    source.observe([design.request])

    assert [one for one in source.remarks if "several runs are mixed" in one]


def test_what_cannot_be_used_is_counted(arms, write_bag, estimate) -> None:
    messages = arms.messages(20)
    encode = JointStateEncoder(["elbow"])
    bad = [
        encode(START + 20 * PERIOD, [np.nan], (), [0.0]),
        encode(0, [0.0], (), [0.0]),
        encode(START, [0.0], (), [0.0]),
        encode(START + 10**12, [0.0], (), [0.0]),
        encode(START + 21 * PERIOD, [0.0], (), []),
        JointStateEncoder(["shoulder"])(START + 22 * PERIOD, [0.0], (), [0.0]),
        b"nothing",
    ]
    time = messages[-1][2]
    messages += [("/joint_measurements", data, time + k) for k, data in enumerate(bad, 1)]

    bag = write_bag(messages)
    rejected = estimate(BagSource(bag, joints=["elbow"])).rejected

    assert rejected == {
        RejectReason.NON_FINITE: 1,
        RejectReason.ZERO_STAMP: 1,
        RejectReason.DUPLICATE: 1,
        RejectReason.FROM_FUTURE: 1,
        RejectReason.WRONG_JOINT: 2,
        RejectReason.MISSING_INPUT: 1,
    }


@pytest.mark.parametrize(
    ("topic", "options", "match"),
    [
        ("/other", {"joints": ["knee"]}, "no message of /other has link_angle of knee"),
        ("/joint_measurements", {"topic": "/x"}, "no topic /x; topics: /joint_measurements"),
        (
            "/joint_measurements",
            {"joints": ["knee"]},
            "has link_angle of knee .*it has: elbow; all of it for --joints elbow",
        ),
    ],
)
def test_what_is_not_there_is_said_with_what_is(arms, write_bag, topic, options, match) -> None:
    bag = write_bag([(topic, data, time) for _, data, time in arms.messages(3)])

    with pytest.raises(BagReadError, match=match):
        BagSource(bag, **options).observe([ArmRequest()])


TRUTH = "/ground_truth/joint_states"


def with_truth(messages: list[tuple[str, bytes, int]]) -> list[tuple[str, bytes, int]]:
    """Add some truth, which a recorder receives a moment before a measurement, or at once."""
    encode = JointStateEncoder(["elbow_link", "elbow_motor"])
    found = []
    for number, one in enumerate(messages):
        truth = encode(one[2], [0.1, 0.2], [0.3, 0.4])
        found += [(TRUTH, truth, one[2] - 1000 * (number % 2)), one]
    return found


@pytest.mark.parametrize("options", [{}, {"rate": 130.0, "window": 32}])
def test_a_new_bag_has_what_was_recorded(arms, write_bag, estimate, tmp_path, options) -> None:
    written = with_truth(arms.messages(100))
    estimate(write_bag(written), output="new", **options)

    assert verify(tmp_path / "new").holds
    messages = list(BagReader(tmp_path / "new").messages())
    recorded = [(m.topic, m.data, m.log_time) for m in messages if "observer" not in m.topic]
    assert recorded == sorted(written, key=LOG_TIME)
    # What is made of a measurement comes behind it, but what it is made with in front.
    assert [one.topic for one in messages[:2]] == ["/observer/design", TRUTH]
    topics = [m.topic for m in messages if m.log_time == arms.messages(50)[-1][2]]
    if "rate" not in options:
        assert topics.index("/joint_measurements") < topics.index("/observer/joint_states")
