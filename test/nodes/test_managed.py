# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Managed nodes obey a lifecycle manager in any order, and leave nothing behind."""

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from staging import start
from std_msgs.msg import String
from std_srvs.srv import Trigger

from tsobs_ros.bag import BagWriter
from tsobs_ros.errors import NodeError
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.parameters import ManagedParameters

POSSIBLE = {
    ("unconfigured", "configure"): ("inactive", ["configure"]),
    ("inactive", "activate"): ("active", ["activate"]),
    ("active", "deactivate"): ("inactive", ["deactivate"]),
    ("inactive", "cleanup"): ("unconfigured", ["cleanup", "release"]),
}
WAY_TO = {"unconfigured": [], "inactive": ["configure"], "active": ["configure", "activate"]}


class Probe(ManagedNode[ManagedParameters]):
    """Notes what is called, and fails where it is told to."""

    def __init__(self, fails: dict[str, Exception], **node_kwargs: Any) -> None:
        self.fails = fails
        self.calls: list[str] = []
        super().__init__("probe", ManagedParameters, **node_kwargs)

    def start(self) -> None:
        self.create_publisher(String, "~/lasting", 10)
        super().start()

    def _note(self, call: str) -> None:
        self.calls.append(call)
        if call in self.fails:
            raise self.fails[call]

    def configure(self) -> None:
        self.create_publisher(String, "~/news", 10)
        self.create_subscription(String, "question", print, 10)
        self.create_service(Trigger, "~/reset", lambda request, response: response)
        self.create_client(Trigger, "elsewhere")
        self.create_timer(0.01, lambda: self.calls.append("tick") if self.active else None)
        self.at_cleanup(self._note, "release")
        self._note("configure")
        self.at_cleanup(self._note, "cleanup")

    def activate(self) -> None:
        assert not self.active
        self._note("activate")

    def deactivate(self) -> None:
        assert not self.active
        self._note("deactivate")


@pytest.fixture
def probe(ros: Any, manage: Callable[[Any], Any]) -> Callable[..., Any]:
    """Start a probe with faults, and bring it into a state by itself or by a manager."""

    def start_probe(state: str = "", autostart: bool = False, **fails: Exception) -> Any:
        overrides = [Parameter("autostart", value=autostart)]
        node = Probe(fails, context=ros.context, parameter_overrides=overrides)
        manager = manage(ros.add(node))
        manager.bare = manager.entities
        manager.change(*WAY_TO.get(state, []))
        return manager

    return start_probe


def test_requests_in_any_order_do_what_the_state_allows_and_are_refused_otherwise(
    probe: Any,
) -> None:
    manager = probe()
    node, chance = manager.node, random.Random(5)
    state, counts = "unconfigured", {False: manager.bare}
    for _ in range(25):
        asked = chance.choice(["configure", "cleanup", "activate", "deactivate"])
        allowed = (state, asked) in POSSIBLE
        state, calls = POSSIBLE.get((state, asked), (state, []))
        node.calls.clear()
        assert manager.change(asked) == allowed
        assert [call for call in node.calls if call != "tick"] == calls
        assert manager.state == state
        assert (node.configured, node.active) == (state != "unconfigured", state == "active")
        assert counts.setdefault(node.configured, manager.entities) == manager.entities
    assert counts[True] > counts[False]


@pytest.mark.parametrize("state", WAY_TO)
def test_it_ends_in_every_state_and_twice(ros: Any, probe: Any, state: str) -> None:
    manager = probe(state)
    node = manager.node
    node.calls.clear()
    assert not node.finished
    assert manager.change("shutdown")
    assert manager.state == "finalized"
    assert not manager.change("configure")
    ros.spin_until(lambda: node.finished, what="the end")
    node.close()
    expected = {"unconfigured": [], "inactive": ["cleanup", "release"]}
    calls = [call for call in node.calls if call != "tick"]
    assert calls == expected.get(state, ["deactivate", "cleanup", "release"])
    assert (node.configured, node.active, manager.entities) == (False, False, manager.bare)


FULL, BUG = NodeError("the disk is full"), ZeroDivisionError("a bug")


@pytest.mark.parametrize(
    ("state", "asked", "error", "end"),
    [
        ("unconfigured", "configure", FULL, "unconfigured"),
        ("inactive", "activate", FULL, "inactive"),
        ("active", "deactivate", FULL, "active"),
        ("inactive", "cleanup", FULL, "unconfigured"),
        ("active", "deactivate", BUG, "unconfigured"),
    ],
)
def test_a_transition_that_fails_says_why_and_the_node_goes_on(
    probe: Any, capfd: Any, state: str, asked: str, error: Exception, end: str
) -> None:
    manager = probe(state)
    node = manager.node
    node.fails[asked] = error
    assert not manager.change(asked)
    assert manager.state == end
    assert (node.configured, node.active) == (end in ("inactive", "active"), end == "active")
    assert node.configured or manager.entities == manager.bare
    log = capfd.readouterr().err
    assert str(error) in log
    assert ("Traceback" in log) == (error is BUG)

    node.fails.clear()
    assert manager.change(*WAY_TO["active"][list(WAY_TO).index(end) :] or ["deactivate"])


@pytest.mark.parametrize(
    "name", ["observer", "plant_simulator", "recorder", "player", "visualizer"]
)
def test_no_transition_time_or_parameter_harms_a_node(
    ros: Any,
    manage: Callable[[Any], Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: Any,
    name: str,
) -> None:
    monkeypatch.chdir(tmp_path)  # bags get dated names in there
    BagWriter("played").close()
    given = {"bag": "played"} if name == "player" else {}
    manager = manage(start(ros, name, autostart=False, use_sim_time=True, **given))
    bare, chance = manager.entities, random.Random(7)
    for _ in range(2):
        assert manager.change("configure", "activate", "deactivate", "activate")
        assert manager.change("deactivate", "cleanup")
        assert manager.entities == bare
    assert manager.change("configure", "activate")
    check_times(ros, manager, chance, capfd)
    check_parameters(manager, chance, capfd)
    assert manager.state == "active"


def check_times(ros: Any, manager: Any, chance: random.Random, capfd: Any) -> None:
    """Publish times that there are not; they are refused with a warning."""
    clock, log = manager.own.create_publisher(Clock, "/clock", 1), ""
    ros.spin_until(clock.get_subscription_count, what="the node's subscription")

    def show(sec: int, nanosec: int) -> float:
        message = Clock()
        message.clock.sec, message.clock.nanosec = sec, nanosec
        clock.publish(message)
        return float(manager.node.get_clock().now().nanoseconds * 1e-9)

    def is_refused() -> bool:
        nonlocal log
        assert show(-1, 0) == 5.0
        log += capfd.readouterr().err
        return "got -1 s and 0 ns; time stands still" in log

    ros.spin_until(lambda: show(5, 0) == 5.0, what="a good time")
    ros.spin_until(is_refused, what="the warning")
    for _ in range(10):
        sec = chance.choice([-(2**31), 2**31 - 1, 0, chance.randrange(-(2**31), 2**31)])
        show(sec, chance.choice([0, 2**32 - 1, chance.randrange(2**32)]))
        ros.spin_for(0.01)
    ros.spin_until(lambda: show(7, 0) == 7.0, what="the good time after bad ones")


def check_parameters(manager: Any, chance: random.Random, capfd: Any) -> None:
    """Set parameters that there are not, of any type; each gets an answer."""

    def ask(parameters: list[ParameterMessage]) -> list[Any]:
        request = SetParameters.Request(parameters=parameters)
        return list(manager.call(SetParameters, "set_parameters", request).results)

    good = ParameterMessage(
        name="use_sim_time", value=Parameter("", value=True).get_parameter_value()
    )
    unknown = ParameterMessage(name="autostart", value=ParameterValue(type=77))
    accepted, refused = ask([good, unknown])
    assert accepted.successful
    assert not refused.successful
    assert "77 is not a valid" in refused.reason
    assert "cannot answer SetParameters_Request: 77 is not a valid" in capfd.readouterr().err
    (refused,) = ask([ParameterMessage(name="nobody's", value=good.value)])
    assert refused.reason.endswith(": nobody's")
    for name in [*manager.node.list_parameters([], 0).names, "", "nobody's", "x\x1b[2Jy"]:
        value = ParameterValue(
            type=chance.choice([*range(12), 255]),
            double_value=chance.choice([float("nan"), float("inf"), 1e300]),
            integer_value=chance.choice([0, -(2**63), 2**63 - 1]),
            string_value=chance.choice(["", "x\x1b[2J", "[1, 2.0]"]),
            double_array_value=[0.5, float("nan")],
            string_array_value=["", "\x1b"],
        )
        assert len(ask([ParameterMessage(name=name, value=value)])) == 1
