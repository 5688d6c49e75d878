# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The places of a design's signals in messages."""

import pytest

from tsobs_ros.design.file import load_request
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.signals import Place, signals
from tsobs_ros.resources import config_path


def test_the_shipped_arm_has_its_signals_where_they_always_were() -> None:
    places = signals(ArmRequest(), "elbow", alone=False)

    assert places.outputs == (Place("elbow", "position"),)
    assert places.inputs == (Place("elbow", "effort"),)
    assert places.states == (
        Place("elbow_link", "position"),
        Place("elbow_link", "velocity"),
        Place("elbow_motor", "position"),
        Place("elbow_motor", "velocity"),
    )
    assert places.disturbances == ("elbow",)
    assert places.torques == ()
    assert places.other_inputs == ()
    assert places.units == ("rad",)
    assert places.entries == {"elbow"}


@pytest.mark.parametrize(("alone", "prefix"), [(True, ""), (False, "tank/")])
def test_signals_of_a_system_are_entries_with_a_position(alone: bool, prefix: str) -> None:
    request = load_request(config_path("ts_example.request.yaml"))

    places = signals(request, "tank", alone)

    for found, names in (
        (places.outputs, request.output_names),
        (places.inputs, request.input_names),
        (places.states, request.state_names),
    ):
        assert found == tuple(Place(prefix + name, "position") for name in names)
    assert len(places.inputs) == request.flow.input_count
    assert places.disturbances == tuple(prefix + name for name in request.output_names)
