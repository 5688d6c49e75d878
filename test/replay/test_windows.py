# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings in windows: what comes out is what one window with everything gives."""

import numpy as np
import pytest

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.joint_states import JointStateDecoder, JointStateEncoder

DECODE = JointStateDecoder()
SECOND = 10**9


def spoilt(messages):
    """Return measurements of which some are outliers, late, twice, unreadable or not finite."""
    messages = list(messages)
    for place in (50, 51, 120, 350):
        topic, data, time = messages[place]
        stamp, names, _, _, effort, _ = DECODE(data)
        data = JointStateEncoder(names)(stamp, [100.0] * len(names), (), effort)
        messages[place] = topic, data, time
    topic, data, time = messages[200]
    stamp, names, _, _, effort, _ = DECODE(data)
    messages[200] = topic, JointStateEncoder(names)(stamp, [np.nan] * len(names), (), effort), time
    late = messages.pop(100)
    messages.insert(103, (*late[:2], messages[102][2] + 1))
    messages.insert(260, (*messages[250][:2], messages[259][2] + 1))
    messages.insert(270, (messages[0][0], b"nothing", messages[269][2] + 1))
    return messages


def looped(messages):
    later = [(topic, data, time + 4 * SECOND) for topic, data, time in messages]
    return [*messages, *later]


def apart(messages):
    """Return measurements of joints by a publisher each, one slower than the other."""
    single = []
    for topic, data, time in messages:
        stamp, names, position, _, effort, _ = DECODE(data)
        for k, name in enumerate(names):
            one = JointStateEncoder([name])(stamp, [position[k]], (), [effort[k]])
            single.append((topic, one, time + 700_000 * k))
    return sorted(single, key=lambda message: message[2])


def silent(messages):
    return [*messages[:200], *messages[-200:]]


def result(run, bag):
    """Return all that comes out of a run."""
    found = {}
    for message in BagReader(bag).messages():
        found.setdefault(message.topic, []).append(message)
    counts = run.replay.used, run.replay.rejected, run.replay.rewinds, run.replay.failures
    return found, counts, run.estimates, run.events(), run.health(), run.agreement()


@pytest.mark.parametrize("observed", [False, True])
@pytest.mark.parametrize("rate", [None, 130.0])
@pytest.mark.parametrize("change", [spoilt, looped, apart, silent])
def test_windows_change_nothing(
    arms, write_bag, estimate, tmp_path, change, rate, observed
) -> None:
    messages = change(arms.messages(600, joints=2))
    bag = write_bag(messages)
    if observed:
        heard = [one for k, one in enumerate(messages) if not (k < 40 or 400 <= k < 403)]
        estimate(write_bag(heard, "heard"), output="live", rate=rate)
        own = [
            (one.topic, one.data, one.publish_time)
            for one in BagReader(tmp_path / "live").messages()
            if "/observer/" in one.topic
        ]
        bag = write_bag(sorted([*messages, *own], key=lambda one: one[2]), "both")
    elsewhen = {"rate": rate, "as_live": observed}

    whole = estimate(bag, output="whole", **elsewhen)
    parts = estimate(bag, output="parts", window=200, **elsewhen)

    expected = result(whole, tmp_path / "whole")
    assert result(parts, tmp_path / "parts") == expected
    assert not observed or expected[-1].complete, expected[-1].text()
    assert parts.samples.count < 600
