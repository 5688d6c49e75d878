# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures and pages show what is known, stand alone and leave matplotlib as it was."""

import sys
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from tsobs_ros.report import panels as content
from tsobs_ros.report.figures import draw_run
from tsobs_ros.report.metrics import measure
from tsobs_ros.report.page import write_html
from tsobs_ros.report.panels import MAX_CURVE, Curve, picture, thin
from tsobs_ros.report.run import Series


def has_colour(path: Path, colour: str) -> bool:
    pixels = imread(path)[..., :3]
    return bool((np.abs(pixels - np.array(to_rgb(colour))).max(axis=-1) < 2 / 255).sum() > 100)


@pytest.fixture
def robot(simulated):
    """The same run as a real robot would give it."""
    return replace(simulated, truth=None, true_disturbance=None)


def test_a_figure_shows_truth_only_where_it_is_known(simulated, robot, tmp_path) -> None:
    for name, run in (("known.png", simulated), ("unknown.png", robot)):
        draw_run(picture(run, measure(run)), tmp_path / name)

    assert imread(tmp_path / "known.png").shape[1] == 1400
    assert has_colour(tmp_path / "known.png", content.TRUTH_COLOUR)
    assert has_colour(tmp_path / "known.png", content.EVENT_COLOUR)
    assert not has_colour(tmp_path / "unknown.png", content.TRUTH_COLOUR)
    assert has_colour(tmp_path / "unknown.png", content.ESTIMATE_COLOUR)


@pytest.mark.parametrize(("draw", "name"), [(draw_run, "run.svg"), (write_html, "run.html")])
def test_the_same_run_gives_the_same_file_and_no_global_change(short, tmp_path, draw, name) -> None:
    before, pyplot = dict(matplotlib.rcParams), "matplotlib.pyplot" in sys.modules
    path, contents = tmp_path / name, []
    for _ in range(2):
        draw(picture(short, measure(short)), path)
        contents.append(path.read_bytes())

    assert contents[0] == contents[1]
    assert dict(matplotlib.rcParams) == before
    assert ("matplotlib.pyplot" in sys.modules) == pyplot


@pytest.mark.parametrize("jump", [1.0, 10.5, 18.0])
def test_the_label_of_a_jump_stays_above_its_own_panel(simulated, tmp_path, jump) -> None:
    stamps = simulated.true_disturbance.stamps
    fault = 0.1 * (stamps > stamps[0] + jump * 1e9)[:, np.newaxis]
    run = replace(simulated, true_disturbance=Series(stamps, fault))

    draw_run(picture(run, measure(run)), tmp_path / "run.png")

    above = imread(tmp_path / "run.png")[118:138, :, :3]
    near = np.abs(above - np.array(to_rgb(content.EVENT_COLOUR))).max(axis=-1) < 0.1
    columns = np.flatnonzero(near.any(axis=0))
    assert len(columns) > 50
    assert columns.min() > 0.09 * 1400
    assert columns.max() < 0.57 * 1400


def test_a_name_is_no_formula(short, tmp_path) -> None:
    shown = picture(replace(short, name=r"a$\frac{$b"), measure(short))
    draw_run(shown, tmp_path / "run.svg")

    assert "<svg" in (tmp_path / "run.svg").read_text(encoding="utf-8")


def test_a_figure_survives_what_a_bag_may_lack(robot, tmp_path) -> None:
    nothing = np.full(robot.states.shape, np.nan)
    run = replace(
        robot,
        innovations=None,
        state_bounds=nothing,
        disturbance=nothing[:, :1],
        disturbance_bounds=nothing[:, :1],
    )

    draw_run(picture(run, measure(run)), tmp_path / "run.png")
    write_html(picture(run, measure(run)), tmp_path / "run.html")

    assert has_colour(tmp_path / "run.png", content.ESTIMATE_COLOUR)


SERIES = ("measurements", "truth", "true_disturbance", "innovations", "health", "parameters",
          "parameter_bounds", "delays", "estimate_delays")  # fmt: skip


@pytest.mark.parametrize("gap", ["stamps", "nan", "start", "all"])
def test_a_figure_has_gaps_where_its_series_have_them(troubled, tmp_path, gap: str) -> None:
    """Of five seconds: without stamps there, with numbers that are none, or from the start."""
    learnt = Series(troubled.stamps[::10], 0.01 * np.ones((len(troubled.stamps[::10]), 2)))
    delays = Series(troubled.stamps, 1e-3 * np.ones((len(troubled.stamps), 1)))
    whole = replace(
        troubled,
        parameters=learnt, parameter_bounds=learnt, delays=delays, estimate_delays=delays,
    )  # fmt: skip
    begin, end = {"start": (0.0, 5.0), "all": (0.0, 99.0)}.get(gap, (6.0, 11.0))
    begin, end = (whole.stamps[0] + int(1e9 * time) for time in (begin, end))

    gaps = {}
    for name in SERIES:
        stamps, values = getattr(whole, name)
        inside = (stamps >= begin) & (stamps < end)
        gaps[name] = Series(stamps, np.where(inside[:, np.newaxis], np.nan, values))
        if gap == "stamps":
            gaps[name] = Series(stamps[~inside], values[~inside])
    for each in (*({name: series} for name, series in gaps.items()), gaps):
        run = replace(whole, **each)
        shown = picture(run, measure(run), learnt=("stiffness", "gravity_torque"))
        limits = [plot.limits for panel in shown.panels for plot in (panel.values, panel.error)
                  if plot is not None]  # fmt: skip
        assert np.isfinite(limits).all(), list(each)
    draw_run(shown, tmp_path / "run.png")
    write_html(shown, tmp_path / "run.html")


def test_thinning_keeps_every_extreme_and_gap() -> None:
    times = np.arange(30 * MAX_CURVE + 1, dtype=float)
    values = np.sin(0.001 * times)
    values[[777, 80_001]] = 9.0, -9.0
    values[100_000:101_000] = np.nan

    thinned = thin(Curve(times, values))

    assert MAX_CURVE / 2 < len(thinned.times) <= MAX_CURVE
    assert (np.diff(thinned.times) > 0).all()
    assert thinned.values[thinned.times == 777.0] == 9.0
    assert thinned.values[thinned.times == 80_001.0] == -9.0
    gap = (thinned.times > 100_100) & (thinned.times < 100_900)
    assert gap.any()
    assert np.isnan(thinned.values[gap]).all()
    short = Curve(times[:MAX_CURVE], times[:MAX_CURVE])
    np.testing.assert_array_equal(thin(short).times, short.times)


def test_panels_hold_the_run_in_its_units(simulated) -> None:
    shown = picture(simulated, measure(simulated), innovation_std=(0.03,)).panels

    assert [(panel.values.label, panel.unit) for panel in shown] == [
        ("link angle", "rad"),
        ("link velocity", "rad/s"),
        ("motor angle", "rad"),
        ("motor velocity", "rad/s"),
        ("sensor disturbance", "rad"),
        ("applied torque", "N m"),
        ("innovation", "rad"),
        ("autocorrelation of innovation", ""),
        ("measurement interval", "ms"),
    ]
    np.testing.assert_array_equal(shown[0].values.dots.values, simulated.measurements.values[:, 0])
    np.testing.assert_array_equal(shown[2].values.truth.values, simulated.truth.values[:, 2])
    np.testing.assert_array_equal(shown[4].values.estimate.values, simulated.disturbance[:, 0])
    np.testing.assert_array_equal(
        shown[5].values.lines[0].curve.values, simulated.measurements.values[:, 1]
    )
    assert shown[6].values.level[0] == pytest.approx(0.09)
    assert np.abs(shown[7].values.lines[0].curve.values).max() < 4.0 * shown[7].values.level[0]
    np.testing.assert_allclose(shown[8].values.dots.values, 5.0)
    assert all(panel.values.dots is None for panel in shown[1:5])


def test_noise_and_void_bounds_have_a_panel(troubled, tmp_path) -> None:
    panels = picture(troubled, measure(troubled)).panels
    (panel,) = (one for one in panels if one.values.label == "noise scale")

    plot, (coloured, name) = panel.values, panel.values.other
    assert (plot.label, name) == ("noise scale", "coloured power")
    np.testing.assert_array_equal(plot.estimate.values, troubled.health.values[:, 0])
    np.testing.assert_array_equal(coloured.values, troubled.health.values[:, 1])
    (span,) = plot.spans
    assert span == pytest.approx((8.1, 10.0), abs=0.01)
    assert "25 % force" in panel.remark
    run = replace(troubled, truth=None, true_disturbance=None)
    draw_run(picture(run, measure(run)), tmp_path / "run.png")
    pixels = imread(tmp_path / "run.png")[..., :3]
    marked = 0.13 * np.array(to_rgb(content.EVENT_COLOUR)) + 0.87
    assert (np.abs(pixels - marked).max(axis=-1) < 0.02).sum() > 1000
    write_html(picture(run, measure(run)), tmp_path / "run.html")
    assert "coloured power" in (tmp_path / "run.html").read_text(encoding="utf-8")


def test_wild_first_guesses_do_not_flatten_the_rest(simulated) -> None:
    states = simulated.states.copy()
    states[:20] = 1e3

    panel = picture(replace(simulated, states=states), measure(simulated)).panels[0]

    assert panel.values.limits[1] < 1.5


def test_spans_that_do_not_count_are_the_windows_complement(simulated) -> None:
    shown = picture(simulated, measure(simulated))

    assert list(shown.unsettled) == [pytest.approx((0.0013, 5.0013)), pytest.approx((8.0, 13.0))]


def test_a_wrong_stamp_does_not_stretch_the_time_axis(simulated) -> None:
    stamps, values = (a.copy() for a in simulated.measurements)
    metrics = measure(simulated)
    assert picture(simulated, metrics).time_range == (0.0, 20.0)
    stamps[100] += 10**15

    run = replace(simulated, measurements=Series(stamps, values))
    assert picture(run, metrics).time_range == (0.0, 19.9963)


def test_gaps_are_drawn_as_gaps_and_counted(simulated) -> None:
    seconds = simulated.times
    there = (seconds < 10.0) | (seconds >= 12.0)
    stamps, values = simulated.measurements
    kept = np.append(there, True)
    run = replace(
        simulated,
        measurements=Series(stamps[kept], values[kept]),
        stamps=simulated.stamps[there],
        states=simulated.states[there],
        state_bounds=simulated.state_bounds[there],
        disturbance=simulated.disturbance[there],
        disturbance_bounds=simulated.disturbance_bounds[there],
    )

    shown = picture(run, measure(run), period=0.005)

    plot = shown.panels[0].values
    for times, drawn in (plot.estimate, (plot.bands.times, plot.bands.edges[:, 0])):
        broken = np.isnan(drawn)
        assert broken.sum() == 1
        assert 10.0 < times[broken][0] < 12.0
    assert (shown.timing.lost, shown.timing.gaps) == (400, 1)
    assert shown.timing.max_interval == pytest.approx(2.005)
