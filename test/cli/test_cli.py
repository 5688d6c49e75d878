# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `tsobs` command: words for people, JSON for programs, exit codes for scripts."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import tsobs_ros
from tsobs_ros.cli.main import main
from tsobs_ros.design.file import load_design
from tsobs_ros.resources import config_path

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = config_path("elastic_joint.design.yaml")
VERTICES = ["(0.7317, 0.7317)", "(0.7317, 1)", "(1, 0.7317)", "(1, 1)"]
Captured = pytest.CaptureFixture[str]


def strict_json(text: str) -> Any:
    """Parse JSON as other languages do: there is no NaN in it."""

    def refuse(constant: str) -> Any:
        raise ValueError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.fixture
def tampered(tmp_path: Path) -> Callable[[Callable[[dict[str, Any]], None]], Path]:
    """Write a copy of the shipped design with a change."""

    def write(change: Callable[[dict[str, Any]], None]) -> Path:
        data = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
        change(data)
        path = tmp_path / "tampered.design.yaml"
        path.write_text(yaml.safe_dump(data), encoding="utf-8")
        return path

    return write


def triple_the_gain(data: dict[str, Any]) -> None:
    data["gain"]["K"] = [3.0 * value for value in data["gain"]["K"]]


def test_verify_shows_every_margin_of_the_shipped_design(capsys: Captured) -> None:
    assert main(["verify"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert str(SHIPPED) in out
    assert out.rstrip().endswith("the certificate holds")
    for vertex in VERTICES:
        (line,) = [line for line in out.splitlines() if f"slopes {vertex}" in line]
        assert "holds, margin" in line
    assert "P symmetric and positive definite: holds" in out
    for index, std in enumerate(load_design(SHIPPED).bound_std):
        assert f"{std:.5f}" in out, index


def test_verify_tells_programs_the_same(capsys: Captured) -> None:
    assert main(["verify", str(SHIPPED), "--json"]) == 0
    told = strict_json(capsys.readouterr().out)
    design = load_design(SHIPPED)
    assert told["holds"] is True
    assert told["design"] == str(SHIPPED)
    assert told["gain"] == design.K[:, 0].tolist()
    assert told["bound_std"] == design.bound_std.tolist()
    assert [each["margin"] for each in told["inequalities"]] == [
        each.margin for each in design.certificate.inequalities
    ]
    assert all(each["holds"] and each["margin"] > 0.0 for each in told["inequalities"])
    assert len(told["inequalities"]) == 5
    assert (told["x_max"], told["rate"], told["disturbance"]) == (0.75, 200.0, "bias")


def test_a_tampered_gain_fails_by_inequality_and_vertex(tampered: Any, capsys: Captured) -> None:
    path = tampered(triple_the_gain)
    assert main(["verify", str(path)]) == 1
    out = capsys.readouterr().out
    assert "THE CERTIFICATE DOES NOT HOLD" in out
    for vertex in VERTICES:
        assert f"covariance decrease at slopes {vertex}: DOES NOT HOLD, margin -" in out
    assert "P symmetric and positive definite: holds" in out

    assert main(["verify", str(path), "--json"]) == 1
    told = strict_json(capsys.readouterr().out)
    assert told["holds"] is False
    assert told["bound_std"] is None
    failing = [each for each in told["inequalities"] if not each["holds"]]
    assert [each["where"] for each in failing] == [f"slopes {vertex}" for vertex in VERTICES]
    assert all(each["margin"] < 0.0 for each in failing)


def test_a_matrix_that_proves_nothing_is_named(tampered: Any, capsys: Captured) -> None:
    def negative(data: dict[str, Any]) -> None:
        data["certificate"]["P"][2][2] *= -1.0

    assert main(["verify", str(tampered(negative))]) == 1
    out = capsys.readouterr().out
    assert "P symmetric and positive definite: DOES NOT HOLD" in out
    assert "THE CERTIFICATE DOES NOT HOLD" in out


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "no such design file"),
        ("- 1\n- 2\n", "expected a mapping"),
        ("{", "not valid YAML"),
        ("format: something else\n", "format"),
    ],
)
def test_files_that_are_no_design_are_one_line(
    tmp_path: Path, capsys: Captured, content: str | None, named: str
) -> None:
    path = tmp_path / "some.yaml"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    assert main(["verify", str(path)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"error: {path}: ")
    assert named in err
    assert len(err.splitlines()) == 1


def test_a_design_can_be_made_written_and_verified(tmp_path: Path, capsys: Captured) -> None:
    pytest.importorskip("cvxpy")
    path = tmp_path / "new.design.yaml"
    assert main(["design", "--output", str(path)]) == 0
    out = capsys.readouterr().out
    assert f"written to {path}" in out
    made, shipped = load_design(path), load_design(SHIPPED)
    # The defaults are what the shipped design was made of.
    assert made.request == shipped.request
    np.testing.assert_allclose(made.K, shipped.K, rtol=1e-3)
    assert main(["verify", str(path)]) == 0
    assert capsys.readouterr().out.rstrip().endswith("the certificate holds")


def test_a_request_file_is_followed_and_its_result_told_as_json(
    tmp_path: Path, capsys: Captured
) -> None:
    pytest.importorskip("cvxpy")
    request, path = tmp_path / "request.yaml", tmp_path / "new.design.yaml"
    request.write_text("x_max: 0.5\nmeasurement_std: 0.01\n", encoding="utf-8")
    assert main(["design", str(request), "--output", str(path), "--json"]) == 0
    told = strict_json(capsys.readouterr().out)
    assert (told["design"], told["x_max"], told["holds"]) == (str(path), 0.5, True)
    design = load_design(path)
    assert design.request.measurement_std == 0.01
    assert told["gain"] == design.K[:, 0].tolist()


def test_an_impossible_request_is_explained(tmp_path: Path, capsys: Captured) -> None:
    pytest.importorskip("cvxpy")
    request, path = tmp_path / "request.yaml", tmp_path / "new.design.yaml"
    request.write_text("x_max: 1.6\n", encoding="utf-8")
    assert main(["design", str(request), "--output", str(path)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: no observer can tell the arm from a disturbance of kind bias")
    assert "gravity slope c = 0" in err
    assert "what would help:" in err
    assert "a smaller domain" in err
    assert not path.exists()


@pytest.mark.parametrize(
    ("content", "named"),
    [("x_max: 4.0\n", "x_max"), ("colour: red\n", "colour"), ("rate: fast\n", "rate")],
)
def test_a_senseless_request_is_refused_by_name(
    tmp_path: Path, capsys: Captured, content: str, named: str
) -> None:
    request = tmp_path / "request.yaml"
    request.write_text(content, encoding="utf-8")
    assert main(["design", str(request), "--output", str(tmp_path / "new.yaml")]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"error: {request}: ")
    assert named in err


def test_an_existing_file_is_only_replaced_by_force(tmp_path: Path, capsys: Captured) -> None:
    pytest.importorskip("cvxpy")
    path = tmp_path / "mine.yaml"
    path.write_text("precious", encoding="utf-8")
    assert main(["design", "--output", str(path)]) == 1
    assert capsys.readouterr().err == f"error: {path}: exists already; --force replaces it\n"
    assert path.read_text(encoding="utf-8") == "precious"
    assert main(["design", "--output", str(path), "--force"]) == 0
    assert load_design(path).certificate.holds
    assert [each.name for each in tmp_path.iterdir()] == ["mine.yaml"]


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["observe"],
        ["verify", "--colour"],
        ["verify", "one", "two"],
        ["design"],
        ["demo", "--duration", "-3"],
        ["demo", "--duration", "nan"],
        ["demo", "--duration", "soon"],
        ["demo", "--seed", "1.5"],
        ["report"],
    ],
)
def test_wrong_usage_is_exit_code_2(capsys: Captured, arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "usage: tsobs" in capsys.readouterr().err


@pytest.mark.parametrize("command", [[], ["demo"], ["design"], ["verify"], ["report"]])
def test_help_is_there(capsys: Captured, command: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*command, "--help"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith(" ".join(["usage: tsobs", *command]))


def test_the_version_is_told(capsys: Captured) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"tsobs {tsobs_ros.__version__}\n"


def test_a_bag_that_is_not_there_is_one_line(tmp_path: Path, capsys: Captured) -> None:
    assert main(["report", str(tmp_path / "bag"), "--output", str(tmp_path / "report")]) == 1
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert str(tmp_path / "bag") in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "report").exists()


def test_a_reader_that_has_gone_is_no_traceback() -> None:
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from tsobs_ros.cli.main import main"
    process = subprocess.Popen(
        [sys.executable, "-c", f"{code}; sys.exit(main(['verify', '--json']))"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    err = process.stderr.read().decode()
    process.stderr.close()
    assert process.wait(60) == 1
    assert "Traceback" not in err
