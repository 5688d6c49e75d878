# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy allows each node what it has when everything is on, and nothing else."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter

from tsobs_ros.bag.estimate_topics import TORQUE_TOPICS
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.cli.demo import ADAPTIVE_TOPICS, MARKERS, RECORDED_TOPICS
from tsobs_ros.nodes import observer, plant_simulator, player, recorder, visualizer
from tsobs_ros.resources import config_path

POLICY = config_path("sros2_policy.xml")
EVERYTHING = [
    *RECORDED_TOPICS,
    *ADAPTIVE_TOPICS,
    *(f"/observer/{name}" for name in TORQUE_TOPICS),
    "/ground_truth/torque_disturbance",
]
TYPES = {
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/observer/design": "std_msgs/msg/String",
    "/observer/ticks": "std_msgs/msg/Int64MultiArray",
    MARKERS: "visualization_msgs/msg/MarkerArray",
}
# How the policy calls what a node does, and what an entry of that kind is called.
KINDS = {"publish": "topic", "subscribe": "topic", "reply": "service", "request": "service"}

Rights = set[tuple[str, str]]


def allowed(node: str) -> Rights:
    """Return what the policy allows a node: pairs of what it does and the full name."""
    root = ElementTree.parse(POLICY).getroot()
    (profile,) = root.findall(
        f"./contexts/context[@path='/tsobs_ros/{node}']/profiles/profile[@ns='/'][@node='{node}']"
    )
    return {
        (kind, str(entry.text).replace("~", f"/{node}"))
        for part in profile
        for kind, element in KINDS.items()
        if part.get(kind) == "ALLOW"
        for entry in part.findall(element)
    }


def actual(node: Any) -> Rights:
    """Return what a node has."""
    queries = {
        "publish": node.get_publisher_names_and_types_by_node,
        "subscribe": node.get_subscriber_names_and_types_by_node,
        "reply": node.get_service_names_and_types_by_node,
        "request": node.get_client_names_and_types_by_node,
    }
    own = node.get_name(), node.get_namespace()
    return {(kind, name) for kind, query in queries.items() for name, _ in query(*own)}


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag of all topics of the package."""
    nothing = b"\x00\x01\x00\x00" + bytes(28)
    with BagWriter(tmp_path / "bag") as writer:
        for topic in EVERYTHING:
            writer.add_topic(topic, TYPES.get(topic, "sensor_msgs/msg/JointState"))
            writer.write(topic, nothing, 1, 1)
    return tmp_path / "bag"


def test_each_node_is_allowed_what_it_has_and_nothing_else(
    ros: Any, bag: Path, tmp_path: Path, both_design: Path
) -> None:
    # Simulated time for all but the player, which makes it, and whatever else adds names.
    configurations: dict[Any, dict[str, Any]] = {
        plant_simulator: {"publish_clock": True, "use_sim_time": True},
        observer: {"design": str(both_design), "use_sim_time": True},
        recorder: {
            "output": str(tmp_path / "recorded"),
            "topics": EVERYTHING,
            "snapshot_mode": True,
            "use_sim_time": True,
        },
        player: {"bag": str(bag), "clock": 40.0, "start_paused": True},
        visualizer: {"use_sim_time": True},
    }
    nodes = [
        ros.add(
            module.create(
                context=ros.context,
                parameter_overrides=[
                    Parameter(name, value=value) for name, value in values.items()
                ],
            )
        )
        for module, values in configurations.items()
    ]
    subscribed = {name for kind, name in allowed("recorder") if kind == "subscribe"} - {"/clock"}

    ros.spin_until(lambda: {n for _, n in actual(nodes[2])} >= subscribed, what="the recording")

    for node in nodes:
        assert actual(node) == allowed(node.get_name())
