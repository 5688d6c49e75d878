# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A page of a fit has its numbers, what they predict and what is left, and needs only itself."""

import json

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.cli.main import main

pytestmark = pytest.mark.xdist_group("page of a fit")  # its fixtures take seconds

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


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """Return how to fit to a run of an arm of another stiffness with friction, and the page."""
    folder = tmp_path_factory.mktemp("fit")
    sheet, log = folder / "sheet.request.yaml", folder / HOSTILE
    sheet.write_text(REQUEST.replace("13.0", "10.0"))
    friction = {"motor_coulomb": 0.4}
    run = ts.simulate(ts.load_request(sheet), duration=8.0, torque=torque, friction=friction)
    sheet.write_text(REQUEST)
    table = np.column_stack([run.time, run.angle, run.torque])
    titles = "time [s],motor_angle [rad],link_angle [rad],torque [Nm]"
    np.savetxt(log, table, delimiter=",", header=titles, comments="")
    output, page = folder / "fitted.request.yaml", folder / "pages" / "fit.html"
    return ["fit", str(sheet), str(log), "--output", str(output), "--report", str(page)], page


def test_a_page_of_a_fit_has_its_sections_and_clips_nothing(
    browser, command, capsys, wait_for
) -> None:
    words, page = command
    assert main([*words, *(word for name in FREE for word in ("--free", name))]) == 0
    assert capsys.readouterr().out.endswith(f"\npage: {page}\n")
    assert main([*words, "--free", "stiffness"]) == 1
    assert "--force replaces it" in capsys.readouterr().err
    context, noise = browser.new_context(viewport={"width": 390, "height": 900}), []
    tab = context.new_page()
    tab.on("console", lambda message: noise.append(message.text))
    tab.on("pageerror", lambda error: noise.append(str(error)))
    tab.goto(page.as_uri())
    tab.wait_for_selector("body[data-drawn]")

    assert tab.title() == f"Fit to {HOSTILE}"
    assert tab.locator("h2").all_inner_texts()[:2] == ["Numbers", "What was found"]
    rows = tab.locator("table").first.locator("tbody tr")
    cells = [row.locator("td").all_inner_texts() for row in rows.all()]
    assert {row[0]: row[5] for row in cells} == {
        "arm.stiffness": "yes", "arm.link_damping": "hardly", "motor_friction": "yes",
        "link_angle.measurement_std": "yes",
    }  # fmt: skip
    assert abs(float(cells[0][2]) - 10.0) < 0.3
    text = tab.locator("table").nth(1).inner_text()
    assert "found, and in the fitted request:" in text
    assert "Coulomb friction of the motor" in text
    assert tab.locator("h3").all_inner_texts() == [
        "motor angle [rad]", "residual of motor angle [expected 1σ]",
        "link angle [rad]", "residual of link angle [expected 1σ]",
        "torque [N m]", "friction and unexplained torque [N m]",
    ]  # fmt: skip
    for width in (390, 1280):
        tab.set_viewport_size({"width": width, "height": 900})
        # Nothing is wider than the window, and no label of an axis leaves its figure.
        wait_for(tab, "document.documentElement.scrollWidth <= innerWidth")
        wait_for(
            tab,
            "[...document.querySelectorAll('.plot')].every((plot) => {"
            " const box = plot.getBoundingClientRect();"
            " return [...plot.querySelectorAll('.xtick, .ytick, .xtitle')].every((one) => {"
            "  const own = one.getBoundingClientRect();"
            "  return own.left >= box.left - 1 && own.right <= box.right + 1 &&"
            "   own.top >= box.top - 1 && own.bottom <= box.bottom + 1; }); })",
        )
    context.close()
    assert noise == []


def test_a_page_without_a_held_out_part_says_so(command, capsys) -> None:
    words, page = command
    assert main([*words, "--free", "stiffness", "--json", "--force", "--held-out", "0"]) == 0

    assert json.loads(capsys.readouterr().out)["report"] == str(page)
    assert "figures: the last (fitted) 4 s" in page.read_text()
