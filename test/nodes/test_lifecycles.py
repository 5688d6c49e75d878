# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Each of the package's nodes goes through its lifecycle again and again without growing."""

import gc
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter

NODES = ["observer", "plant_simulator", "recorder", "player"]
CYCLES = 50
# Fast DDS keeps some 2 kB of every entity there has been; a leaked publisher is a hundred times it.
GROWTH_LIMIT_MIB = 1.5


def resident_mib() -> float:
    """Return the memory this process has in use."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20


@pytest.fixture(params=NODES)
def manager(
    request: Any,
    ros: Any,
    manage: Callable[[Any], Any],
    small_bag: Path,
    tmp_path: Path,
    monkeypatch: Any,
) -> Any:
    """Give a manager of each node, unconfigured; bags get dated names in the test's folder."""
    monkeypatch.chdir(tmp_path)
    module = import_module(f"tsobs_ros.nodes.{request.param}")
    overrides = [Parameter("autostart", value=False)]
    if request.param == "player":
        overrides.append(Parameter("bag", value=str(small_bag)))
    return manage(ros.add(module.create(context=ros.context, parameter_overrides=overrides)))


def test_fifty_lives_leave_nothing_behind(manager: Any, ros: Any) -> None:
    bare, graph = manager.entities, manager.graph
    counts = set()
    for cycle in range(CYCLES):
        assert manager.change("configure")
        assert manager.change("activate", "deactivate", "activate")
        counts.add(manager.entities[2])
        assert manager.change("deactivate", "cleanup")
        assert manager.entities == bare
        if cycle == CYCLES // 5:
            before = resident_mib()
    assert len(counts) == 1
    ros.spin_until(lambda: manager.graph == graph, what="the graph of an unconfigured node")
    assert resident_mib() - before < GROWTH_LIMIT_MIB


def test_what_the_state_does_not_allow_is_refused_and_harmless(ros: Any, manager: Any) -> None:
    assert not manager.change("activate")
    assert manager.change("configure")
    assert not manager.change("configure")
    assert not manager.change("deactivate")
    assert manager.change("activate")
    assert not manager.change("activate")
    assert not manager.change("cleanup")
    assert manager.state == "active"
    assert manager.change("shutdown")
    ros.spin_until(lambda: manager.node.finished, what="the end")
