# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer under a lifecycle manager: silent unless active, afresh with each activation."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from observer.bench import OUTPUTS, PERIOD, RUN, SECOND, SHIPPED, Bench, replayed
from rclpy.parameter import Parameter

from tsobs_ros.nodes.observer import Observer, create


@pytest.fixture
def bench(ros: Any) -> Bench:
    bench = Bench(ros)
    bench.begin_clock()
    return bench


def unconfigured(bench: Bench, **parameters: Any) -> Observer:
    overrides = {"autostart": False, "use_sim_time": True, **parameters}
    node: Observer = create(
        context=bench.ros.context,
        parameter_overrides=[Parameter(name, value=value) for name, value in overrides.items()],
    )
    bench.observer = bench.ros.add(node)
    return node


def test_an_inactive_observer_discards_what_comes_and_an_active_one_begins_afresh(
    bench: Bench, manage: Callable[[Any], Any]
) -> None:
    observer = unconfigured(bench)
    manager = manage(observer)
    assert observer.count_publishers("/observer/joint_states") == 0
    assert manager.change("configure")
    bench.wait_for_matches()
    bench.set_clock(100 * SECOND)
    for index in range(20):
        bench.send(index, 100 * SECOND + index * PERIOD)
        bench.set_clock(100 * SECOND + index * PERIOD)
    assert (bench.published, observer.received) == ([], 0)

    assert manager.change("activate")
    bench.feed(range(20, 60), 100 * SECOND)
    bench.wait_for_quiet()
    assert observer.tracker.used == 40
    assert manager.change("deactivate")
    published = len(bench.published)
    for index in range(60, 80):
        bench.send(index, 100 * SECOND + index * PERIOD)
        bench.set_clock(100 * SECOND + index * PERIOD)
    assert bench.status("state").message == "INACTIVE"
    assert len(bench.published) == published

    bench.published.clear()
    assert manager.change("activate")
    bench.feed(range(80, 120), 100 * SECOND)
    bench.wait_for_quiet()
    assert list(bench.innovations[0].message.position) == RUN.measurements[0, 80].tolist()
    assert observer.tracker.used == 40
    assert replayed(bench) > 20


def test_a_design_that_is_none_leaves_the_observer_unconfigured(
    bench: Bench, manage: Callable[[Any], Any], tmp_path: Path
) -> None:
    path = tmp_path / "my.design.yaml"
    observer = unconfigured(bench, design=str(path))
    manager = manage(observer)
    bare = manager.entities
    assert not manager.change("configure")
    assert (manager.state, manager.entities) == ("unconfigured", bare)
    path.write_text(SHIPPED.read_text(encoding="utf-8"), encoding="utf-8")
    assert manager.change("configure", "activate")
    assert manager.change("deactivate", "cleanup")
    assert manager.entities == bare
    for topic in OUTPUTS:
        assert observer.count_publishers(f"/observer/{topic}") == 0
