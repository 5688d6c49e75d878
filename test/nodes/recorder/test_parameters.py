# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The parameters select what is recorded; the shipped ones fit, and senseless ones are refused."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from tsobs_ros.errors import ParameterError
from tsobs_ros.nodes.recorder.parameters import RecorderParameters


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"regex": "*joints"}, r"parameter 'regex': not a regular expression .*'\*joints'"),
        ({"exclude_regex": "("}, "parameter 'exclude_regex': not a regular expression"),
        ({"compression": "zip"}, "compression"),
        ({"queue_depth": 5001}, "parameter 'queue_depth' must be at least 1 and at most 5000"),
    ],
)
def test_senseless_parameters_are_refused(
    recording, tmp_path: Path, parameters: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ParameterError, match=reason):
        recording.start(**parameters)
    assert not (tmp_path / "bag").exists()


# A robot's topics, with hidden ones and the events of two services and an action.
GRAPH: Mapping[str, str] = {
    "/arm/joints": "sensor_msgs/msg/JointState",
    "/arm/torque": "sensor_msgs/msg/JointState",
    "/camera/image": "sensor_msgs/msg/Image",
    "/arm/_raw": "std_msgs/msg/String",
    "/_internal/state": "std_msgs/msg/String",
    "/go/_action/feedback": "my_msgs/action/Go_FeedbackMessage",
    "/arm/reset/_service_event": "std_srvs/srv/Trigger_Event",
    "/camera/set/_service_event": "std_srvs/srv/SetBool_Event",
    "/odd/_service_event": "std_msgs/msg/String",
}
VISIBLE = {"/arm/joints", "/arm/torque", "/camera/image"}
HIDDEN = {"/arm/_raw", "/_internal/state", "/go/_action/feedback", "/odd/_service_event"}
EVENTS = {"/arm/reset/_service_event", "/camera/set/_service_event"}


def full(name: str) -> str:
    return name if name.startswith("/") else f"/arm/{name}"


def selected(**parameters: Any) -> set[str]:
    selection = RecorderParameters(**parameters).resolved(full, full)
    return {name for name, type in GRAPH.items() if selection.wants(name, [type])}


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({}, VISIBLE | EVENTS),
        ({"topics": ("*",)}, VISIBLE),
        ({"topics": ("*", "_raw")}, VISIBLE | {"/arm/_raw"}),
        ({"topics": ("joints", "/camera/image")}, {"/arm/joints", "/camera/image"}),
        ({"topics": ("_raw",)}, {"/arm/_raw"}),
        ({"services": ("reset",)}, {"/arm/reset/_service_event"}),
        ({"services": ("*",)}, EVENTS),
        ({"topics": ("/arm/reset/_service_event",)}, {"/arm/reset/_service_event"}),
        ({"regex": "^/arm"}, {"/arm/joints", "/arm/torque", "/arm/reset/_service_event"}),
        ({"regex": "_service"}, set()),
        ({"regex": "torque|set$", "topics": ("joints",)},
         {"/arm/joints", "/arm/torque"} | EVENTS),
        ({"include_hidden": True}, VISIBLE | HIDDEN | EVENTS),
        ({"include_hidden": True, "regex": "/_"}, HIDDEN),
        ({"exclude_topics": ("joints",)}, (VISIBLE | EVENTS) - {"/arm/joints"}),
        ({"exclude_services": ("reset",)}, (VISIBLE | EVENTS) - {"/arm/reset/_service_event"}),
        ({"exclude_regex": "^/camera"},
         {"/arm/joints", "/arm/torque", "/arm/reset/_service_event"}),
        ({"topics": ("joints", "torque"), "exclude_regex": "q"}, {"/arm/joints"}),
    ],
)  # fmt: skip
def test_what_is_selected_is_recorded(parameters: dict[str, Any], expected: set[str]) -> None:
    assert selected(**parameters) == expected
