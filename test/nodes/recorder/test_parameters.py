# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The shipped parameters are the node's, and senseless ones are refused."""

import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from tsobs_ros.errors import ParameterError
from tsobs_ros.nodes.recorder.parameters import RecorderParameters

ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "config" / "recorder.yaml"


def shipped() -> RecorderParameters:
    values = yaml.safe_load(CONFIG.read_text())["/**"]["ros__parameters"]
    return RecorderParameters(
        **{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    )


def test_the_shipped_file_has_every_parameter_and_its_default_but_for_the_selection() -> None:
    names = yaml.safe_load(CONFIG.read_text())["/**"]["ros__parameters"].keys()
    assert names == {field.name for field in fields(RecorderParameters)}
    assert replace(shipped(), topics=(), regex="") == RecorderParameters()


def test_the_shipped_file_selects_what_the_readme_lists_and_awaits_what_always_comes() -> None:
    rows = re.findall(r"^\| (`.+?) \|", (ROOT / "README.md").read_text(), re.MULTILINE)
    topics = [
        f"/arm/{n}".replace("/arm//", "/") for row in rows for n in re.findall("`(.+?)`", row)
    ]
    assert {"/arm/observer/disturbance_bound", "/diagnostics"} <= set(topics)
    selection = shipped().resolved(lambda name: f"/arm/{name}".replace("/arm//", "/"), str)
    assert [topic for topic in topics if not selection.wants(topic, [])] == []
    assert not selection.wants("/arm/camera", [])
    assert "/arm/observer/parameters_estimate" not in selection.listed()


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"regex": "*joints"}, r"parameter 'regex': not a regular expression .*'\*joints'"),
        ({"exclude_regex": "("}, "parameter 'exclude_regex': not a regular expression"),
        ({"compression": "zip"}, "compression"),
        ({"max_bag_size": -1}, "max_bag_size"),
        ({"max_bag_duration": -1.0}, "max_bag_duration"),
        ({"snapshot_size": 0}, "snapshot_size"),
        ({"snapshot_duration": 0.0}, "snapshot_duration"),
        ({"repeat_latched": -1}, "repeat_latched"),
        ({"queue_depth": 5001}, "parameter 'queue_depth' must be at most 5000"),
    ],
)
def test_senseless_parameters_are_refused(
    recording, tmp_path: Path, parameters: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ParameterError, match=reason):
        recording.start(**parameters)
    assert not (tmp_path / "bag").exists()
