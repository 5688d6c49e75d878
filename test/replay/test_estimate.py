# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates over bags: those of the trackers, and those of a recorded run to the last bit."""

from pathlib import Path

import numpy as np
import pytest

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.joint_states import JointStateDecoder, JointStateEncoder
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import BagReadError, BagWriteError
from tsobs_ros.estimation.records import Measurement, RejectReason
from tsobs_ros.methods import FILTERS, METHODS, ObserverSettings, make_tracker
from tsobs_ros.replay.source import BagSource

START, PERIOD, LATENCY = 1_700_000_000_000_000_000, 5_000_000, 300_000
DECODE = JointStateDecoder()


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


def test_estimates_at_the_measurements_are_those_of_a_tracker(
    arms, design, write_bag, estimate
) -> None:
    run = estimate(write_bag(arms.messages()))

    tracker = make_tracker(design, ObserverSettings())
    for k in range(300):
        stamp = START + k * PERIOD
        tracker.offer(Measurement(stamp, arms.y[k, :1], arms.u[k, :1]), stamp)
        one = tracker.estimate(stamp)
        assert one is not None
        assert run.table.states[k, 0].tolist() == one.state.tolist()
        assert run.table.state_bounds[k, 0].tolist() == one.state_bound.tolist()
        assert run.table.disturbances[k, 0, 0] == one.disturbance[0]
    assert run.replay.used == 300
    assert not run.replay.rejected


def test_a_tick_includes_only_what_has_arrived(arms, design, write_bag, estimate) -> None:
    run = estimate(write_bag(arms.messages()), rate=100.0)

    tracker = make_tracker(design, ObserverSettings())
    offered = 0
    for k, stamp in enumerate(run.schedule.stamps.tolist()):
        assert stamp == START + LATENCY + k * 10_000_000
        while offered < 300 and START + offered * PERIOD + LATENCY <= stamp:
            sample = Measurement(START + offered * PERIOD, arms.y[offered, :1], arms.u[offered, :1])
            tracker.offer(sample, stamp)
            offered += 1
        assert run.table.states[k, 0].tolist() == tracker.estimate(stamp).state.tolist()
    assert offered == 299
    assert run.replay.used == 300


@pytest.mark.parametrize("rate", [None, 130.0])
@pytest.mark.parametrize("joints", [1, 2])
def test_a_recorded_run_is_reproduced(arms, write_bag, estimate, tmp_path, joints, rate) -> None:
    messages = arms.messages(joints=joints)
    late = messages.pop(100)
    messages.insert(103, (*late[:2], messages[102][2] + 1))
    for place in (50, 51, 120):
        messages[place] = outlier(messages[place])
    estimate(write_bag(messages), output="live", rate=rate)

    again = estimate(tmp_path / "live", output="again")

    agreement = again.agreement()
    assert agreement.complete, agreement.text()
    assert agreement.recorded == len(again.schedule.stamps)
    data = [sorted(one[:2] for one in observed(tmp_path / name)) for name in ("live", "again")]
    assert data[0] == data[1]
    assert again.replay.rejected[RejectReason.GATED] == 3 * joints
    assert again.replay.rewinds == joints


def test_what_comes_together_is_used_by_its_stamps_and_reproduced(
    arms, write_bag, estimate, tmp_path
) -> None:
    """Blocks in reverse order, an unreadable message in each; every tick finds a whole one."""
    messages = arms.messages(310)
    backwards = messages[:50]
    for first in range(50, 300, 50):
        block = messages[first : first + 50]
        unreadable = (block[0][0], JointStateEncoder(["elbow"])(START, [0.0], (), ()), 0)
        arrival = block[-1][2]
        for k, one in enumerate([*block[:0:-1], unreadable, block[0]]):
            backwards.append((*one[:2], arrival + k))
    backwards += messages[300:]

    live = estimate(write_bag(backwards), output="live", rate=100.0)
    again = estimate(tmp_path / "live", output="again")

    for run in (live, again):
        assert run.replay.used == 310
        assert run.replay.rewinds == 0
        assert run.replay.rejected == {RejectReason.WRONG_JOINT: 5}
    assert again.agreement().complete, again.agreement().text()
    data = [sorted(one[:2] for one in observed(tmp_path / name)) for name in ("live", "again")]
    assert data[0] == data[1]
    used = live.table.innovations[:, 0, 0]
    in_order = estimate(write_bag(messages, "in_order"), rate=100.0).table.innovations[:, 0, 0]
    assert sorted(used[~np.isnan(used)]) == sorted(in_order)


def test_measurements_without_innovations_are_placed_by_what_they_did(
    arms, write_bag, estimate, tmp_path
) -> None:
    messages = arms.messages(200)
    for place in range(60, 90):
        messages[place] = outlier(messages[place])
    estimate(write_bag(messages), output="live", rate=77.0)
    # As from a node on another core: its estimates come after measurements it did not know of.
    shifted = [
        (topic, data, time + (3_000_000 if "/observer/" in topic else 0))
        for topic, data, time in [*messages, *observed(tmp_path / "live")]
        if not topic.endswith("innovation")
    ]
    shifted.sort(key=lambda message: message[2])

    agreement = estimate(write_bag(shifted, "shifted")).agreement()

    assert agreement.complete, agreement.text()


def test_publishers_that_overtake_each_other_are_put_in_the_order_of_use(
    arms, write_bag, estimate, tmp_path
) -> None:
    single = []
    for topic, data, time in arms.messages(100, joints=2):
        stamp, names, position, _, effort, _ = DECODE(data)
        for joint in (0, 1):
            encode = JointStateEncoder(names[joint : joint + 1])
            own = encode(stamp - joint, [position[joint]], (), [effort[joint]])
            single.append((topic, own, time + joint))
    estimate(write_bag(single), output="live")
    # Each second joint's message was sent before the first's, and only arrived later.
    sent = [
        (topic, data, time - (2 if topic == "/joint_measurements" and time % 2 else 0))
        for topic, data, time in [*single, *observed(tmp_path / "live")]
    ]
    assert sent != sorted(sent, key=lambda message: message[2])

    agreement = estimate(write_bag(sorted(sent, key=lambda m: m[2]), "sent")).agreement()

    assert agreement.complete, agreement.text()


def test_a_restart_of_time_resets_the_observer(arms, write_bag, estimate, tmp_path) -> None:
    once = arms.messages(250)
    again = [(topic, data, time + 10**10) for topic, data, time in once]
    run = estimate(write_bag([*once, *again]), output="looped")

    assert run.replay.used == 500
    assert np.array_equal(run.table.states[:250], run.table.states[250:])
    assert estimate(tmp_path / "looped").agreement().complete


@pytest.mark.parametrize(
    ("lost", "settings", "counts", "reason"),
    [
        ([40], {}, (1, 0), "the live observer used 1 measurement that the bag lacks"),
        ([40, 60], {}, (2, 0), "used 2 measurements that the bag lacks"),
        ([], {"method": "high_gain"}, (0, 0), "it had another design"),
    ],
)
def test_the_reason_of_a_difference_is_named(
    arms, write_bag, estimate, tmp_path, lost, settings, counts, reason
) -> None:
    messages = arms.messages(100)
    estimate(write_bag(messages), output="live")
    recorded = [(m.topic, m.data, m.log_time) for m in BagReader(tmp_path / "live").messages()]
    kept = [message for message in recorded if message not in [messages[k] for k in lost]]

    agreement = estimate(write_bag(kept, "other"), **settings).agreement()

    assert not agreement.complete
    assert (agreement.not_recorded, agreement.not_received) == counts
    assert reason in agreement.text()
    if not settings:
        assert agreement.reproduced >= 39
        assert agreement.first_difference == START + 40 * PERIOD


@pytest.mark.parametrize("joints", [1, 2])
@pytest.mark.parametrize(
    ("unheard", "recorded_from", "counts"),
    [
        ([40], 0, (0, 1, 0)),
        ([*range(30)], 0, (30, 0, 0)),
        ([*range(30), 50, *range(70, 75), *range(90, 100)], 0, (30, 6, 10)),
        # The recorder of the observer came later than that of the measurements.
        ([], 30, (0, 0, 0)),
        ([*range(10)], 30, (10, 0, 0)),
    ],
)
def test_what_the_live_observer_did_not_receive_is_left_out(
    arms, write_bag, estimate, tmp_path, joints, unheard, recorded_from, counts
) -> None:
    messages = arms.messages(100, joints)
    messages[60] = outlier(messages[60])
    heard = [message for k, message in enumerate(messages) if k not in unheard]
    estimate(write_bag(heard), output="live")
    later = [one for one in observed(tmp_path / "live") if one[2] >= messages[recorded_from][2]]
    bag = write_bag(sorted([*messages, *later], key=lambda message: message[2]), "other")

    run = estimate(bag, output="again")

    agreement = run.agreement()
    assert agreement.complete, agreement.text()
    assert (agreement.before_first, agreement.in_between, agreement.after_last) == counts
    assert run.replay.used == (99 - len(unheard)) * joints
    kinds = "from before the live observer's first", "that did not reach it", "from after its last"
    for count, kind in zip(counts, kinds, strict=True):
        plural = "s" * (count > 1)
        assert (f"{count} measurement{plural} {kind}" in agreement.text()) == (count > 0)


def test_an_observer_that_had_run_before_is_recognised(arms, write_bag, estimate, tmp_path) -> None:
    messages = arms.messages(100)
    estimate(write_bag(messages), output="live")
    later = [one for one in observed(tmp_path / "live") if one[2] >= messages[50][2]]
    bag = write_bag(sorted([*messages[50:], *later], key=lambda message: message[2]), "other")

    agreement = estimate(bag).agreement()

    assert agreement.reproduced == 0
    assert "the live observer had run before the recording of it began" in agreement.text()
    assert "design" not in agreement.text()


def test_an_observer_of_the_second_pass_of_a_loop_did_not_receive_the_first(
    arms, write_bag, estimate, tmp_path
) -> None:
    once = arms.messages(300)
    again = [(topic, data, time + 2 * 10**9) for topic, data, time in once]
    estimate(write_bag(again), output="live")
    both = sorted([*once, *again, *observed(tmp_path / "live")], key=lambda message: message[2])

    agreement = estimate(write_bag(both, "both")).agreement()

    assert agreement.complete, agreement.text()
    assert (agreement.recorded, agreement.before_first) == (300, 300)


def test_messages_of_one_joint_each_are_put_together(arms, write_bag, estimate) -> None:
    both = arms.messages(60, joints=2)
    single = []
    for topic, data, time in both:
        stamp, names, position, _, effort, _ = DECODE(data)
        for joint in (0, 1):
            encode = JointStateEncoder(names[joint : joint + 1])
            single.append((topic, encode(stamp, [position[joint]], (), [effort[joint]]), time))

    run, together = estimate(write_bag(single)), estimate(write_bag(both, "both"))

    assert run.replay.used == together.replay.used == 120
    assert np.array_equal(run.table.states, together.table.states)


@pytest.mark.parametrize("method", list(METHODS))
def test_every_method_runs(arms, write_bag, estimate, tmp_path, method) -> None:
    run = estimate(write_bag(arms.messages(50)), output="new", method=method)

    assert run.table.done.all()
    counts = {name: topic.count for name, topic in BagReader(tmp_path / "new").topics.items()}
    bounded = 50 if method in ("certified", *FILTERS) else 0
    assert counts["/observer/joint_states"] == 50
    assert counts["/observer/error_bound"] == bounded
    assert counts["/joint_measurements"] == 50


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
    rejected = estimate(BagSource(bag, joints=["elbow"])).replay.rejected

    assert rejected == {
        RejectReason.NON_FINITE: 1,
        RejectReason.ZERO_STAMP: 1,
        RejectReason.DUPLICATE: 1,
        RejectReason.FROM_FUTURE: 1,
        RejectReason.WRONG_JOINT: 3,
    }


def test_an_existing_output_is_not_touched(arms, write_bag, estimate, tmp_path) -> None:
    (tmp_path / "new").mkdir()

    with pytest.raises(BagWriteError, match="exists already"):
        estimate(write_bag(arms.messages(5)), output="new")


def test_damage_costs_only_what_comes_after_it(arms, write_bag, estimate, tmp_path) -> None:
    bag = write_bag(arms.messages(600), max_duration_ns=500_000_000, compression="none")
    files = sorted(bag.glob("*.mcap"), key=lambda path: int(path.stem.rpartition("_")[2]))
    damaged = files[len(files) // 2]
    data = bytearray(damaged.read_bytes())
    place = data.find(b"elbow")
    data[place : place + 5] = b"xxxxx"
    damaged.write_bytes(data)

    source = BagSource(bag)
    run = estimate(source, output="new")

    assert "damaged" in str(source.damage)
    assert 0 < run.replay.used < 600
    assert BagReader(tmp_path / "new").topics["/observer/joint_states"].count == run.replay.used


@pytest.mark.parametrize(
    ("topic", "options", "match"),
    [
        ("/other", {}, "no topic ends in joint_measurements, choose one of: /other"),
        ("/joint_measurements", {"topic": "/x"}, "no topic /x; topics: /joint_measurements"),
        ("/joint_measurements", {"joints": ["knee"]}, "names knee; joints: elbow"),
    ],
)
def test_what_is_not_there_is_said_with_what_is(arms, write_bag, topic, options, match) -> None:
    bag = write_bag([(topic, data, time) for _, data, time in arms.messages(3)])

    with pytest.raises(BagReadError, match=match):
        BagSource(bag, **options).observe([ArmRequest()])
