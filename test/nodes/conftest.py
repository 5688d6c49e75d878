# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A lifecycle manager: `manage(node)` drives a managed node of the test's graph by its services.

`manage("/name")` drives one in a process of its own.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from staging import call
from staging.stage import Stage

from tsobs_ros.design.file import save_design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TorqueDisturbance
from tsobs_ros.design.synthesis import synthesise


class Manager:
    """Drives a node by its lifecycle services, and counts what the node owns.

    Args:
        ros: The test's graph.
        node: The managed node, or its full name.
    """

    def __init__(self, ros: Any, node: Any) -> None:
        self._ros = ros
        self.node = node
        self._name = node if isinstance(node, str) else node.get_fully_qualified_name()
        self.own = ros.node("manager")

    def call(self, srv_type: type, service: str, request: Any = None) -> Any:
        """Call a service of the node."""
        return call(self._ros, self.own, srv_type, f"{self._name}/{service}", request)

    def change(self, *labels: str) -> bool:
        """Ask for transitions one after the other until one fails; say whether none did."""
        asked = (ChangeState.Request(transition=Transition(label=each)) for each in labels)
        return all(self.call(ChangeState, "change_state", each).success for each in asked)

    @property
    def state(self) -> str:
        """The node's state."""
        return str(self.call(GetState, "get_state").current_state.label)

    @property
    def entities(self) -> tuple[int, ...]:
        """How much of each kind the node owns, and with it executors look through."""
        node = self.node
        kinds = (node.publishers, node.subscriptions, node.services, node.clients, node.timers,
                 node.waitables, node.guards)  # fmt: skip
        return tuple(len(list(kind)) for kind in kinds)


@pytest.fixture
def manage(ros: Any) -> Callable[[Any], Manager]:
    """Give what drives a node of the test's graph."""
    return lambda node: Manager(ros, node)


@pytest.fixture(scope="session")
def both_design(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A design for encoders on both sides of an arm, the link's with a bias, and a contact."""
    request = ArmRequest(
        outputs=[
            Output("link_angle", 1e-3, (DisturbanceTerm("bias"),)),
            Output("motor_angle", 1e-3),
        ],
        torque_disturbance=TorqueDisturbance(
            link=[DisturbanceTerm("gauss_markov", {"std": 2.0, "time_constant": 1.0})]
        ),
        rate=50.0,
        uncertainty={"stiffness": 0.2},
    )
    path = tmp_path_factory.mktemp("designs") / "both.design.yaml"
    save_design(synthesise(request), path)
    return path


@pytest.fixture
def stage(ros: Any) -> Stage:
    """Observers, a sensor and the time, of which the test decides."""
    return Stage(ros)
