# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures and pages show what is known, with gaps, and leave matplotlib as it was."""

from dataclasses import replace

import numpy as np
import pytest

from tsobs_ros.report.figures import draw_run
from tsobs_ros.report.metrics import measure
from tsobs_ros.report.panels import MAX_CURVE, picture, thin
from tsobs_ros.report.run import ESTIMATED
from tsobs_ros.series import Series


def curve(plot, name):
    """Return the curve of a name of a plot."""
    return next(one for one in plot.curves if one.name == name)


def test_a_figure_is_drawn_of_series_with_gaps(troubled, tmp_path) -> None:
    """In one figure, which takes long: each kind of gap has every third row."""
    shown = [with_gap(troubled, gap) for gap in ("stamps", "all", "nan")]
    rows = tuple(shown[place % 3].rows[place] for place in range(len(shown[0].rows)))
    draw_run(shown[0]._replace(rows=rows), tmp_path / "run.png")


def with_gap(troubled, gap: str):
    """Return the picture of a run without five seconds, or all, of what was not estimated.

    There are no stamps there ("stamps", "all"), or numbers that are none ("nan").
    """
    learnt = Series(troubled.stamps[::10], 0.01 * np.ones((len(troubled.stamps[::10]), 2)))
    parts = {**troubled.parts, "parameters": learnt, "parameter_bound": learnt}
    whole = replace(troubled, parts=parts)
    begin, end = (0.0, 99.0) if gap == "all" else (6.0, 11.0)
    begin, end = (whole.stamps[0] + int(1e9 * time) for time in (begin, end))

    for name, (stamps, values, _) in parts.items():
        inside = (stamps >= begin) & (stamps < end)
        part = Series(stamps, np.where(inside[:, np.newaxis], np.nan, values))
        if gap == "stamps":
            part = Series(stamps[~inside], values[~inside])
        parts[name] = parts[name] if name in ESTIMATED else part
    run = replace(whole, parts=parts)
    shown = picture(run, measure(run))
    assert np.isfinite([plot.limits for plot in shown.plots]).all()
    return shown


def test_thinning_keeps_every_extreme_and_gap() -> None:
    times = np.arange(30 * MAX_CURVE + 1, dtype=float)
    values = np.sin(0.001 * times)
    values[[777, 80_001]] = 9.0, -9.0
    values[100_000:101_000] = np.nan

    kept = thin(values)

    at, thinned = times[kept], values[kept]
    assert MAX_CURVE / 2 < len(at) <= MAX_CURVE
    assert (np.diff(at) > 0).all()
    assert thinned[at == 777.0] == 9.0
    assert thinned[at == 80_001.0] == -9.0
    gap = (at > 100_100) & (at < 100_900)
    assert gap.any()
    assert np.isnan(thinned[gap]).all()


def test_plots_hold_the_run_in_its_units(simulated, troubled) -> None:
    shown = picture(simulated, measure(simulated), innovation_std=(0.03,))
    plots = [row[0] for row in shown.rows]

    assert [plot.title for plot in plots] == [
        "link angle [rad]", "link velocity [rad/s]", "motor angle [rad]", "motor velocity [rad/s]",
        "sensor disturbance [rad]", "applied torque [N m]", "innovation [rad]",
        "measurement interval [ms]",
    ]  # fmt: skip
    assert [row[1].label for row in shown.rows[:5]] == [f"{one.label}: error" for one in plots[:5]]
    parts = {name: part.values for name, part in simulated.parts.items()}
    for plot, name, values in (
        (plots[0], "measured", parts["measurements"][:, 0]),
        (plots[2], "true", parts["true_state"][:, 2]),
        (plots[4], "estimated", parts["disturbance"][:, 0]),
        (plots[5], "applied", parts["measurements"][:, 1]),
    ):
        np.testing.assert_array_equal(curve(plot, name).values, values)
    assert plots[6].level == pytest.approx(0.09)
    np.testing.assert_allclose(curve(plots[7], "interval").values, 5.0)
    noise = picture(troubled, measure(troubled)).plots[-2]
    health = troubled.parts["health"].values
    np.testing.assert_array_equal(curve(noise, "noise scale").values, health[:, 0])
    assert noise.spans == (pytest.approx((8.1, 10.0), abs=0.01),)
    # What does not count as settled is what the windows leave.
    assert list(shown.unsettled) == [pytest.approx((0.0013, 5.0013)), pytest.approx((8.0, 13.0))]


def test_gaps_are_drawn_as_gaps_and_counted(simulated) -> None:
    there = (simulated.times < 10.0) | (simulated.times >= 12.0)
    names, parts = ("state", "state_bound", "disturbance", "disturbance_bound"), simulated.parts
    cut = {name: parts[name].take(there) for name in names}
    cut["measurements"] = parts["measurements"].take(np.append(there, True))
    run = replace(simulated, parts={**parts, **cut})

    shown = picture(run, measure(run))

    estimated, band = curve(shown.plots[0], "estimated"), shown.plots[0].bands[0]
    for times, values in ((estimated.times, estimated.values), (band.times, band.lower)):
        (middle,) = times[np.isnan(values)]
        assert 10.0 < middle < 12.0
    assert (shown.timing.lost, shown.timing.gaps) == (400, 1)
    assert shown.timing.max_interval == pytest.approx(2.005)
