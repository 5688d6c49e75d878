# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The command that fits writes a request, and a page of its numbers and what they predict."""

import html
import json
import re
from pathlib import Path

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.cli.main import main

HOSTILE = "<b>arm&.csv"
REQUEST = """\
design:
  arm: {link_inertia: 1.0, motor_inertia: 0.3, stiffness: 13.0, gravity_torque: 10.0}
  outputs:
    - {measures: motor_angle, measurement_std: 0.002}
    - {measures: link_angle, measurement_std: 0.002}
  x_max: 3.0
"""
FREE = ("stiffness", "motor_friction", "link_damping", "link_angle.measurement_std")


def torque(time: float) -> float:
    return 4.0 if time % 1.7 < 0.8 else -3.0 if time % 1.1 < 0.6 else 1.0


def texts(tag: str, text: str) -> list[str]:
    """Return what elements of a page have inside."""
    return [html.unescape(each) for each in re.findall(rf"<{tag}\b[^>]*>(.*?)</{tag}>", text)]


def test_a_fit_has_a_request_and_a_page(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """To a run of an arm of another stiffness with friction."""
    sheet, log = tmp_path / "sheet.request.yaml", tmp_path / HOSTILE
    sheet.write_text(REQUEST.replace("13.0", "10.0"))
    friction = {"motor_coulomb": 0.4}
    run = ts.simulate(ts.load_request(sheet), duration=6.0, torque=torque, friction=friction)
    sheet.write_text(REQUEST)
    table = np.column_stack([run.time, np.degrees(run.angle), 1000.0 * run.torque])
    titles = "time [s],motor_angle [deg],link_angle [deg],torque [mNm]"
    np.savetxt(log, table, delimiter=",", header=titles, comments="")
    output, page = tmp_path / "fitted.request.yaml", tmp_path / "pages" / "fit.html"
    words = ["fit", str(sheet), str(log), "--output", str(output), "--report", str(page)]

    assert main([*words, *(word for name in FREE for word in ("--free", name))]) == 0
    assert capsys.readouterr().out.endswith(f"\npage: {page}\n")
    assert ts.load_request(output).arm.stiffness == pytest.approx(10.0, rel=0.03)
    text = page.read_text()
    assert texts("h1", text) == [f"Fit to {HOSTILE}"]
    assert texts("h2", text)[:2] == ["Numbers", "What was found"]
    rows = [texts("td", row) for row in texts("tr", text)]
    assert {row[0]: row[5] for row in rows if len(row) == 6} == {
        "arm.stiffness": "yes", "arm.link_damping": "hardly", "motor_friction": "yes",
        "link_angle.measurement_std": "yes",
    }  # fmt: skip
    assert "  Coulomb friction of the motor" in text
    assert texts("h3", text) == [
        "motor angle [rad]", "residual of motor angle [expected 1σ]",
        "link angle [rad]", "residual of link angle [expected 1σ]",
        "torque [N m]", "friction and unexplained torque [N m]",
    ]  # fmt: skip

    assert main([*words, "--free", "stiffness"]) == 1
    assert "--force replaces it" in capsys.readouterr().err
    assert main([*words, "--free", "stiffness", "--json", "--force", "--held-out", "0"]) == 0
    assert json.loads(capsys.readouterr().out)["report"] == str(page)
    assert "figures: the last (fitted) 3 s" in page.read_text()
