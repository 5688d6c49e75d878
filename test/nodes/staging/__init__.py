# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Nodes of the package in a test's graph; an arm, bad input for its observer, and a stage."""

from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.srv import GetState
from rclpy.parameter import Parameter
from rclpy.time import Time

from tsobs_ros.bag import BagReader
from tsobs_ros.design.record import Design
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.replay.estimate import Observer, Run, run_observers
from tsobs_ros.replay.source import BagSource


def to_nanoseconds(stamp: Any) -> int:
    """Return a builtin_interfaces Time as nanoseconds."""
    return int(Time.from_msg(stamp).nanoseconds)


def to_stamp(nanoseconds: int) -> Any:
    """Return nanoseconds since the epoch as a builtin_interfaces Time."""
    return Time(nanoseconds=nanoseconds).to_msg()


def start(ros: Any, name: str, *, options: dict[str, Any] | None = None, **parameters: Any) -> Any:
    """Start a node of the package in a test's graph.

    Args:
        ros: The graph.
        name: Name of the node.
        options: Of `rclpy.node.Node`.
        **parameters: With two underscores for each dot.
    """
    overrides = [Parameter(k.replace("__", "."), value=v) for k, v in parameters.items()]
    create = import_module(f"tsobs_ros.nodes.{name}").create
    return ros.add(create(context=ros.context, parameter_overrides=overrides, **(options or {})))


def call(ros: Any, node: Any, kind: Any, name: str, request: Any = None) -> Any:
    """Call a service by a client of a node in a test's graph, and return its answer."""
    client = node.create_client(kind, name)
    ros.spin_until(client.service_is_ready, 30.0, f"the service {name}")
    future = client.call_async(request or kind.Request())
    # A client knows its service before that knows the client, and an answer that comes in
    # between is lost for good; to ask for the state again does no harm.
    if kind is GetState:
        with suppress(AssertionError):
            ros.spin_until(future.done, 3.0)
        if not future.done():
            future = client.call_async(request or kind.Request())
    ros.spin_until(future.done, 30.0, f"the answer of {name}")
    node.destroy_client(client)
    return future.result()


def diagnostics(ros: Any) -> dict[str, DiagnosticStatus]:
    """Return the newest statuses by their names, kept up to date as the graph spins."""
    found: dict[str, DiagnosticStatus] = {}
    ros.node("diagnostics").create_subscription(
        DiagnosticArray,
        "/diagnostics",
        lambda array: found.update({each.name: each for each in array.status}),
        10,
    )
    return found


def values(status: DiagnosticStatus) -> dict[str, str]:
    """Return the values of a status by their keys."""
    return {item.key: item.value for item in status.values}


def estimated_again(bag: Path, output: Path, design: Design, **settings: Any) -> Run:
    """Run a design over a bag as `tsobs estimate` does, and write a bag of that."""
    source = BagSource(bag)
    designs = (design,) * len(source.joints)
    observer = Observer("observer", ObserverSettings(**settings), designs)
    (run,) = run_observers(source, [observer], output, window=2**31)
    return run


def by_topic(bag: Path) -> dict[str, list[bytes]]:
    """Return the messages of a bag by topic, each in the order of publishing."""
    found: dict[str, list[bytes]] = {}
    for message in sorted(BagReader(bag).messages(), key=lambda each: each.publish_time):
        found.setdefault(message.topic, []).append(message.data)
    return found
