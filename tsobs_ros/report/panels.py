# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Plots of a run as data: curves, bands and strips, for its figure and for its page."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import cycle
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array, Flags
from tsobs_ros.estimation.health import Level
from tsobs_ros.replay.health import CLAIMED
from tsobs_ros.report.diagnosed import Diagnosed, FaultSpan
from tsobs_ros.report.metrics import SIGMAS, QuantityMetrics, RunMetrics, inside_windows
from tsobs_ros.report.quantities import Quantity, inputs_of, measured_states, outputs_of
from tsobs_ros.report.run import MAX_GAP, RecordedRun, align
from tsobs_ros.series import NANOSECONDS, Series
from tsobs_ros.style import BLUE, GREEN, MUTED, ORANGE, PURPLE, RED

MAX_CURVE, MAX_BAND = 5000, 1500
"""Longer curves and bands are thinned: more points than pixels only make files large."""

TIME = "time since the first sample [s]"
EVENT_COLOUR, SETTLING_COLOUR, MEASUREMENT_COLOUR = RED, "#F1F3F5", "#8A8F98"
_LEVEL_COLOURS = {Level.OK: "#56B4E9", Level.WARN: ORANGE}
_MAX_FAULTS = 200

# Measurements may be ahead of the last estimate by this [s].
_MAX_AHEAD = 4.0
# Errors after a jump may leave the plot, so that the bound keeps a tenth of the plot's height.
_MAX_TRANSIENT = 10.0
# For topics published ten times per second, a longer silence is a gap [s].
_SLOW_GAP = 1.0


class Style(NamedTuple):
    """The look of a curve: its colour, its width [pt], and "-", "--", ":" or "." for dots."""

    colour: str
    width: float = 1.2
    dash: str = "-"


STYLES = {
    "measured": Style(MEASUREMENT_COLOUR, 0.6, "."),
    "true": Style(ORANGE, 3.0),
    "EKF": Style(GREEN, 1.0, ":"),
    "estimated": Style(BLUE),
    "simulated": Style(ORANGE, 1.8),
    "predicted": Style(BLUE),
}
"""Styles of curves that many plots have. The truth is wider, for those who cannot see colours."""
BAND_COLOUR = BLUE
_OTHERS = tuple(map(Style, (BLUE, RED, GREEN, PURPLE, "#56B4E9", ORANGE, MUTED)))


class Curve(NamedTuple):
    """A curve: its name, times [s] and values of shape (n,), NaN in gaps, and its look."""

    name: str
    times: Array
    values: Array
    style: Style


class Band(NamedTuple):
    """A band: its name, times [s], and edges of shape (n,), NaN if there is none."""

    name: str
    times: Array
    lower: Array
    upper: Array


class Plot(NamedTuple):
    """The content of one pair of axes.

    Attributes:
        label: The quantity.
        unit: Unit of the values, empty for none.
        limits: Range of values to show.
        curves: Curves, the first below the others.
        remark: Phrases about the plot.
        bands: Bands below the curves, the widest first.
        rows: Names of the values 0, 1, …, if these only stand for names.
        spans: Marked parts of the time, (begin, end) in seconds.
        level: Height of constant ± lines, e.g. the expected size of noise; 0 for none.
        axis: Label of the horizontal axis; an axis other than `TIME` is independent of the others.
    """

    label: str
    unit: str
    limits: tuple[float, float]
    curves: tuple[Curve, ...] = ()
    remark: tuple[str, ...] = ()
    bands: tuple[Band, ...] = ()
    rows: tuple[str, ...] = ()
    spans: tuple[tuple[float, float], ...] = ()
    level: float = 0.0
    axis: str = TIME

    @property
    def title(self) -> str:
        """The label with the unit."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    @property
    def own(self) -> tuple[Curve, ...]:
        """The curves that need a legend in this plot."""
        own = tuple(curve for curve in self.curves if curve.name not in STYLES)
        return own if len(own) > 1 and not self.rows else ()


class TimingSummary(NamedTuple):
    """The regularity of the measurements of a run.

    Attributes:
        rate: Median rate [Hz]; None without two measurements.
        jitter: Root mean square of the intervals less the nominal period, without gaps [s].
        max_interval: The largest interval [s].
        lost: Number of missing samples, judged by the stamps.
        gaps: Number of intervals longer than `MAX_GAP`.
    """

    rate: float | None = None
    jitter: float = 0.0
    max_interval: float = 0.0
    lost: int = 0
    gaps: int = 0


class Picture(NamedTuple):
    """The content of the figure and the page of a run, or of a fit.

    Attributes:
        rows: Each row has one plot, or a plot of values and a plot of their errors.
        time_range: Begin and end of the time axis [s]: all measurements and estimates.
        unsettled: Parts that do not count as settled, (begin, end) in seconds.
        jumps: Times of the true disturbances' jumps [s].
    """

    name: str
    headline: str
    rows: tuple[tuple[Plot, ...], ...]
    time_range: tuple[float, float]
    unsettled: tuple[tuple[float, float], ...] = ()
    jumps: tuple[float, ...] = ()
    timing: TimingSummary = TimingSummary()

    @property
    def plots(self) -> tuple[Plot, ...]:
        """All plots."""
        return tuple(plot for row in self.rows for plot in row)


class Table(NamedTuple):
    """A table of a page, which is not shown without rows.

    `numbers` is the place of the first column of numbers, which are aligned to the right.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: int = 1
    note: str = ""


def picture(
    run: RecordedRun,
    metrics: RunMetrics,
    innovation_std: Sequence[float] = (),
    *,
    diagnosed: Diagnosed | None = None,
    rival: RecordedRun | None = None,
) -> Picture:
    """Return the picture of a run.

    `innovation_std` is the 1σ that the design expects of each output's innovation, empty if
    unknown; `rival` is the run of an EKF.
    """
    diagnosed = diagnosed or Diagnosed()
    last, outputs = float(run.times[-1]), outputs_of(run.request)
    samples = run.part("measurements").ordered()
    times = samples.seconds(run.origin)
    # Samples outside of the time axis must not affect the limits.
    samples = samples.take((times >= 0.0) & (times <= last + _MAX_AHEAD))
    times = samples.seconds(run.origin)
    timing, intervals = _timing(times, 1.0 / run.request.rate)
    singles: list[Plot] = []
    inputs = zip(inputs_of(run.request), samples.values.T[len(outputs) :], strict=False)
    for (name, unit), values in inputs:
        if np.isfinite(values).any():
            singles.append(lines(name, unit, {"applied": (times, values)}, MAX_GAP))
    if diagnosed.faults:
        singles.append(_faults(diagnosed.faults))
    singles += _innovations(run, metrics, innovation_std, outputs)
    health = run.part("health")
    if len(health.stamps):
        singles.append(_health(health.seconds(run.origin), health.values))
    singles += _learnt(run)
    singles += intervals
    measured = float(run.part("measurements").seconds(run.origin).max(initial=0.0))
    settled = [edge for window in metrics.windows for edge in window]
    edges = [float(run.times[0]), *settled, last]
    return Picture(
        name=run.name,
        headline=_headline(metrics, run),
        rows=(
            *(_of_quantity(run, metrics, one, rival, samples) for one in run.quantities),
            *((plot,) for plot in singles),
        ),
        # A stamp from a wrong clock must not stretch the time axis.
        time_range=(0.0, measured if last <= measured <= last + 1.0 else last),
        unsettled=tuple(
            span for span in zip(edges[::2], edges[1::2], strict=True) if span[0] < span[1]
        ),
        jumps=tuple(one.time for one in metrics.jumps),
        timing=timing,
    )


def _headline(metrics: RunMetrics, run: RecordedRun) -> str:
    parts = [f"{metrics.duration:.1f} s", f"{metrics.estimates} estimates"]
    parts.append(f"{metrics.measurements} measurements")
    if metrics.normalised_rmse is not None:
        parts.append(f"normalised RMSE {metrics.normalised_rmse:.3g}")
    if metrics.nis is not None:
        parts.append(f"innovation² / expected {metrics.nis:.2f}")
    if "true_state" not in run.parts:
        parts.append("no ground truth recorded")
    return "  ·  ".join(parts)


def thin(values: Array) -> NDArray[np.intp]:
    """Return the places of the lowest and the highest value in each of equal groups of values.

    All places are returned if they are few. NaN stays if a group has nothing else.
    """
    if len(values) <= MAX_CURVE:
        return np.arange(len(values))
    size = -(-2 * len(values) // MAX_CURVE)
    groups = np.pad(values, (0, -len(values) % size), constant_values=np.nan).reshape(-1, size)
    known, begins = np.isfinite(groups), size * np.arange(len(groups))
    low = begins + np.where(known, groups, np.inf).argmin(axis=1)
    high = begins + np.where(known, groups, -np.inf).argmax(axis=1)
    return np.unique(np.concatenate([low, high]))


def _with_gaps(
    times: Array, kept: NDArray[np.intp], values: Array, max_gap: float
) -> tuple[Array, Array]:
    """Return kept times and their values, with NaN in the middle of gaps above `max_gap` [s]."""
    (places,) = np.nonzero(np.diff(times) > max_gap)
    between = 0.5 * (times[places] + times[places + 1])
    where = np.searchsorted(times[kept], between)
    return np.insert(times[kept], where, between), np.insert(values, where, np.nan, axis=0)


def thinned_curve(
    name: str, times: Array, values: Array, style: Style | None = None, max_gap: float = MAX_GAP
) -> Curve:
    """Return a curve of at most `MAX_CURVE` points, with NaN in gaps longer than `max_gap` [s].

    Times ascend [s]; times and values have shape (n,). The default style is that of the name.
    """
    style, kept = style or STYLES[name], thin(values)
    if style.dash == "." and len(kept) < len(values):
        style = style._replace(dash="-")  # only the extremes are left
    return Curve(name, *_with_gaps(times, kept, values[kept], max_gap), style)


def _bands(times: Array, centre: Array, bound: Array, max_gap: float = MAX_GAP) -> tuple[Band, ...]:
    """Return the bands of 3σ and 1σ; thinned, a band covers the extremes of its points."""
    groups, made = np.arange(0, len(times), max(1, -(-len(times) // MAX_BAND))), []
    for sigmas in (SIGMAS, 1.0):
        lower = np.fmin.reduceat(centre - sigmas * bound, groups)
        upper = np.fmax.reduceat(centre + sigmas * bound, groups)
        at, edges = _with_gaps(times, groups, np.stack([lower, upper], axis=1), max_gap)
        made.append(Band(f"bound {sigmas:g}σ", at, *edges.T))
    return tuple(made)


def lines(
    label: str, unit: str, curves: Mapping[str, tuple[Array, Array]], max_gap: float = math.inf
) -> Plot:
    """Return a plot of curves in different colours; `curves` has times [s] and values by name."""
    styled = zip(curves.items(), cycle(_OTHERS), strict=False)
    drawn = tuple(thinned_curve(name, *values, style, max_gap) for (name, values), style in styled)
    limits = limits_around([*(values for _, values in curves.values()), np.zeros(1)])
    return Plot(label, unit, limits, drawn)


def stretches(there: Flags) -> list[slice]:
    """Return the slice of each unbroken stretch of true values."""
    edges = np.flatnonzero(np.diff(there.astype(np.int8), prepend=0, append=0))
    return [slice(*ends) for ends in edges.reshape(-1, 2).tolist()]


def limits_around(values: Iterable[Array]) -> tuple[float, float]:
    """Return a range with all finite values and a margin."""
    finite = [each[np.isfinite(each)] for each in values]
    ends = [float(end) for each in finite if len(each) for end in (each.min(), each.max())]
    low, high = (min(ends), max(ends)) if ends else (0.0, 1.0)
    margin = 0.08 * (high - low) or 0.1 * abs(high) or 0.1
    return low - margin, high + margin


def _quantiles(values: Array, *shares: float) -> list[float]:
    """Return quantiles of the finite values; none without any."""
    finite = values[np.isfinite(values)]
    return np.quantile(finite, shares).tolist() if len(finite) else []


def _of_quantity(
    run: RecordedRun,
    metrics: RunMetrics,
    quantity: Quantity,
    rival: RecordedRun | None,
    samples: Series,
) -> tuple[Plot, ...]:
    """Return the plot of an estimated quantity and, with truth, that of its error."""
    one, times = run.of(quantity), run.times
    curves: list[Curve] = []
    wrong = [thinned_curve("true", times[[0, -1]], np.zeros(2), max_gap=math.inf)]
    edges = _quantiles(one.values, 0.002, 0.998)
    for sign in (-SIGMAS, SIGMAS):
        edges += _quantiles(one.values + sign * one.bounds, 0.1, 0.9)
    place = measured_states(run.request).get(quantity.key)
    if place is not None and len(samples.stamps):
        values = samples.values[:, place]
        curves.append(thinned_curve("measured", samples.seconds(run.origin), values))
        edges += _quantiles(values, 0.002, 0.998)
    if one.truth is not None:
        truth = one.truth.values[:, 0]
        curves.append(thinned_curve("true", one.truth.seconds(run.origin), truth))
        edges += _quantiles(truth, 0.0, 1.0)
    if rival is not None:
        theirs, at = rival.of(quantity), (rival.stamps - run.origin) / NANOSECONDS
        curves.append(thinned_curve("EKF", at, theirs.values))
        wrong.append(thinned_curve("EKF", at, theirs.error))
    curves.append(thinned_curve("estimated", times, one.values))
    wrong.append(thinned_curve("estimated", times, one.error))
    bands, limits = _bands(times, one.values, one.bounds), limits_around([np.array(edges)])
    plot = Plot(quantity.name, quantity.unit, limits, tuple(curves), bands=bands)
    remark = _remark(metrics[quantity.key])
    if not np.isfinite(one.error).any():
        return (plot._replace(remark=remark),)
    size = _max_error(run, metrics, one.error, one.bounds) or 1.0
    bands, limits = _bands(times, np.zeros(len(times)), one.bounds), (-size, size)
    label = f"{quantity.name}: error"
    return plot, Plot(label, quantity.unit, limits, tuple(wrong), remark, bands)


def _remark(one: QuantityMetrics) -> tuple[str, ...]:
    texts = "RMSE {:.2g}", "1σ bound {:.2g}", f"{{:.4g}} % inside {SIGMAS:g}σ"
    values = one.rmse, one.bound, one.inside and 100.0 * one.inside
    pairs = zip(texts, values, strict=True)
    return tuple(text.format(value) for text, value in pairs if value is not None)


def _max_error(run: RecordedRun, metrics: RunMetrics, error: Array, bounds: Array) -> float:
    """Return a limit above all settled errors and bounds, and most of the errors after a jump."""
    settled = inside_windows(run.times, metrics.windows)
    after_start = run.times >= (metrics.windows[0][0] if metrics.windows else 0.0)
    transient = np.minimum(1.1 * np.abs(error), _MAX_TRANSIENT * bounds)
    sizes = ((SIGMAS + 1.0) * bounds[settled], 1.2 * np.abs(error[settled]), transient[after_start])
    return max(float(one[np.isfinite(one)].max(initial=0.0)) for one in sizes)


def _faults(faults: Sequence[FaultSpan]) -> Plot:
    """Return the plot of faults as bars, a row for each sensor and kind."""
    names = [f"{one.kind}: {one.output}" if one.output else one.kind for one in faults]
    rows, curves = tuple(dict.fromkeys(names)), []
    for name, one in zip(names, faults[:_MAX_FAULTS], strict=False):
        ends = np.array([one.begin, max(one.end, one.begin + 0.1)])
        style = Style(_LEVEL_COLOURS.get(one.level, EVENT_COLOUR), 9.0)
        values = np.full(2, float(rows.index(name)))
        curves.append(Curve(f"{name}, {one.level.name}", ends, values, style))
    remark = ("blue: small", "orange: warning", "red: error")
    return Plot("sensor fault", "", (-0.6, len(rows) - 0.4), tuple(curves), remark, rows=rows)


def _innovations(
    run: RecordedRun, metrics: RunMetrics, stds: Sequence[float], outputs: Sequence[tuple[str, str]]
) -> Iterator[Plot]:
    innovation = run.part("innovation")
    times, columns = innovation.seconds(run.origin), innovation.values.T
    if not len(times):
        return
    for place, ((name, unit), values) in enumerate(zip(outputs, columns, strict=True)):
        there = np.isfinite(values)
        if not there.any():
            continue
        label = "innovation" if len(outputs) == 1 else f"innovation of {name}"
        std = stds[place] if stds else 0.0
        size = max(1.2 * _quantiles(np.abs(values), 0.998)[0], 3.5 * std) or 1.0
        nis = metrics.output_nis[place] if metrics.output_nis else None
        remark = [f"– – ±{SIGMAS:g}σ expected"] if std else []
        remark += [] if nis is None else [f"mean square {nis:.2f} × expected"]
        curve = thinned_curve("measured", times[there], values[there])._replace(name="innovation")
        yield Plot(label, unit, (-size, size), (curve,), tuple(remark), level=SIGMAS * std)


def _learnt(run: RecordedRun) -> Iterator[Plot]:
    learnt = run.part("parameters")
    times, values = learnt.seconds(run.origin), learnt.values
    if not len(times):
        return
    bounds = np.full(values.shape, np.nan)
    if "parameter_bound" in run.parts:
        bounds = align(run.part("parameter_bound"), learnt.stamps)
    names = run.request.uncertainty_model.names
    for name, value, bound in zip(names, values.T, bounds.T, strict=True):
        bands = _bands(times, value, bound, _SLOW_GAP)
        limits = limits_around([value, bands[0].lower, bands[0].upper])
        remark = (f"at the end {value[-1]:.3g} ± {bound[-1]:.2g}",)
        curve = thinned_curve("estimated", times, value, max_gap=_SLOW_GAP)
        yield Plot(f"learnt change of {name}", "", limits, (curve,), remark, bands)


def _health(times: Array, values: Array) -> Plot:
    """Return the plot of noise scale and coloured power, with times without a claim marked."""
    scale, coloured, void = values[:, 0], values[:, 1], values[:, CLAIMED] == 0.0
    ends = [*times.tolist(), *times[-1:].tolist()]  # the last value holds to the end
    return Plot(
        "noise scale",
        "design's = 1",
        limits_around([scale, coloured, np.array([0.0, 1.5])]),
        (
            thinned_curve("noise scale", times, scale, Style(BLUE), _SLOW_GAP),
            thinned_curve("coloured power", times, coloured, Style(MUTED, 1.0, "--"), _SLOW_GAP),
        ),
        (f"marked: no bound is claimed, {100.0 * void.mean():.3g} %",),
        spans=tuple((ends[one.start], ends[one.stop]) for one in stretches(void)),
    )


def _timing(times: Array, period: float) -> tuple[TimingSummary, tuple[Plot, ...]]:
    """Return the regularity of measurements expected every `period` [s], with a plot."""
    times = np.unique(times)
    steps = np.diff(times)
    if not len(steps):
        return TimingSummary(), ()
    usual = steps[steps <= MAX_GAP]
    found = TimingSummary(
        rate=1.0 / float(np.median(steps)),
        jitter=math.sqrt(np.square(usual - period).sum() / max(len(usual), 1)),
        max_interval=float(steps.max()),
        lost=int(np.maximum(np.rint(steps / period) - 1.0, 0.0).sum()),
        gaps=int((steps > MAX_GAP).sum()),
    )
    remark = (
        f"median {found.rate:.4g} Hz, jitter {1e3 * found.jitter:.3f} ms",
        f"{found.lost} lost, {found.gaps} gaps, at most {1e3 * found.max_interval:.3g} ms",
    )
    shown = {"interval": (times[1:], 1000.0 * steps)}
    return found, (lines("measurement interval", "ms", shown)._replace(remark=remark),)
