# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is shipped for RViz and `ros2 launch` names what there is; test_demo.py has the layouts."""

import re
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml
from builtin_interfaces.msg import Time

from tsobs_ros.cli.demo import MARKERS
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.visualizer import Angles, Arm, VisualizerParameters, scene

ROOT = Path(__file__).resolve().parents[1]
LAUNCH = ElementTree.parse(ROOT / "launch" / "demo.launch.xml").getroot()
RVIZ = yaml.safe_load((ROOT / "views" / "demo.rviz").read_text(encoding="utf-8"))
DEFAULTS = VisualizerParameters()


def markers(angles: Angles) -> dict[tuple[str, int], Any]:
    """Return all markers that there are of an arm, by namespace and number."""
    arm = Arm("elastic_joint", angles, angles, Angles(0.1, 0.1))
    return {(each.ns, each.id): each for each in scene([arm], DEFAULTS, Time()).markers}


def test_the_launch_file_starts_nodes_with_parameters_they_have(ros: Any) -> None:
    declared = {arg.attrib["name"] for arg in LAUNCH.iter("arg")}
    declared |= {let.attrib["name"] for let in LAUNCH.iter("let")}
    text = ElementTree.tostring(LAUNCH, encoding="unicode")
    assert set(re.findall(r"\$\(var (\w+)\)", text)) == declared
    for path in re.findall(r"\$\(find-pkg-share tsobs_ros\)/([\w./]+)", text):
        assert (ROOT / path).is_file()

    started = [node for node in LAUNCH.iter("node") if node.attrib["pkg"] == "tsobs_ros"]
    assert len(started) == 4
    for node in started:
        name = node.attrib["exec"]
        made = ManagedNode(
            name, import_module(f"tsobs_ros.nodes.{name}").Parameters, context=ros.context
        )
        parameters = {each.attrib["name"] for each in node.iter("param") if "name" in each.attrib}
        assert all(made.has_parameter(each) for each in parameters), parameters
        made.destroy_node()


def test_the_rviz_setup_shows_the_markers_in_their_frame() -> None:
    manager = RVIZ["Visualization Manager"]
    arm, *_ = manager["Displays"]

    assert manager["Global Options"]["Fixed Frame"] == DEFAULTS.frame_id
    assert arm["Topic"]["Value"] == MARKERS
    assert set(arm["Namespaces"]) == {namespace for namespace, _ in markers(Angles(0.0, 0.0))}
