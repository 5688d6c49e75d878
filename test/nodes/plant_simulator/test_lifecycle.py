# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An inactive arm stands still in time, and a new one restarts."""

import itertools
from collections.abc import Callable
from typing import Any

PERIOD = 5_000_000
SECOND = 1_000_000_000


def test_after_a_pause_the_arm_goes_on_from_there_with_present_stamps(
    ros: Any, listener: Any, manage: Callable[[Any], Any]
) -> None:
    manager = manage(listener.start())
    listener.wait_for(listener.states, 20)
    assert manager.change("deactivate")
    listener.command(5.0)  # not for an arm that stands still
    arrived = ros.hear_out(listener.states)
    paused_at = listener.states[-1].stamp
    ros.spin_for(0.5)
    assert len(listener.states) == arrived
    assert manager.change("activate")
    listener.wait_for(listener.states, 30)

    found = listener.indices(listener.states, listener.core(5000))
    assert found == list(range(found[0], found[0] + len(found)))
    stamps = [item.stamp for item in listener.states]
    assert max(b - a for a, b in itertools.pairwise(stamps)) > SECOND // 2
    assert stamps[-1] > paused_at + SECOND // 2


def test_a_driven_clock_stands_still_with_the_arm(
    ros: Any, listener: Any, manage: Callable[[Any], Any]
) -> None:
    listener.listen_to_clock()
    manager = manage(listener.start(publish_clock=True))
    listener.wait_for(listener.clock, 20)
    assert manager.change("deactivate")
    paused_at = ros.hear_out(listener.clock)
    ros.spin_for(0.1)
    assert len(listener.clock) == paused_at
    assert manager.change("activate")
    listener.wait_for(listener.clock, 20)
    assert {b - a for a, b in itertools.pairwise(listener.clock)} == {PERIOD}
