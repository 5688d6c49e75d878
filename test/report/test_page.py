# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of a report in a browser: it draws, zooms and switches, alone and on a phone."""

from dataclasses import replace

import numpy as np
import pytest

from tsobs_ros.estimation.events import Event, EventKind
from tsobs_ros.estimation.health import Level
from tsobs_ros.estimation.records import Basis, Hypothesis
from tsobs_ros.replay.health import JointEvent, health_of
from tsobs_ros.report.diagnosed import RecordedStatus, diagnose
from tsobs_ros.report.metrics import measure
from tsobs_ros.report.page import write_html
from tsobs_ros.report.panels import Table, picture
from tsobs_ros.report.summary import Summary, summarise
from tsobs_ros.series import Series

HOSTILE = "</script><img src=x onerror=alert(1)><b>&\u202e$x$"


def statuses(run):
    """Yield what an observer reports once a second: a bias, and gated measurements."""
    for second in range(1, 20):
        stamp = run.origin + second * 1_000_000_000
        kind, level = ("bias", 1) if 8 < second < 15 else ("none", 0)
        fault = {"kind": kind, "magnitude [rad]": "0.25", "since": "for 0.5 s"}
        gated = {"rejected: gated": str(max(0, second - 10)), "rejected: too old": "0"}
        yield RecordedStatus(stamp, level, ("observer", "sensor fault"), fault)
        yield RecordedStatus(stamp, 0, ("observer", "measurements"), gated)


@pytest.fixture
def diagnosed(simulated):
    """What those statuses come to."""
    return diagnose(statuses(simulated), simulated.origin, 20.0)


@pytest.fixture
def page(simulated, troubled, diagnosed, tmp_path):
    """A page with all panels, of a run with a name that is markup."""
    slow = troubled.parts["health"].stamps
    learnt = Series(slow, np.tile([0.1, -0.05], (len(slow), 1)))
    bound = learnt._replace(values=np.full((len(slow), 2), 0.02))
    parts = {**troubled.parts, "parameters": learnt, "parameter_bound": bound}
    run = replace(troubled, name=HOSTILE, parts=parts)
    metrics = measure(run)
    shown = picture(run, metrics, (0.03,), diagnosed=diagnosed)
    path = tmp_path / "run.html"
    table = Table("A table", ("what", "number"), [(HOSTILE, "1")], 1, HOSTILE)
    write_html(shown, path, [table], summary=Summary(Level.WARN, "It went so-so."))
    return path


@pytest.fixture
def tab(browser, page):
    """The page on a phone; fails on messages and requests at the end."""
    context, noise = browser.new_context(viewport={"width": 390, "height": 900}), []
    tab = context.new_page()
    tab.on("console", lambda message: noise.append(message.text))
    tab.on("pageerror", lambda error: noise.append(str(error)))
    tab.on("request", lambda request: noise.append(request.url) if request.url != page.as_uri()
           and not request.url.startswith(("data:", "blob:")) else None)  # fmt: skip
    tab.goto(page.as_uri())
    tab.wait_for_selector("body[data-drawn]")
    yield tab
    context.close()
    assert noise == []


def test_a_page_fits_a_phone_zooms_switches_and_prints(tab, page, wait_for) -> None:
    titles = tab.locator("h3").all_inner_texts()
    assert {"link angle [rad]", "sensor fault", "learnt change of gravity"} < set(titles)
    assert len(titles) == 17
    assert tab.locator(".main-svg .trace").count() > 40
    assert tab.locator("p.verdict").inner_text() == "! Mind:It went so-so."
    assert tab.title() == HOSTILE
    assert tab.locator("h1").inner_text() == HOSTILE
    assert tab.locator("td").first.inner_text() == HOSTILE
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert tab.evaluate(
        "[...document.querySelectorAll('.plot')].every((one) =>"
        " one.querySelector('.modebar').getBoundingClientRect().bottom"
        " <= one.querySelector('.nsewdrag').getBoundingClientRect().top + 1)"
    )
    assert [path.name for path in page.parent.iterdir() if path.name.startswith("run")] == [
        "run.html"
    ]

    tab.set_viewport_size({"width": 1280, "height": 900})
    wait_for(tab, "document.querySelector('#plot0')._fullLayout.width > 500")
    box = tab.locator("#plot0 .nsewdrag").bounding_box()
    middle = box["y"] + 0.5 * box["height"]
    tab.mouse.move(box["x"] + 0.25 * box["width"], middle)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.5 * box["width"], middle, steps=5)
    tab.mouse.up()
    tab.wait_for_selector("body[data-range]")

    # Zooming into one plot zooms into all over the same time.
    ranges = tab.evaluate(
        "[...document.querySelectorAll('.plot')].map((one) => [...one.layout.xaxis.range])"
    )
    assert ranges == [pytest.approx([5.0, 10.0], abs=0.1)] * len(titles)

    # A key switches a curve in all plots.
    shown = "[...document.querySelectorAll('.plot')].flatMap((one) => one.data)"
    shown += ".filter((one) => one.legendgroup === 'true' && one.visible !== false).length"
    before = tab.evaluate(shown)
    assert before >= 5
    key = tab.get_by_role("button", name="true")
    key.focus()
    tab.keyboard.press("Enter")
    wait_for(tab, f"({shown}) === 0")
    assert key.get_attribute("aria-pressed") == "false"
    key.click()
    wait_for(tab, f"({shown}) === {before}")

    # A printed page fits its paper, whatever the window's width is.
    tab.evaluate("dispatchEvent(new Event('beforeprint'))")
    widths = "[...document.querySelectorAll('.plot')].map((one) => one._fullLayout.width)"
    assert set(tab.evaluate(widths)) == {690}


@pytest.mark.filterwarnings("error")
def test_any_number_can_be_drawn(simulated, tmp_path) -> None:
    measured = simulated.parts["measurements"]
    huge = measured._replace(values=measured.values * 1e300)
    run = replace(simulated, parts={**simulated.parts, "measurements": huge})
    write_html(picture(run, measure(run)), tmp_path / "run.html")
    assert (tmp_path / "run.html").stat().st_size > 0


def test_diagnostics_come_to_faults_and_rejects(diagnosed) -> None:
    (fault,) = diagnosed.faults
    assert (fault.kind, fault.level, fault.unit) == ("bias", Level.WARN, "rad")
    assert (fault.begin, fault.end, fault.magnitude) == (8.5, 15.0, 0.25)
    assert diagnosed.rejected == {"gated": 9}


def test_rejects_before_and_after_a_restart_of_the_observer_count(simulated) -> None:
    counts = [("0", "0"), ("5", "1"), ("1", "4")]  # restarted before the third
    told = [
        RecordedStatus(
            simulated.origin + second * 1_000_000_000,
            0,
            ("observer", "measurements"),
            {"rejected: gated": gated, "rejected: too old": old},
        )
        for second, (gated, old) in enumerate(counts)
    ]
    assert diagnose(told, simulated.origin, 20.0).rejected == {"gated": 6, "too old": 5}


def test_a_run_is_summed_up_in_plain_words(simulated, troubled, diagnosed) -> None:
    metrics = measure(simulated)
    timing = picture(simulated, metrics).timing
    health, nothing = health_of(troubled.parts["health"].values), diagnose([], 0, 20.0)

    good = summarise(metrics, health, nothing, timing)
    assert good.level is Level.OK
    assert "rejected: unknown" in good.text
    assert good.text.startswith("Errors are inside their 3σ bound for 100 % of 10.0 s")
    assert "Bounds were claimed for 90.5 % of the time, and proved" in good.text
    few = health._replace(claimed=0.18, bases={Basis.CERTIFIED: 0.18, Basis.CONTRADICTED: 0.05})
    assert summarise(metrics, few, nothing, timing).level is Level.WARN
    fitting = health._replace(hypothesis=Hypothesis.AS_DESIGNED)
    outside = fitting._replace(bases={Basis.OUTSIDE: 0.41, Basis.CERTIFIED: 0.59}).misfit
    assert outside
    assert outside.startswith("for 41 % of the time the link's angle is outside of x_max")
    slight = fitting._replace(bases={Basis.HYPOTHESIS: 0.96})
    for claimed, is_said in ((1.0, True), (0.5, False)):
        assert ("the bounds allow for it" in slight._replace(claimed=claimed).misfit) == is_said
    misfit = fitting._replace(bases={Basis.CONTRADICTED: 0.96})
    said = ["behave as designed" in "".join(one.lines()) for one in (fitting, misfit)]
    assert said == [True, False]
    away = Event(0, EventKind.STATE, Level.WARN, "COASTING: no measurement on /y for 1.2 s")
    events = [JointEvent("elbow", time, away) for time in (0, 10**9)]
    silent = summarise(metrics, health, nothing, timing, events)
    assert silent.level is Level.WARN
    assert "silences: 2." in silent.text
    # What comes after the last measurement is no silence.
    assert summarise(metrics, health, nothing, timing, events, until=0) == good

    stamps, bound, _ = simulated.parts["state_bound"]
    parts = {**simulated.parts, "state_bound": Series(stamps, 0.1 * bound)}
    wrong = replace(simulated, parts=parts)
    bad = summarise(measure(wrong), None, diagnosed, timing)
    assert bad.level is Level.ERROR
    assert "sensor faults: 1; worst: bias of 0.25 rad, from 8.5 s to 15.0 s." in bad.text
    assert "Measurements missing: 0 of 4001; rejected: 9" in bad.text
