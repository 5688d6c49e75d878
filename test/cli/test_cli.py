# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `tsobs` command: text for people, JSON for programs, exit codes for scripts."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

import tsobs_ros
from tsobs_ros.cli.estimate import METHODS
from tsobs_ros.cli.main import main
from tsobs_ros.design.file import load_design
from tsobs_ros.methods import METHODS as KNOWN
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

SHIPPED = config_path(SHIPPED_DESIGN)
Captured = pytest.CaptureFixture[str]


def test_the_command_knows_each_method() -> None:
    assert (*KNOWN,) == METHODS  # repeated there, so that help needs no NumPy


def strict_json(text: str) -> Any:
    """Parse JSON as other languages do: there is no NaN in it."""

    def refuse(constant: str) -> Any:
        raise ValueError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_a_design_and_a_files_name_do_not_command_the_terminal(
    tmp_path: Path, hostile: str, check_shown: Callable[[str], None], capsys: Captured
) -> None:
    hostile = hostile.replace("\0", "")  # which no argument can have
    data = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
    data["solver"].update(name=hostile, status=hostile)
    path = tmp_path / "tampered.design.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    assert main(["verify", str(path)]) == 0
    assert main(["verify", hostile]) == 1
    with pytest.raises(SystemExit, match="2"):
        main(["verify", str(path), hostile])
    told = capsys.readouterr()
    check_shown(told.out + told.err)
    assert (told.out + told.err).count(r"x\x1b[2J") == 4


def test_verify_shows_every_margin_of_the_shipped_design(capsys: Captured) -> None:
    assert main(["verify"]) == 0
    out, err = capsys.readouterr()
    assert (err, str(SHIPPED) in out) == ("", True)
    assert out.rstrip().endswith("the certificate holds")
    assert out.count(": holds, margin") == 5
    design = load_design(SHIPPED)
    for index, std in enumerate(design.bound_std):
        assert f"{std:#.4g}" in out, index

    assert main(["verify", str(SHIPPED), "--json"]) == 0
    printed = strict_json(capsys.readouterr().out)
    assert (printed["holds"], printed["design"]) == (True, str(SHIPPED))
    assert printed["gain"] == design.K[:, 0].tolist()
    assert printed["bound_std"] == design.bound_std.tolist()
    margins = [each.margin for each in design.certificate.inequalities]
    assert [each["margin"] for each in printed["inequalities"]] == margins


def test_a_design_says_what_arm_it_is_for(tmp_path: Path, capsys: Captured) -> None:
    pytest.importorskip("cvxpy")
    request, path = tmp_path / "request.yaml", tmp_path / "new.design.yaml"
    arm = "{link_inertia: 0.8, motor_inertia: 1.5, stiffness: 25.0, gravity_torque: 6.0}"
    request.write_text(f"arm: {arm}\n", encoding="utf-8")
    path.write_text("precious", encoding="utf-8")
    command = ["design", str(request), "--output", str(path)]
    assert main(command) == 1
    assert capsys.readouterr().err == f"error: {path}: exists already; --force replaces it\n"
    assert path.read_text(encoding="utf-8") == "precious"
    assert main([*command, "--force", "--json"]) == 0
    assert load_design(path).certificate.holds
    out, err = capsys.readouterr()
    assert err == ""
    assert strict_json(out)["request"]["design"]["arm"]["stiffness"] == 25.0
    assert main([*command, "--force"]) == 0
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert "link_inertia 0.8 kg m^2" in first
    assert "motor_damping 0 N m s/rad" in first
    # sqrt(25 / 0.8) / 2 pi and sqrt(25 / 0.8 + 25 / 1.5) / 2 pi
    assert second == "resonances: 0.89 Hz with the motor held, 1.1 Hz with both free"
    request.write_text(f"arm: {arm}\nrate: 10\n", encoding="utf-8")
    assert main([*command, "--force"]) == 0
    _, _, third, *_ = capsys.readouterr().out.splitlines()
    assert third.startswith("warning: a rate of 10 Hz is too low for these resonances: expected at")


def test_an_impossible_request_is_explained(tmp_path: Path, capsys: Captured) -> None:
    pytest.importorskip("cvxpy")
    request, path = tmp_path / "request.yaml", tmp_path / "new.design.yaml"
    request.write_text("disturbance: [{kind: arbitrary}]\n", encoding="utf-8")
    assert main(["design", str(request), "--output", str(path)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: no observer exists: disturbance arbitrary, |q1| <= 0.75 rad")
    assert "what would help:\n  - a model of the disturbance" in err
    assert not path.exists()


def test_a_ts_model_is_designed_and_verified(tmp_path: Path, capsys: Captured) -> None:
    pytest.importorskip("cvxpy")
    output = tmp_path / "ts.yaml"
    request = str(config_path("ts_example.request.yaml"))
    assert main(["design", request, "--output", str(output)]) == 0
    assert main(["verify", "--json", str(output)]) == 0
    assert main(["verify", "--exact", str(output)]) == 0
    out = capsys.readouterr().out
    assert "at slope vertex 1, slope vertex 2: holds" in out
    assert out.endswith("\nproved in exact arithmetic\n")
    data = yaml.safe_load(output.read_text(encoding="utf-8"))
    data["gain"]["K"] = [[3.0 * value for value in row] for row in data["gain"]["K"]]
    output.write_text(yaml.safe_dump(data), encoding="utf-8")
    assert main(["verify", "--exact", str(output)]) == 1
    assert capsys.readouterr().out.endswith("\nNOT PROVED in exact arithmetic\n")
    assert main(["verify", "--json", str(output)]) == 1
    printed = strict_json(capsys.readouterr().out)
    assert (printed["holds"], printed["bound_std"]) == (False, None)


@pytest.mark.parametrize("arguments", [[], ["demo", "--duration", "nan"], ["report"]])
def test_wrong_usage_is_exit_code_2(capsys: Captured, arguments: list[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert "usage: tsobs" in capsys.readouterr().err


def test_folder_and_version_are_printed(capsys: Captured) -> None:
    assert main(["config"]) == 0
    assert Path(capsys.readouterr().out.rstrip("\n"), SHIPPED_DESIGN).is_file()
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    assert capsys.readouterr().out == f"tsobs {tsobs_ros.__version__}\n"


def test_a_missing_library_is_one_line_with_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    monkeypatch.setitem(sys.modules, "tsobs_ros.design.synthesis", None)
    monkeypatch.delitem(sys.modules, "tsobs_ros.design.synthesis")
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    assert main(["design", "--output", "x.yaml"]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"error: cvxpy is not installed: {sys.executable} -m pip install ")
    assert "'cvxpy-base>=1.5' 'clarabel>=0.9' 'scipy>=1.11'" in err
