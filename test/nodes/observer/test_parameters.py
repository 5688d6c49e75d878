# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's parameters: refused with a reason, or taken over all at once."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from observer.bench import SHIPPED
from rclpy.parameter import Parameter

from tsobs_ros.errors import CertificateError, DesignFileError, ParameterError, TsobsError
from tsobs_ros.nodes.observer import create


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("rate", 100.0, "read-only"),
        ("design", "other.yaml", "read-only"),
        ("joints", ["elbow"], "read-only"),
        ("when_stale", "loud", "must be one of"),
        ("gain_mode", "riccati", "read-only"),
        ("history", 1.0, "read-only"),
        ("coast_after", 0.0, "at least"),
        ("coast_after", 10.0, "coast_after: expected at most stale_after"),
        ("coast_after", "soon", "expected a number"),
        ("coast_after", float("nan"), "finite"),
        ("fault.warn", -0.1, "at least"),
        ("fault.warn", 0.6, "disturbance error level: expected at least"),
    ],
)
def test_senseless_or_structural_changes_are_refused_with_a_reason(
    ros: Any, name: str, value: Any, reason: str
) -> None:
    node = ros.add(create(context=ros.context))
    before = node.get_parameter(name).value
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert reason in result.reason
    assert node.get_parameter(name).value == before


def test_integers_are_taken_for_doubles_at_start_and_later(ros: Any) -> None:
    overrides = [Parameter("rate", value=100), Parameter("fault.error", value=1)]
    node = ros.add(create(context=ros.context, parameter_overrides=overrides))
    assert node.get_parameter("rate").value == 100.0
    (result,) = node.set_parameters([Parameter("fault.hold", value=2)])
    assert result.successful
    value = node.get_parameter("fault.hold").value
    assert (value, type(value)) == (2.0, float)


@pytest.mark.parametrize(
    ("overrides", "reason"),
    [
        ({"rate": 0.0}, "rate"),
        ({"rate": "fast"}, "rate"),
        ({"joints": [""]}, "joints: expected names"),
        ({"joints": []}, "joints: expected names"),
        ({"joints": ["hip", "knee", "hip"]}, "joints: expected each name once"),
        ({"joints": ["hip", "knee"], "joint_designs": [""]}, "one for each of the 2 joints"),
        ({"gain_mode": "certain"}, "gain_mode"),
        ({"fault.warn": 0.6}, "disturbance error level"),
        ({"coast_after": 6.0}, "coast_after"),
    ],
)
def test_senseless_overrides_are_refused(ros: Any, overrides: dict[str, Any], reason: str) -> None:
    parameters = [Parameter(name, value=value) for name, value in overrides.items()]
    with pytest.raises(ParameterError, match=reason):
        create(context=ros.context, parameter_overrides=parameters)


def tampered(path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    data = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
    change(data)
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def triple_the_gain(data: dict[str, Any]) -> None:
    data["gain"]["K"] = [3.0 * value for value in data["gain"]["K"]]


def drop_the_gain(data: dict[str, Any]) -> None:
    del data["gain"]


@pytest.mark.parametrize(
    ("make", "error", "named"),
    [
        (lambda path: path, DesignFileError, ["no such design file"]),
        (lambda path: tampered(path, drop_the_gain), DesignFileError, ["gain"]),
        (
            lambda path: tampered(path, triple_the_gain),
            CertificateError,
            ["covariance decrease", "slopes (1, 1)", "DOES NOT HOLD"],
        ),
    ],
    ids=["missing", "malformed", "certificate does not hold"],
)
def test_a_design_that_is_none_is_refused_by_name(
    ros: Any, tmp_path: Path, make: Any, error: type[TsobsError], named: Sequence[str]
) -> None:
    path = make(tmp_path / "my.design.yaml")
    with pytest.raises(error) as caught:
        create(context=ros.context, parameter_overrides=[Parameter("design", value=str(path))])
    assert type(caught.value) is error
    for text in [str(path), *named]:
        assert text in str(caught.value)
    # It has left nothing behind: the next one starts.
    assert ros.add(create(context=ros.context)).tracker.used == 0


@pytest.mark.parametrize("overrides", [{"joint": "elbow"}, {"fault.level": 1.0}])
def test_parameters_that_there_are_not_are_named(
    ros: Any, overrides: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    parameters = [Parameter(name, value=value) for name, value in overrides.items()]
    ros.add(create(context=ros.context, parameter_overrides=parameters))
    (name,) = overrides
    assert f"ignored unknown parameters: '{name}'" in capfd.readouterr().err


def test_a_request_with_one_bad_value_changes_nothing(ros: Any) -> None:
    node = ros.add(create(context=ros.context))
    wanted = {"supervision.gate": 4.0, "fault.hold": 1.0, "coast_after": -1.0}
    parameters = [Parameter(name, value=value) for name, value in wanted.items()]
    before = {name: node.get_parameter(name).value for name in wanted}
    limits, options = node.joints[0].faults.limits, node.tracker.estimator.options
    assert not node.set_parameters_atomically(parameters).successful
    assert {name: node.get_parameter(name).value for name in wanted} == before
    assert node.joints[0].faults.limits == limits

    assert node.set_parameters_atomically(parameters[:2]).successful
    assert node.joints[0].faults.limits.hold == 1.0
    assert node.tracker.estimator.options.gate == 4.0
    assert options.gate == 5.0


def test_every_joint_is_retuned(ros: Any, tmp_path: Path) -> None:
    own = tmp_path / "own.design.yaml"
    own.write_text(SHIPPED.read_text(encoding="utf-8"), encoding="utf-8")
    overrides = [
        Parameter("joints", value=["hip", "knee"]),
        Parameter("joint_designs", value=[str(own), ""]),
    ]
    node = ros.add(create(context=ros.context, parameter_overrides=overrides))
    (result,) = node.set_parameters([Parameter("supervision.lost", value=7.0)])
    assert result.successful
    assert [joint.loaded.path for joint in node.joints] == [own, SHIPPED]
    assert [joint.tracker.estimator.options.lost for joint in node.joints] == [7.0, 7.0]
