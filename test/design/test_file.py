# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Request and design files: what is written is read back to the last bit, the rest is refused."""

import copy
import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tsobs_ros.design.file import load_design, load_request, parse_design, save_design
from tsobs_ros.design.record import Design, SolverReport
from tsobs_ros.design.request import (
    ArmRequest,
    DisturbanceTerm,
    Output,
    TorqueDisturbance,
    TorquePath,
    TSRequest,
)
from tsobs_ros.errors import CertificateError, DesignFileError, ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.resources import config_path

DATA = Path(__file__).parent / "data"
"""Files as they were written by version 0.1.0 before requests and designs had a schema."""

PROPERTY = settings(
    max_examples=12,
    # The file is written again by every example.
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
TONE = DisturbanceTerm("sinusoid", {"frequency": 1.1})
DRIFT = DisturbanceTerm("gauss_markov", {"std": 0.1, "time_constant": 1.0 / 3.0})
REQUESTS = [
    ArmRequest(rate=1e3 / 3.0, x_max=0.1 + 0.2, decay_rate=0.1, disturbance=[TONE, DRIFT]),
    ArmRequest(
        ElasticJointArm(0.1, 0.7, 1e3 / 7.0, 0.0, 0.1), torque=TorquePath(0.9, -0.1 / 3.0, 0.1)
    ),
    ArmRequest(
        outputs=[Output("motor_velocity", 1e-4), Output("link_angle", 0.1 / 3.0, [DRIFT])],
        torque_disturbance=TorqueDisturbance(link=[DRIFT], motor=[DisturbanceTerm("bias")]),
        torque_limit=50.0,
        torque_rate_limit=0.0,
        process_noise=ProcessNoise(1e-5, 0.0),
        initial_std=(0.1, 0.2, 0.3, 1.0 / 3.0),
    ),
    ArmRequest(torque=TorquePath(offset=1.0), outputs=[Output("link_angle", 1e-3, delay=0.02 / 3)]),
]
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
SOLVER = SolverReport("Clarabel", "0.1: é", "optimal", 12, 1.0 / 3.0, 1e-4)


@pytest.fixture(scope="module")
def pendulum_request() -> TSRequest:
    return load_request(config_path("ts_example.request.yaml"))


@st.composite
def designs(draw: st.DrawFn, requests: st.SearchStrategy[Any]) -> Design:
    """Designs with matrices of any finite numbers; their certificates are false."""
    request = draw(requests)
    p, n = request.flow.output_matrix.shape
    P = draw(hnp.arrays(np.float64, (n, n), elements=NUMBERS))
    K = draw(hnp.arrays(np.float64, (n, p), elements=NUMBERS))
    return Design(request, P, K, SOLVER)


@PROPERTY
@given(data=st.data())
@pytest.mark.parametrize("kind", ["arm", "system"])
def test_a_design_is_read_back_to_the_last_bit(
    kind: str, data: st.DataObject, pendulum_request: TSRequest, tmp_path: Path
) -> None:
    requests = st.sampled_from(REQUESTS) if kind == "arm" else st.just(pendulum_request)
    design, path = data.draw(designs(requests)), tmp_path / "a.design.yaml"
    save_design(design, str(path))
    again = parse_design(str(path))
    assert again.P.tobytes() == design.P.tobytes()
    assert again.K.tobytes() == design.K.tobytes()
    assert again.solver == design.solver
    if kind == "arm":
        assert again.request == design.request
    save_design(again, tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text() == path.read_text()


@pytest.mark.parametrize("name", ["arm", "adaptive_arm", "system"])
def test_a_file_of_the_first_format_is_what_saving_its_design_writes(
    name: str, tmp_path: Path
) -> None:
    old, path = DATA / f"{name}.design.yaml", tmp_path / "again.yaml"
    design = load_design(old)
    save_design(design, path)
    assert path.read_bytes() == old.read_bytes()
    shipped = {"arm": "elastic_joint_fixed", "adaptive_arm": "elastic_joint"}.get(name)
    assert not shipped or config_path(f"{shipped}.design.yaml").read_bytes() == old.read_bytes()
    assert load_design(path).certificate == design.certificate
    assert [entry.name for entry in tmp_path.iterdir()] == ["again.yaml"]


def test_names_and_units_are_read_back_and_stand_in_reports(tmp_path: Path) -> None:
    """Signals that a file leaves out are numbered; a scheduled signal may be an output."""
    data = yaml_of("system.request.yaml")
    data = changed(data, ("names",), {"states": ["tilt", "speed"], "scheduled": ["y2"]})
    units = {"states": ["rad", "rad/s"], "outputs": ["V", ""], "inputs": ["N m"]}
    data = changed(data, ("units",), {**units, "scheduled": ["rad/s"]})
    premises = {"angle": {"state": [1, 0]}, "load": {"scheduled": [1]}}
    request = load_request(written(tmp_path, changed(data, ("system", "premises"), premises)))
    np.testing.assert_array_equal(request.model.premise, [[1.0, 0.0], [0.0, 0.0]])
    np.testing.assert_array_equal(request.model.schedule, [[0.0], [1.0]])
    assert request.state_names == ("tilt", "speed")
    assert (request.output_names, request.output_units) == (("y1", "y2"), ("V", ""))
    assert (request.input_names, request.input_units) == (("u1", "y2"), ("N m", "rad/s"))

    design = Design(request, np.eye(3), np.zeros((3, 2)), SolverReport())
    save_design(design, tmp_path / "a.yaml")
    again = parse_design(tmp_path / "a.yaml")
    assert (again.request.names, again.request.units) == (request.names, request.units)
    assert "outputs (y1 [V], y2), inputs u1 [N m], y2 [rad/s]" in again.text()


@cache
def yaml_of(name: str) -> dict[str, Any]:
    """Return a file as plain data; tests change copies of it."""
    data: dict[str, Any] = yaml.safe_load((DATA / name).read_text(encoding="utf-8"))
    return data


def written(folder: Path, data: Any) -> Path:
    path = folder / "my.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data), encoding="utf-8")
    return path


def changed(data: dict[str, Any], place: tuple[Any, ...], value: Any) -> dict[str, Any]:
    """Return a copy with the entry at `place` set, or removed if the value is `...`."""
    result = copy.deepcopy(data)
    entry: Any = result
    for key in place[:-1]:
        entry = entry[key]
    if value is ...:
        del entry[place[-1]]
    else:
        entry[place[-1]] = value
    return result


def test_a_request_may_stand_alone_and_leave_out_everything(tmp_path: Path) -> None:
    assert load_request(written(tmp_path, "design: {}")) == ArmRequest()
    assert load_request(str(written(tmp_path, "{disturbance: [{kind: bias}]}"))) == ArmRequest()
    # YAML 1.1 reads 1e-4 as text.
    path = written(
        tmp_path,
        "rate: 1e2\nprocess_noise: {link: 1e-4, motor: 1e-5}\nx_max: 1\n"
        "disturbance: [{kind: sinusoid, frequency: 3}]\nuncertainty: {stiffness: 2e-1}\n",
    )
    tone = DisturbanceTerm("sinusoid", {"frequency": 3})
    expected = ArmRequest(rate=100.0, x_max=1.0, disturbance=[tone], uncertainty={"stiffness": 0.2})
    assert load_request(path) == expected
    unlimited = load_request(written(tmp_path, "torque_limit: 1.0e+9\ntorque_rate_limit: 1.0e+9"))
    assert unlimited.torque_limits()[:2] == (math.inf, math.inf)


@pytest.mark.parametrize("name", ["arm", "system"])
def test_request_and_design_are_not_mistaken_for_each_other(name: str, tmp_path: Path) -> None:
    with pytest.raises(DesignFileError, match=r"format: expected a request, got a finished design"):
        load_request(DATA / f"{name}.design.yaml")
    with pytest.raises(DesignFileError, match=r"format: missing; .* `tsobs design` makes a design"):
        load_design(written(tmp_path, yaml_of(f"{name}.request.yaml")))


OUTPUTS, LINK = ("design", "outputs"), ("design", "torque_disturbance")
TORQUE = ("design", "torque")
OUTPUT = {"measures": "motor_angle", "measurement_std": 0.001}
ARM = [
    (OUTPUTS, [{**OUTPUT, "measures": "elbow"}], r"design.outputs\[0\]: expected one of link_an"),
    (OUTPUTS, [{**OUTPUT, "delay": 0.101}], r"outputs\[0\].delay: .* 20 periods, 0.1 s, got 0.101"),
    (TORQUE, {"gain": 0.0}, "design.torque.gain: expected a finite number above 0, got 0.0"),
    (TORQUE, {"delay": 2.0}, "torque.delay: .* 20 periods, 0.1 s, got 2.0 s"),
    (OUTPUTS, [], "design.outputs: expected at least one"),
    (LINK, {"link": [{"kind": "arbitrary"}]}, r"torque_disturbance.link\[0\]: expected a torque"),
    (("format",), ..., "format: expected 'tsobs_ros design' or 'tsobs_ros T-S design', got None"),
    (("version",), True, "version: expected 1, got True"),
    (("design", 3), 4, "design: expected names of entries, got 3"),
    (("design", "arm", "stiffness"), -3, "design.arm.stiffness: .* number above 0, got -3"),
    (("design", "initial_std"), [1.0], r"design.initial_std: expected shape \(4,\), got \(1,\)"),
    (("design", "disturbance", 0, "kind"), "wind", r"disturbance\[0\].kind: expected one of clean"),
    (("design", "certify_uncertainty"), 1, "design.certify_uncertainty: expected true or false"),
    (("gain", "K", 1), [1.0], r"gain.K\[1\]: expected shape \(\) as .*0\] has, got \(1,\)"),
    (("certificate", "P", 1, 2), math.inf, r"certificate.P\[1\]\[2\]: expected a finite number"),
    (("design", "arm"), {"link_inertia": 1e-200, "motor_inertia": 1e-200}, "must be finite"),
    (OUTPUTS, [{**OUTPUT, "measures": "link_angle"}], "disturbance: expected in outputs, one per"),
    (("design", "measurement_std"), None, "design.measurement_std: expected a value, got nothing"),
]
SYSTEM = [
    (("system", "rules"), ..., "system.rules: missing"),
    (("system", "rules"), [], "rules: expected at least one"),
    (("system", "premises", "angle"), {}, "system.premises.angle: expected at least one of state"),
    (("system", "rules", 0, "A"), [[1], [2]], r"rules\[0\].A: expected a square .* \(2, 1\)"),
    (("system", "rules", 0, "A"), -1, r"rules\[0\].A: expected a matrix, as \[\[1.0\]\], got -1.0"),
    (("system", "rules", 0, "B"), [1, 2], r"system.rules\[0\].B: expected a matrix, as .* got arr"),
    (("system", "C"), 1, "system.C: expected a matrix, as .* got 1.0"),
    (("D_s",), [[1]], r"D_s: expected shape \(2, 2\), got \(1, 1\)"),
    (("system", "rules", 1, "A"), [[1], [2]], r"system.rules\[1\].A: expected shape \(2, 2\), got"),
    (
        ("system", "rules", 0, "if"),
        {"speed": {"shape": "always"}},
        r"\[0\].if: expected some of angle, got 'speed'",
    ),
    (("names",), {"states": ["a", "b/c"]}, r"names.states\[1\]: expected a letter, .* got 'b/c'"),
    (("names",), {"outputs": ["e", "Time"]}, "names: expected none of a log's .* got 'Time'"),
    (("names",), {"outputs": ["e", "u1"]}, "names of outputs and inputs: .* 'u1' twice"),
    (("units",), {"states": ["m", "m"], "inputs": ["N"]}, "units.outputs: expected 2, .* got 0"),
    (("uncertainty", "gravity", "E"), [[0]], r"uncertainty.gravity.E: expected shape \(2, 2\), go"),
]


@pytest.mark.parametrize(
    ("kind", "place", "value", "message"),
    [("arm", *case) for case in ARM] + [("system", *case) for case in SYSTEM],
)
def test_a_wrong_entry_is_named_with_the_file(
    kind: str, place: tuple[Any, ...], value: Any, message: str, tmp_path: Path
) -> None:
    load = load_design if kind == "arm" else load_request
    data = yaml_of("adaptive_arm.design.yaml" if kind == "arm" else "system.request.yaml")
    if place == OUTPUTS and "expected in" not in message:
        # An output has its own entries in place of the link angle's.
        data = changed(data, ("design", "disturbance"), ...)
        data = changed(data, ("design", "measurement_std"), ...)
    path = written(tmp_path, changed(data, place, value))
    with pytest.raises(DesignFileError) as caught:
        load(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert re.search(message, text), text
    assert not isinstance(caught.value, CertificateError)


@pytest.mark.parametrize(
    ("name", "place", "value"),
    [("arm", ("gain", "K", 0), 0.0), ("system", ("system", "slope_vertices", 1, 1, 0), 1.0)],
)
def test_an_edited_design_is_refused_by_its_certificate(
    name: str, place: Any, value: Any, tmp_path: Path
) -> None:
    path = written(tmp_path, changed(yaml_of(f"{name}.design.yaml"), place, value))
    pattern = r"my\.yaml: the certificate does not hold: covariance decrease at .*: DOES NOT HOLD, "
    with pytest.raises(CertificateError, match=rf"{pattern}margin -\d\.\d{{3}}e[-+]\d\d \(> "):
        load_design(path)
    assert not parse_design(path).certificate.holds
    assert "THE CERTIFICATE DOES NOT HOLD" in parse_design(path).text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("arm: {link_inertia: 1, motor_inertia: 2, stiffness: 1e+100, gravity_torque: 1}", "mode"),
        ("design: {arm: {stiffness: 9}}", "design.arm.link_inertia: missing; an arm has all of"),
        ("desing: {rate: 100}", "design: unknown entry 'desing', expected some of arm, "),
        ("names: {states: [a]}", "system: missing; it has the premises, rules and C of a T-S"),
        ("torque_limit: 0", "torque_limit, torque_rate_limit: expected numbers above 0, got 0.0"),
        ("uncertainty: {stiffness: 40}", "uncertainty.stiffness: expected a relative error"),
        ("x_max: 45", "x_max: expected 0 < x_max <= π rad, got 45.0: is it in degrees?"),
        ("rate:", "design.rate: expected a number, got nothing"),
        ("", "expected a mapping, got nothing: it is empty"),
    ],
)
def test_a_request_that_cannot_be_meant_is_asked_about(
    text: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(DesignFileError, match=re.escape(message)):
        load_request(written(tmp_path, text))


def test_what_is_no_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DesignFileError, match=r"nothing\.yaml: cannot read it: No such file"):
        load_request(tmp_path / "nothing.yaml")
    with pytest.raises(DesignFileError, match="cannot read it: not a regular file"):
        load_design(tmp_path)
    path = tmp_path / "my.yaml"
    for text in (b"\xff\xfe\x00\x01", b"a: [", b"- format", b" " * (1 << 21)):
        path.write_bytes(text)
        with pytest.raises(DesignFileError, match=r"my\.yaml: (not valid|expected a)"):
            load_design(path)


def test_a_design_has_matrices_of_the_right_shape_and_a_bound(design: Design) -> None:
    for change, message in (
        ({"P": np.eye(4)}, r"P: expected shape \(5, 5\), got \(4, 4\)"),
        ({"K": np.zeros(5)}, r"K: expected shape \(5, 1\), got \(5,\)"),
        ({"P": np.full((5, 5), math.nan)}, "P: every entry must be finite"),
        (
            {"request": replace(design.arm_request, rate=2e6)},
            r"rate: expected at most 1e\+06 Hz, got 2e\+06",
        ),
    ):
        with pytest.raises(ModelError, match=message):
            replace(design, **change)
    for P in (-np.eye(5), np.zeros((5, 5)), np.ones((5, 5))):
        with pytest.raises(ModelError, match="P: expected a positive definite matrix"):
            _ = replace(design, P=P).covariance_bound
