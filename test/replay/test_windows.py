# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings in windows: what comes out is what one window with everything gives."""

import tracemalloc

import numpy as np
import pytest

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.joint_states import JointStateDecoder, JointStateEncoder
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.replay.estimate import Observer, run_observers
from tsobs_ros.replay.log import LogSource
from tsobs_ros.replay.source import BagSource
from tsobs_ros.report.comparison import measure_runs

DECODE = JointStateDecoder()
SECOND = 10**9


def spoilt(messages):
    """Return measurements of which some are outliers, late, twice, unreadable or not finite."""
    messages = list(messages)
    for place, angle in ((50, 100.0), (51, 100.0), (220, 100.0), (200, np.nan)):
        topic, data, time = messages[place]
        stamp, names, _, _, effort, _ = DECODE(data)
        messages[place] = topic, JointStateEncoder(names)(stamp, [angle] * 2, (), effort), time
    late = messages.pop(100)
    messages.insert(103, (*late[:2], messages[102][2] + 1))
    messages.insert(260, (*messages[250][:2], messages[259][2] + 1))
    messages.insert(270, (messages[0][0], b"nothing", messages[269][2] + 1))
    return messages


def looped_after_a_silence(messages):
    once = [*messages[:100], *messages[-100:]]
    return [*once, *((topic, data, time + 4 * SECOND) for topic, data, time in once)]


def apart(messages):
    """Return measurements of joints by a publisher each, one slower than the other."""
    single = []
    for topic, data, time in messages:
        stamp, names, position, _, effort, _ = DECODE(data)
        for k, name in enumerate(names):
            one = JointStateEncoder([name])(stamp, [position[k]], (), [effort[k]])
            single.append((topic, one, time + 700_000 * k))
    return sorted(single, key=lambda message: message[2])


def result(run, bag):
    """Return all that comes out of a run."""
    found = {}
    for message in BagReader(bag).messages():
        found.setdefault(message.topic, []).append(message)
    counts = run.used, run.rejected, run.rewinds, run.estimates
    return found, counts, run.estimates, run.events, run.health(), run.agreement()


@pytest.mark.parametrize("observed", [False, True])
@pytest.mark.parametrize("rate", [None, 130.0])
@pytest.mark.parametrize("change", [spoilt, looped_after_a_silence, apart])
def test_windows_change_nothing(
    arms, write_bag, estimate, tmp_path, change, rate, observed
) -> None:
    messages = change(arms.messages(300, joints=2))
    bag = write_bag(messages)
    if observed:
        heard = [one for k, one in enumerate(messages) if not (k < 20 or 150 <= k < 153)]
        estimate(write_bag(heard, "heard"), output="live", rate=rate)
        own = [
            (one.topic, one.data, one.publish_time)
            for one in BagReader(tmp_path / "live").messages()
            if "/observer/" in one.topic
        ]
        bag = write_bag(sorted([*messages, *own], key=lambda one: one[2]), "both")
    elsewhen = {"rate": rate, "as_live": observed}

    whole = estimate(bag, output="whole", **elsewhen)
    parts = estimate(bag, output="parts", window=90, **elsewhen)

    expected = result(whole, tmp_path / "whole")
    came = result(parts, tmp_path / "parts")
    for topic, messages in expected[0].items():
        for k, (one, other) in enumerate(zip(messages, came[0][topic], strict=True)):
            assert one == other, (k, topic, len(messages))
    assert came[1:] == expected[1:]
    agreement = expected[-1]
    assert not observed or agreement.reproduced == agreement.recorded > 100, agreement.text()
    assert len(parts.window.samples) < 200


def test_windows_of_a_log_change_nothing(arms, estimate, tmp_path) -> None:
    """Time restarts in it, and a line has no angle."""
    log = tmp_path / "log.csv"
    rows = [f"{0.005 * k % 2:.3f},{arms.y[k % 600, 0]},{arms.u[k % 600, 0]}" for k in range(700)]
    rows[500] = "0.500,,0.1"
    log.write_text("\n".join(["time [s],angle [rad],torque [N m]", *rows]))

    whole = estimate(LogSource(log), output="whole")
    parts = estimate(LogSource(log), output="parts", window=128)

    assert result(parts, tmp_path / "parts") == result(whole, tmp_path / "whole")
    assert whole.estimates == 700
    assert len(parts.window.samples) < 200


def peak(work, bag) -> int:
    """Return how many bytes Python had allocated at once during some work."""
    tracemalloc.start()
    try:
        work(bag)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.slow
def test_memory_does_not_grow_with_the_recording(arms, write_bag, design, tmp_path) -> None:
    files = (design,)

    def estimate_and_compare(bag, output=None) -> None:
        source = BagSource(bag)
        observers = [
            Observer(name, ObserverSettings(method=method), files)
            for name, method in (("observer", "certified"), ("other", "high_gain"))
        ]
        runs = run_observers(source, observers, output, window=200, keep=True)
        assert len(measure_runs(source, runs)) == 2

    peaks = []
    for times in (3, 12):
        messages = [
            (topic, restamped(data, k), time + k * 3 * SECOND)
            for k in range(times)
            for topic, data, time in arms.messages(600)
        ]
        bag, observed = write_bag(messages, f"bag_{times}"), tmp_path / f"observed_{times}"
        estimate_and_compare(bag, observed)
        peaks.append([peak(estimate_and_compare, path) for path in (bag, observed)])

    for short, four_times_as_long in zip(*peaks, strict=True):
        assert four_times_as_long < 1.25 * short, peaks


def restamped(data: bytes, times: int) -> bytes:
    stamp, names, position, _, effort, _ = DECODE(data)
    return JointStateEncoder(names)(stamp + times * 3 * SECOND, position, (), effort)
