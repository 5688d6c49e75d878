# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The places of a design's signals in messages."""

import pytest

from tsobs_ros.design.file import load_request
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TorqueDisturbance
from tsobs_ros.design.signals import Place, signals
from tsobs_ros.resources import config_path


@pytest.mark.parametrize(
    ("measured", "places"),
    [
        (["motor_angle"], [("elbow", "position")]),
        (["motor_velocity", "motor_angle"], [("elbow", "velocity"), ("elbow", "position")]),
        (["motor_angle", "link_angle"], [("elbow_motor", "position"), ("elbow", "position")]),
    ],
)
def test_outputs_of_one_side_are_the_joints_and_of_both_sides_the_motor_has_its_own_entry(
    measured: list[str], places: list[tuple[str, str]]
) -> None:
    request = ArmRequest(outputs=[Output(each, 1e-3) for each in measured])

    found = signals(request, "elbow", alone=True)

    assert list(found.outputs) == places
    assert found.inputs == (Place("elbow", "effort"),)
    both = any(name == "elbow_motor" for name, _ in places)
    assert found.other_inputs == ((Place("elbow_motor", "effort"),) if both else ())
    assert found.entries == {"elbow", "elbow_motor"} if both else {"elbow"}
    several = len(measured) > 1
    assert list(found.disturbances) == ([f"elbow/{m}" for m in measured] if several else ["elbow"])
    assert found.states[0].described == "position of elbow_link"


def test_torque_disturbances_are_efforts_of_their_sides() -> None:
    wave = (DisturbanceTerm("gauss_markov", {"std": 1.0, "time_constant": 1.0}),)
    for torque, names in (
        (TorqueDisturbance(link=wave), ["elbow_link"]),
        (TorqueDisturbance(link=wave, motor=wave), ["elbow_motor", "elbow_link"]),
    ):
        found = signals(ArmRequest(torque_disturbance=torque), "elbow", alone=True)
        assert found.torques == tuple(Place(name, "effort") for name in names)


@pytest.mark.parametrize(("alone", "prefix"), [(True, ""), (False, "tank/")])
def test_signals_of_a_system_are_entries_with_a_position(alone: bool, prefix: str) -> None:
    request = load_request(config_path("ts_example.request.yaml"))

    places = signals(request, "tank", alone)

    names = tuple(prefix + name for name in request.output_names)
    assert places.outputs == tuple(Place(name, "position") for name in names)
    assert (places.disturbances, places.units) == (names, request.output_units)
    assert len(places.inputs) == request.flow.input_count
