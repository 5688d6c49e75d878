# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Panels of curves on one time axis: the content of a run's figure and of its page."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.estimation.events import BOUNDS
from tsobs_ros.estimation.health import Level
from tsobs_ros.estimation.records import Hypothesis
from tsobs_ros.report.metrics import (
    QUANTITIES,
    SIGMAS,
    Quantity,
    RunMetrics,
    errors,
    inside_windows,
)
from tsobs_ros.report.run import RecordedRun, Series

MAX_CURVE = 5000
"""Longer curves are thinned: more points than pixels only make files large."""

MAX_BAND = 1500
"""Longer bands are thinned further, for they are drawn as polygons."""

ERROR = "error"
"""Label of a plot of errors."""

# Errors after a jump may leave the picture, so that the bound keeps a tenth of its height.
_MAX_TRANSIENT = 10.0

# Okabe and Ito's palette, which the colour-blind can tell apart; truth is also wider.
ESTIMATE_COLOUR = "#0072B2"
TRUTH_COLOUR = "#E69F00"
MEASUREMENT_COLOUR = "#8A8F98"
EVENT_COLOUR = "#D55E00"
SETTLING_COLOUR = "#F1F3F5"


_NOT_VOID = [basis for basis, (level, _) in BOUNDS.items() if level is Level.OK]


class Curve(NamedTuple):
    """Points of one curve: times [s] and values, both (n,)."""

    times: Array
    values: Array


class Plot(NamedTuple):
    """Curves over time; what is None is not drawn.

    Attributes:
        label: The quantity, or "error".
        limits: Range of values to show.
        dots: Measured values.
        truth: True values.
        estimate: Estimated values, or their error.
        bound: 1σ bound at the estimate's times, shape (n,).
        level: A constant ± line, e.g. what is expected of noise, and what to call it.
        other: Values of a second quantity, and what to call it.
        spans: Parts of the time that are marked, (begin, end) in seconds.
    """

    label: str
    limits: tuple[float, float]
    dots: Curve | None = None
    truth: Curve | None = None
    estimate: Curve | None = None
    bound: Array | None = None
    level: tuple[float, str] | None = None
    other: tuple[Curve, str] | None = None
    spans: tuple[tuple[float, float], ...] = ()

    def bands(self) -> Iterator[tuple[float, Array, Array, Array]]:
        """Yield the bands of 3σ and 1σ as (σ, times, lower edge, upper edge), thinned."""
        if self.estimate is None or self.bound is None:
            return
        step = -(-len(self.bound) // MAX_BAND)
        times, values, bound = (each[::step] for each in (*self.estimate, self.bound))
        centre = np.zeros(len(times)) if self.label == ERROR else values
        for sigmas in (SIGMAS, 1.0):
            yield sigmas, times, centre - sigmas * bound, centre + sigmas * bound


class Panel(NamedTuple):
    """One quantity.

    Attributes:
        unit: Of the values.
        remark: Phrases on how good the estimate is.
        values: Its values.
        error: Estimate − truth; None without truth.
    """

    unit: str
    remark: tuple[str, ...]
    values: Plot
    error: Plot | None = None


def panels(
    run: RecordedRun, metrics: RunMetrics, innovation_std: float | None = None
) -> list[Panel]:
    """Return a run's panels: four states, disturbance and, if recorded, innovations and health.

    Args:
        run: The recorded run.
        metrics: Its metrics.
        innovation_std: 1σ the design expects of an innovation [rad]; None if unknown.
    """
    error = errors(run)
    made = [
        _panel(run, metrics, place, None if error is None else error[:, place])
        for place in range(len(QUANTITIES))
    ]
    if run.innovations is not None and len(run.innovations.stamps):
        made.append(_innovation_panel(run, metrics, innovation_std))
    if run.health is not None and len(run.health.stamps):
        made.append(_health_panel(run.health, run.origin))
    return made


def thin(curve: Curve) -> Curve:
    """Return every k-th point, so that at most `MAX_CURVE` are left."""
    step = -(-len(curve.times) // MAX_CURVE) or 1
    return Curve(curve.times[::step], curve.values[::step])


def time_range(run: RecordedRun) -> tuple[float, float]:
    """Return the begin and end of the time axis [s]: all measurements and estimates."""
    measured = run.measurements.ordered().seconds(run.origin)
    last = float(measured[-1]) if len(measured) else 0.0
    # A stamp from a wrong clock must not squeeze the rest.
    end = float(run.times[-1])
    return 0.0, last if end <= last <= end + 1.0 else end


def settling_spans(run: RecordedRun, metrics: RunMetrics) -> Iterator[tuple[float, float]]:
    """Yield the parts of a run that do not count as settled, (begin, end) in seconds."""
    begin = float(run.times[0])
    for window_begin, window_end in metrics.windows:
        yield begin, window_begin
        begin = window_end
    if begin < run.times[-1]:
        yield begin, float(run.times[-1])


def headline(run: RecordedRun, metrics: RunMetrics) -> str:
    """Return one line on the run as a whole."""
    parts = [f"{metrics.duration:.1f} s", f"{metrics.estimates} estimates"]
    parts.append(f"{metrics.measurements} measurements")
    if metrics.normalised_rmse is not None:
        parts.append(f"normalised RMSE {metrics.normalised_rmse:.3g}")
    if metrics.nis is not None:
        parts.append(f"innovation² / expected {metrics.nis:.2f}")
    if run.truth is None:
        parts.append("no ground truth recorded")
    return "  ·  ".join(parts)


def _panel(run: RecordedRun, metrics: RunMetrics, place: int, error: Array | None) -> Panel:
    quantity = QUANTITIES[place]
    values = np.column_stack([run.states, run.disturbance])[:, place]
    bounds = np.column_stack([run.state_bounds, run.disturbance_bounds])[:, place]
    source, column = (run.true_disturbance, 0) if place == 4 else (run.truth, place)
    truth = dots = None
    if source is not None:
        truth = Curve(source.seconds(run.origin), source.values[:, column])
    if place == 0:
        measured = run.measurements.ordered()
        dots = Curve(measured.seconds(run.origin), measured.values[:, 0])
    estimate = thin(Curve(run.times, values))
    bound = thin(Curve(run.times, bounds)).values
    shown = Plot(
        label=quantity.name,
        limits=_limits(dots, truth, estimate, bound),
        dots=None if dots is None else thin(dots),
        truth=None if truth is None else thin(truth),
        estimate=estimate,
        bound=bound,
    )
    errors_shown = None
    if error is not None and np.isfinite(error).any():
        size = _max_error(run, metrics, error, bounds)
        curve = thin(Curve(run.times, error))
        errors_shown = Plot(ERROR, (-size, size), estimate=curve, bound=bound)
    return Panel(quantity.unit, _remark(metrics, quantity), shown, errors_shown)


def _innovation_panel(run: RecordedRun, metrics: RunMetrics, std: float | None) -> Panel:
    assert run.innovations is not None
    curve = Curve(run.innovations.seconds(run.origin), run.innovations.values[:, 0])
    finite = curve.values[np.isfinite(curve.values)]
    size = 1.2 * float(np.quantile(np.abs(finite), 0.998)) if len(finite) else 1.0
    size = max(size, 3.5 * (std or 0.0)) or 1.0
    level = None if std is None else (SIGMAS * std, f"±{SIGMAS:g}σ expected")
    remark = () if metrics.nis is None else (f"mean square {metrics.nis:.2f} × expected",)
    return Panel("rad", remark, Plot("innovation", (-size, size), dots=thin(curve), level=level))


def _health_panel(health: Series, origin: int) -> Panel:
    """Return the history of noise scale and coloured power; void bounds are marked."""
    times, values = health.seconds(origin), health.values
    scale, coloured = Curve(times, values[:, 0]), Curve(times, values[:, 1])
    void = ~np.isin(values[:, 2], _NOT_VOID)
    low, high = min(0.0, float(coloured.values.min())), float(max(scale.values.max(), 1.5))
    high = max(high, float(coloured.values.max()))
    margin = 0.08 * (high - low)
    taken_for = [
        f"{100.0 * share:.3g} % {_words(one)}"
        for one in Hypothesis
        if (share := (values[:, 4] == one).mean())
    ]
    remark = (
        f"median {np.median(scale.values):.2f}, at most {scale.values.max():.2f}",
        f"marked: void bound, {100.0 * void.mean():.3g} %",
        *taken_for,
    )
    plot = Plot(
        "noise scale",
        (low - margin, high + margin),
        estimate=thin(scale),
        other=(thin(coloured), "coloured power"),
        spans=tuple(_spans(times, void)),
    )
    return Panel("design's = 1", remark, plot)


def _words(code: Hypothesis) -> str:
    return code.name.lower().replace("_", " ")


def _spans(times: Array, marked: NDArray[np.bool_]) -> Iterator[tuple[float, float]]:
    """Yield begin and end of each run of marked times."""
    edges = np.flatnonzero(np.diff(marked.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    for begin, end in edges.tolist():
        yield float(times[begin]), float(times[min(end, len(times) - 1)])


def _remark(metrics: RunMetrics, quantity: Quantity) -> tuple[str, ...]:
    measured = metrics[quantity.key]
    lines = []
    if measured.rmse is not None:
        lines.append(f"RMSE {measured.rmse:.2g}")
    if measured.bound is not None:
        lines.append(f"1σ bound {measured.bound:.2g}")
    if measured.inside is not None:
        lines.append(f"{100.0 * measured.inside:.4g} % inside {SIGMAS:g}σ")
    return tuple(lines)


def _max_error(run: RecordedRun, metrics: RunMetrics, error: Array, bounds: Array) -> float:
    """Return a size with all settled errors and bounds inside, and most of what a jump does."""
    settled = inside_windows(run.times, metrics.windows)
    after_start = run.times >= (metrics.windows[0][0] if metrics.windows else 0.0)
    transient = np.minimum(1.1 * np.abs(error), _MAX_TRANSIENT * bounds)
    joined = np.concatenate(
        [(SIGMAS + 1.0) * bounds[settled], 1.2 * np.abs(error[settled]), transient[after_start]]
    )
    return float(joined[np.isfinite(joined)].max(initial=0.0)) or 1.0


def _limits(
    dots: Curve | None, truth: Curve | None, estimate: Curve, bound: Array
) -> tuple[float, float]:
    """Return a range with all truth and nearly all else: the first guesses may be far off."""
    edges = []
    if truth is not None and np.isfinite(truth.values).any():
        edges += [float(np.nanmin(truth.values)), float(np.nanmax(truth.values))]
    for values, share in (
        (estimate.values, 0.01),
        (estimate.values + SIGMAS * bound, 0.1),
        (estimate.values - SIGMAS * bound, 0.1),
        (np.empty(0) if dots is None else dots.values, 0.002),
    ):
        finite = values[np.isfinite(values)]
        if len(finite):
            edges += np.quantile(finite, [share, 1.0 - share]).tolist()
    low, high = (min(edges), max(edges)) if edges else (-1.0, 1.0)
    margin = 0.08 * (high - low) or 0.1
    return low - margin, high + margin
