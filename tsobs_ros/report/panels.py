# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Panels of curves on one time axis: the content of a run's figure and of its page."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.estimation.health import Level, words
from tsobs_ros.estimation.records import Hypothesis
from tsobs_ros.replay.health import CLAIMED, HYPOTHESIS
from tsobs_ros.replay.thinning import ThinnedValues
from tsobs_ros.report.diagnosed import Diagnosed, FaultSpan
from tsobs_ros.report.metrics import SIGMAS, Event, RunMetrics, inside_windows
from tsobs_ros.report.quantities import Quantity
from tsobs_ros.report.run import MAX_GAP, RecordedRun, align
from tsobs_ros.series import NANOSECONDS

MAX_CURVE = 5000
"""Longer curves are thinned: more points than pixels only make files large."""

MAX_BAND = 1500
"""Longer bands are thinned further, for they are drawn as polygons."""

# Thinned only if there are so many times more points.
_WAITING = 3
_FOR_QUANTILES = 20_000
# Measurements may be ahead of the estimates of a part [s].
_MAX_AHEAD = 4.0

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


LINE_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#52606D")
RIVAL_COLOUR = "#009E73"
LEVEL_COLOURS = {Level.OK: "#56B4E9", Level.WARN: "#E69F00", Level.ERROR: "#D55E00"}

TIME = "time since the first sample [s]"

# Autocorrelation is of so many samples, and its white band is of so many standard deviations.
_MAX_LAG = 40
_WHITE = 2.0
# Delays beyond this are of two clocks [s].
_OTHER_CLOCK = 10.0
# Of what is published ten times a second, a longer silence is a gap [s].
_SLOW_GAP = 1.0


class Curve(NamedTuple):
    """Points of one curve: times [s] and values, both (n,)."""

    times: Array
    values: Array


class Bands(NamedTuple):
    """Edges of the bands of 3σ and of 1σ.

    Attributes:
        times: [s], shape (n,).
        edges: Lower 3σ, lower 1σ, upper 1σ and upper 3σ, shape (n, 4).
    """

    times: Array
    edges: Array

    def __iter__(self) -> Iterator[Any]:
        """Yield the bands as (σ, times, lower edge, upper edge)."""
        for place, sigmas in enumerate((SIGMAS, 1.0)):
            yield sigmas, self.times, self.edges[:, place], self.edges[:, 3 - place]


class Strip(NamedTuple):
    """A time for which something is reported.

    Attributes:
        name: What it is.
        begin: In seconds.
        end: In seconds.
        level: How bad it is.
    """

    name: str
    begin: float
    end: float
    level: Level


class Line(NamedTuple):
    """One of several curves of a plot.

    Attributes:
        name: For the plot's own legend.
        curve: The curve.
        colour: Of the palette.
    """

    name: str
    curve: Curve
    colour: str


class Plot(NamedTuple):
    """Curves over time; what is None is not drawn.

    Attributes:
        label: The quantity, or "error".
        limits: Range of values to show.
        dots: Measured values.
        dense: Whether those are only the extremes of so many that they are drawn as a line.
        truth: True values.
        estimate: Estimated values, or their error.
        bands: Bounds of it.
        level: A constant ± line, e.g. what is expected of noise, and what to call it.
        other: Values of a second quantity, and what to call it.
        spans: Parts of the time that are marked, (begin, end) in seconds.
        rival: Values estimated by the EKF, or their error.
        lines: Several curves, with names of their own.
        strips: Times for which something is reported; the plot then has no values.
        axis: Label of the horizontal axis; another one than `TIME` does not follow the others.
    """

    label: str
    limits: tuple[float, float]
    dots: Curve | None = None
    dense: bool = False
    truth: Curve | None = None
    estimate: Curve | None = None
    bands: Bands | None = None
    level: tuple[float, str] | None = None
    other: tuple[Curve, str] | None = None
    spans: tuple[tuple[float, float], ...] = ()
    rival: Curve | None = None
    lines: tuple[Line, ...] = ()
    strips: tuple[Strip, ...] = ()
    axis: str = TIME


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


class Picture(NamedTuple):
    """What the figure and the page of a run show.

    Attributes:
        name: The run's origin.
        headline: A line on the run as a whole.
        panels: States, disturbances, torque disturbances and, if recorded, innovations and health.
        time_range: Begin and end of the time axis [s]: all measurements and estimates.
        unsettled: Parts that do not count as settled, (begin, end) in seconds.
        events: The start and the jumps.
        has_truth: Whether any truth was recorded.
        timing: How regular measurements came.
    """

    name: str
    headline: str
    panels: tuple[Panel, ...]
    time_range: tuple[float, float]
    unsettled: tuple[tuple[float, float], ...]
    events: tuple[Event, ...]
    has_truth: bool
    timing: "TimingSummary"


def picture(
    run: RecordedRun | Iterable[RecordedRun],
    metrics: RunMetrics,
    innovation_std: Sequence[float] = (),
    outputs: Sequence[tuple[str, str]] = (("link angle", "rad"),),
    *,
    inputs: Sequence[tuple[str, str]] = (("applied torque", "N m"),),
    learnt: Sequence[str] = (),
    period: float | None = None,
    diagnosed: Diagnosed | None = None,
    rival: Mapping[str, tuple[Curve, Curve]] | None = None,
) -> Picture:
    """Return what is shown of a run.

    Args:
        run: The recorded run, or its parts.
        metrics: Its metrics.
        innovation_std: 1σ the design expects of each output's innovation; empty if unknown.
        outputs: Names of the outputs with their units.
        inputs: Names of the inputs with their units.
        learnt: Names of the parameters that are learnt.
        period: Time between measurements by the design [s]; the median one if None.
        diagnosed: What the observer's diagnostics have.
        rival: Estimates of the EKF and their errors, by the quantities' keys.
    """
    quantities: list[_Quantity] = []
    innovations = [(_Extremes(), ThinnedValues(_FOR_QUANTILES)) for _ in outputs]
    health, parameters = _Health(), _Parameters(learnt)
    timing, applied = _Timing(period), [_Extremes() for _ in inputs]
    correlations = [_Autocorrelation() for _ in outputs]
    first, last, measured, part = math.inf, 0.0, 0.0, None
    known, has_truth = False, False
    for part in [run] if isinstance(run, RecordedRun) else run:
        quantities = quantities or [_Quantity(one, metrics) for one in part.quantities]
        if len(part.times):
            first, last = min(first, float(part.times[0])), float(part.times[-1])
        measured = max(measured, float(part.measurements.seconds(part.origin).max(initial=0.0)))
        known |= part.truth is not None
        for quantity in quantities:
            has_truth |= quantity.add(part)
        timing.add(part)
        samples = part.measurements.ordered()
        times = samples.seconds(part.origin)
        own = (times >= 0.0) & (times <= part.times.max(initial=0.0) + _MAX_AHEAD)
        for curve, values in zip(applied, samples.values.T[len(outputs) :], strict=False):
            curve.add(times[own], values[own])
        if part.innovations is not None and len(part.innovations.stamps):
            times = part.innovations.seconds(part.origin)
            settled = inside_windows(times, metrics.windows)
            for (curve, sizes), white, values in zip(
                innovations, correlations, part.innovations.values.T, strict=True
            ):
                there = np.isfinite(values)
                curve.add(times[there], values[there])
                sizes.add(np.abs(values[there]))
                white.add(np.where(settled, values, np.nan))
        if part.health is not None and len(part.health.stamps):
            health.add(part.health.seconds(part.origin), part.health.values)
        parameters.add(part)
    assert part is not None, "a run has a part"
    rivals = rival or {}
    made = [quantity.panel(rivals.get(quantity.key)) for quantity in quantities]
    for (name, unit), extremes in zip(inputs, applied, strict=True):
        if extremes.there and np.isfinite((drawn := extremes.curve()).values).any():
            made.append(_lines_panel(name, unit, {"applied": drawn}))
    diagnosed = diagnosed or Diagnosed()
    if diagnosed.faults:
        made.append(_fault_panel(diagnosed.faults))
    for place, ((curve, sizes), (name, unit)) in enumerate(zip(innovations, outputs, strict=True)):
        if curve.there:
            label = "innovation" if len(outputs) == 1 else f"innovation of {name}"
            std = innovation_std[place] if innovation_std else None
            nis = metrics.output_nis[place] if metrics.output_nis else None
            panel = _innovation_panel(label, unit, (curve.curve(), sizes), nis, std)
            made.append(panel._replace(values=panel.values._replace(dense=curve.dense)))
            made += correlations[place].panel(label, timing.period)
    if health.count:
        made.append(health.panel())
    made += parameters.panels()
    made += timing.panels(diagnosed)
    if diagnosed.reject_rates:
        rates = diagnosed.reject_rates.items()
        made.append(_lines_panel("rejected", "1/s", {name: Curve(*each) for name, each in rates}))
    return Picture(
        name=part.name,
        headline=_headline(metrics, has_truth=known),
        panels=tuple(made),
        # A stamp from a wrong clock must not squeeze the rest.
        time_range=(0.0, measured if last <= measured <= last + 1.0 else last),
        unsettled=tuple(_unsettled(first, last, metrics)),
        events=metrics.events,
        has_truth=has_truth,
        timing=timing.summary(),
    )


class RivalCurves:
    """Gathers what EKFs estimate of a joint, part by part.

    Args:
        joint: The joint's name.
        origin: Stamp that times count from [ns].

    Attributes:
        until: Newest time of theirs [s].
    """

    until = -math.inf

    def __init__(self, joint: str, origin: int) -> None:
        self._joint, self._origin = joint, origin
        self._curves: dict[tuple[str, str], tuple[_Extremes, _Extremes]] = {}

    def add(self, part: RecordedRun) -> None:
        """Add a part of the run of one of them."""
        if part.joint != self._joint:
            return
        times = np.asarray((part.stamps - self._origin) / NANOSECONDS, np.float64)
        self.until = max(self.until, float(times.max(initial=-math.inf)))
        for quantity in part.quantities:
            one = part.of(quantity)
            curves = self._curves.setdefault((part.name, quantity.key), (_Extremes(), _Extremes()))
            for curve, values in zip(curves, (one.values, one.error), strict=True):
                curve.add(times, values)

    def of(self, method: str) -> dict[str, tuple[Curve, Curve]]:
        """Return the estimates of an EKF and their errors by the quantities' keys."""
        return {
            key: (values.curve(), error.curve())
            for (name, key), (values, error) in self._curves.items()
            if name == method and values.there
        }


def thin(curve: Curve, max_points: int = MAX_CURVE) -> Curve:
    """Return the lowest and the highest point of each of equal times, if there are too many.

    Args:
        curve: In ascending order of times.
        max_points: The largest number of points that are left.
    """
    times, values = curve
    if len(times) <= max_points:
        return curve
    begins = _begins(times, max_points // 2)
    owner = np.repeat(np.arange(len(begins)), np.diff(begins, append=len(times)))
    finite = np.isfinite(values)
    lowest = np.minimum.reduceat(np.where(finite, values, np.inf), begins)[owner]
    highest = np.maximum.reduceat(np.where(finite, values, -np.inf), begins)[owner]
    low, high = np.flatnonzero(values == lowest), np.flatnonzero(values == highest)
    kept = np.zeros(len(times), np.bool_)
    kept[low[np.diff(owner[low], prepend=-1) != 0]] = True
    kept[high[np.diff(owner[high], append=-1) != 0]] = True
    kept[begins[np.isinf(lowest[begins])]] = True
    return Curve(times[kept], values[kept])


def _begins(times: Array, count: int) -> NDArray[np.intp]:
    """Return the place of the first time in each of as many equal times that has any."""
    edges = np.linspace(times[0], times[-1], count + 1)[:-1]
    begins = np.searchsorted(times, edges)
    return begins[np.diff(begins, append=len(times)) > 0]


def _gaps(times: Array, before: float, max_gap: float) -> tuple[NDArray[np.intp], Array]:
    """Return the places behind gaps longer than so many seconds, and times within those."""
    steps = np.diff(times, prepend=before)
    (places,) = np.nonzero(steps > max_gap)
    return places, times[places] - 0.5 * steps[places]


class _Extremes:
    """A curve that is thinned as it grows; none of its extremes is lost, gaps stay gaps."""

    def __init__(self, max_gap: float = MAX_GAP) -> None:
        self._parts: list[Curve] = []
        self._count = self._total = 0
        self._last, self._max_gap = math.nan, max_gap

    @property
    def there(self) -> bool:
        return self._count > 0

    @property
    def dense(self) -> bool:
        """Whether only the extremes are left."""
        return self._total > MAX_CURVE

    def add(self, times: Array, values: Array) -> None:
        if len(times):
            gaps = _gaps(times, self._last, self._max_gap)
            self._last = float(times[-1])
            times, values = np.insert(times, *gaps), np.insert(values, gaps[0], np.nan)
        self._parts.append(Curve(times, values))
        self._count += len(times)
        self._total += len(times)
        if self._count > _WAITING * MAX_CURVE:
            self._parts = [self.curve()]
            self._count = len(self._parts[0].times)

    def curve(self) -> Curve:
        times, values = (np.concatenate(each) for each in zip(*self._parts, strict=True))
        order = np.argsort(times, kind="stable")
        return thin(Curve(times[order], values[order]))


class _Ranges:
    """Bands that are thinned as they grow, so that each is as wide as it ever was at its time."""

    def __init__(self, max_gap: float = MAX_GAP) -> None:
        self._parts: list[Bands] = []
        self._count = 0
        self._last, self._max_gap = math.nan, max_gap

    def add(self, times: Array, centre: Array, bound: Array) -> None:
        edges = np.column_stack(
            [centre + sigmas * bound for sigmas in (-SIGMAS, -1.0, 1.0, SIGMAS)]
        )
        if len(times):
            places, between = _gaps(times, self._last, self._max_gap)
            self._last = float(times[-1])
            times = np.insert(times, places, between)
            edges = np.insert(edges, places, np.nan, axis=0)
        self._parts.append(Bands(times, edges))
        self._count += len(times)
        if self._count > _WAITING * MAX_BAND:
            self._parts = [self.bands()]
            self._count = len(self._parts[0].times)

    def bands(self) -> Bands:
        times = np.concatenate([part.times for part in self._parts])
        edges = np.concatenate([part.edges for part in self._parts])
        if len(times) <= MAX_BAND:
            return Bands(times, edges)
        begins = _begins(times, MAX_BAND)
        lower = np.fmin.reduceat(edges[:, :2], begins)
        return Bands(times[begins], np.hstack([lower, np.fmax.reduceat(edges[:, 2:], begins)]))


def _unsettled(first: float, last: float, metrics: RunMetrics) -> Iterator[tuple[float, float]]:
    begin = first
    for window_begin, window_end in metrics.windows:
        yield begin, window_begin
        begin = window_end
    if begin < last:
        yield begin, last


def _headline(metrics: RunMetrics, *, has_truth: bool) -> str:
    parts = [f"{metrics.duration:.1f} s", f"{metrics.estimates} estimates"]
    parts.append(f"{metrics.measurements} measurements")
    if metrics.normalised_rmse is not None:
        parts.append(f"normalised RMSE {metrics.normalised_rmse:.3g}")
    if metrics.nis is not None:
        parts.append(f"innovation² / expected {metrics.nis:.2f}")
    if not has_truth:
        parts.append("no ground truth recorded")
    return "  ·  ".join(parts)


class _Quantity:
    """Gathers the panel of an estimated quantity part by part.

    Args:
        quantity: The quantity.
        metrics: Metrics of the run.
    """

    def __init__(self, quantity: Quantity, metrics: RunMetrics) -> None:
        self.key = quantity.key
        self._quantity, self._metrics = quantity, metrics
        self._dots, self._truth = _Extremes(), _Extremes()
        self._estimate, self._error = _Extremes(), _Extremes()
        self._bands, self._error_bands = _Ranges(), _Ranges()
        self._error_is_known = False
        self._error_size = 0.0
        # Values, and the share of them on each side that need not be in the picture.
        self._shares = {
            name: (share, ThinnedValues(_FOR_QUANTILES))
            for name, share in (("estimate", 0.01), ("upper", 0.1), ("lower", 0.1), ("dots", 0.002))
        }

    def add(self, run: RecordedRun) -> bool:
        """Add a part, and return whether its truth is known."""
        one, key = run.of(self._quantity), self._quantity.key
        values, bound, truth = one.values, one.bounds, one.truth
        self._estimate.add(run.times, values)
        self._bands.add(run.times, values, bound)
        self._shares["estimate"][1].add(values)
        self._shares["upper"][1].add(values + SIGMAS * bound)
        self._shares["lower"][1].add(values - SIGMAS * bound)
        if truth is not None:
            own = run.covers(truth.stamps)
            self._truth.add(truth.seconds(run.origin)[own], truth.values[own, 0])
        if key in run.measured and len(run.measurements.stamps):
            measured = run.measurements.ordered()
            times, column = measured.seconds(run.origin), run.measured[key]
            # What is outside of the time axis must not squeeze the rest.
            own = (times >= 0.0) & (times <= run.times.max(initial=0.0) + _MAX_AHEAD)
            self._dots.add(times[own], measured.values[own, column])
            self._shares["dots"][1].add(measured.values[:, column])
        if truth is not None:
            error = one.error
            self._error_is_known |= bool(np.isfinite(error).any())
            self._error.add(run.times, error)
            self._error_bands.add(run.times, np.zeros(len(bound)), bound)
            size = _max_error(run, self._metrics, error, bound)
            self._error_size = max(self._error_size, size)
        return truth is not None

    def panel(self, rival: tuple[Curve, Curve] | None) -> Panel:
        quantity = self._quantity
        truth = self._truth.curve() if self._truth.there else None
        shown = Plot(
            label=quantity.name,
            limits=self._limits(truth),
            dots=self._dots.curve() if self._dots.there else None,
            dense=self._dots.dense,
            truth=truth,
            estimate=self._estimate.curve(),
            bands=self._bands.bands(),
            rival=None if rival is None else rival[0],
        )
        error = None
        if self._error_is_known:
            size = self._error_size or 1.0
            bands = self._error_bands.bands()
            curve, theirs = self._error.curve(), None if rival is None else rival[1]
            error = Plot(ERROR, (-size, size), estimate=curve, bands=bands, rival=theirs)
        return Panel(quantity.unit, _remark(self._metrics, quantity), shown, error)

    def _limits(self, truth: Curve | None) -> tuple[float, float]:
        """Return a range with all truth and nearly all else: the first guesses may be far off."""
        edges = []
        if truth is not None and np.isfinite(truth.values).any():
            edges += [float(np.nanmin(truth.values)), float(np.nanmax(truth.values))]
        for share, kept in self._shares.values():
            if len(kept.values):
                edges += np.quantile(kept.values, [share, 1.0 - share]).tolist()
        low, high = (min(edges), max(edges)) if edges else (-1.0, 1.0)
        margin = 0.08 * (high - low) or 0.1
        return low - margin, high + margin


def _innovation_panel(
    label: str,
    unit: str,
    shown: tuple[Curve, ThinnedValues],
    nis: float | None,
    std: float | None,
) -> Panel:
    curve, sizes = shown
    size = 1.2 * float(np.quantile(sizes.values, 0.998)) if len(sizes.values) else 1.0
    size = max(size, 3.5 * (std or 0.0)) or 1.0
    level = None if std is None else (SIGMAS * std, f"±{SIGMAS:g}σ expected")
    remark = () if nis is None else (f"mean square {nis:.2f} × expected",)
    return Panel(unit, remark, Plot(label, (-size, size), dots=curve, level=level))


def _around(curves: Iterable[Array], *, zero: bool = False) -> tuple[float, float]:
    """Return a range with all finite values, and with zero if that is asked for."""
    finite = [values[np.isfinite(values)] for values in curves]
    ends = [float(end) for values in finite if len(values) for end in (values.min(), values.max())]
    low, high = (min(ends), max(ends)) if ends else (0.0, 1.0)
    low, high = (min(low, 0.0), max(high, 0.0)) if zero else (low, high)
    margin = 0.08 * (high - low) or 0.1 * abs(high) or 0.1
    return low - margin, high + margin


def _lines_panel(
    label: str, unit: str, curves: Mapping[str, Curve], remark: Sequence[str] = ()
) -> Panel:
    lines = tuple(
        Line(name, thin(curve), colour)
        for (name, curve), colour in zip(curves.items(), cycle(LINE_COLOURS))
    )
    limits = _around([curve.values for curve in curves.values()], zero=len(curves) > 1)
    return Panel(unit, tuple(remark), Plot(label, limits, lines=lines))


def _fault_panel(faults: Sequence[FaultSpan]) -> Panel:
    strips = tuple(
        Strip(
            one.kind if not one.output else f"{one.kind}: {one.output}",
            one.begin,
            max(one.end, one.begin + 0.1),
            one.level,
        )
        for one in faults
    )
    names = list(dict.fromkeys(strip.name for strip in strips))
    words = {Level.OK: "small", Level.WARN: "warning", Level.ERROR: "error"}
    remark = [words.get(level, "error") for level in sorted({strip.level for strip in strips})]
    remark = [f"level: {', '.join(remark)}"]
    return Panel("", tuple(remark), Plot("sensor fault", (-0.6, len(names) - 0.4), strips=strips))


class _Autocorrelation:
    """Products of innovations some samples apart, summed up part by part."""

    def __init__(self) -> None:
        self._sums, self._counts = np.zeros(_MAX_LAG + 1), np.zeros(_MAX_LAG + 1)
        self._before = np.zeros(0)

    def add(self, values: Array) -> None:
        """Add innovations, NaN if they do not count."""
        joined = np.concatenate([self._before, values])
        known = np.isfinite(joined).astype(np.float64)
        filled, first = np.where(known > 0.0, joined, 0.0), len(self._before)
        for lag in range(_MAX_LAG + 1):
            begin = max(first, lag)
            late, early = slice(begin, None), slice(begin - lag, max(len(joined) - lag, 0))
            # Not by BLAS, whose threads cost more than so few numbers.
            self._sums[lag] += np.einsum("i,i", filled[late], filled[early])
            self._counts[lag] += np.einsum("i,i", known[late], known[early])
        self._before = joined[-_MAX_LAG:]

    def panel(self, label: str, period: float) -> list[Panel]:
        """Return the panel, none without enough innovations."""
        if self._counts[0] <= _MAX_LAG or not self._sums[0] > 0.0:
            return []
        mean = self._sums / np.maximum(self._counts, 1.0)
        curve = Curve(period * np.arange(1.0, _MAX_LAG + 1.0), (mean / mean[0])[1:])
        band = _WHITE / math.sqrt(self._counts[0])
        outside = int((np.abs(curve.values) > band).sum())
        size = 1.2 * max(float(np.abs(curve.values).max()), 2.0 * band)
        plot = Plot(
            f"autocorrelation of {label}",
            (-size, size),
            lines=(Line("autocorrelation", curve, LINE_COLOURS[0]),),
            level=(band, f"±{_WHITE:g}σ of white noise"),
            axis="lag [s]",
        )
        return [Panel("", (f"{outside} of {_MAX_LAG} lags outside",), plot)]


class _Parameters:
    """Gathers learnt parameters and their bounds part by part."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._curves = [_Extremes(_SLOW_GAP) for _ in names]
        self._bands = [_Ranges(_SLOW_GAP) for _ in names]
        self._last = [(0.0, math.nan) for _ in names]

    def add(self, run: RecordedRun) -> None:
        if run.parameters is None or not len(run.parameters.stamps):
            return
        times, values = run.parameters.seconds(run.origin), run.parameters.values
        bounds = np.full(values.shape, np.nan)
        if run.parameter_bounds is not None:
            bounds = align(run.parameter_bounds, run.parameters.stamps)
        for place, (curve, band) in enumerate(zip(self._curves, self._bands, strict=True)):
            curve.add(times, values[:, place])
            band.add(times, values[:, place], bounds[:, place])
            self._last[place] = float(values[-1, place]), float(bounds[-1, place])

    def panels(self) -> Iterator[Panel]:
        for name, curve, band, last in zip(
            self._names, self._curves, self._bands, self._last, strict=True
        ):
            if curve.there:
                drawn, bands = curve.curve(), band.bands()
                limits = _around([drawn.values, bands.edges[:, 0], bands.edges[:, 3]])
                remark = (f"at the end {last[0]:.3g} ± {last[1]:.2g}",)
                plot = Plot(f"learnt change of {name}", limits, estimate=drawn, bands=bands)
                yield Panel("", remark, plot)


class TimingSummary(NamedTuple):
    """How regular the measurements of a run came.

    Attributes:
        rate: Median rate [Hz]; None without two measurements.
        jitter: Standard deviation of the intervals between stamps, without gaps [s].
        max_interval: The largest interval [s].
        lost: Number of samples that are missing by the stamps.
        gaps: Number of intervals longer than `MAX_GAP`.
        latency: Median time from the stamp of a measurement to its recording [s]; None if stamps
            and recording are not on one clock.
    """

    rate: float | None = None
    jitter: float = 0.0
    max_interval: float = 0.0
    lost: int = 0
    gaps: int = 0
    latency: float | None = None


class _Timing:
    """Gathers intervals and delays of measurements part by part."""

    def __init__(self, period: float | None) -> None:
        self._period, self._last = period, math.nan
        self._intervals, self._rates = _Extremes(math.inf), _Extremes(math.inf)
        self._sizes = ThinnedValues(_FOR_QUANTILES)
        self._delays = {"measurements": _Extremes(), "estimates": _Extremes()}
        self._delay_sizes = {name: ThinnedValues(_FOR_QUANTILES) for name in self._delays}
        self._square, self._count, self._max, self._lost, self._gaps = 0.0, 0, 0.0, 0, 0

    @property
    def period(self) -> float:
        """Time between measurements [s]."""
        if self._period is None and len(self._sizes.values):
            return float(np.median(self._sizes.values))
        return self._period or 1.0

    def add(self, run: RecordedRun) -> None:
        times = np.unique(run.measurements.seconds(run.origin))
        times = times[(times >= 0.0) & (times <= run.times.max(initial=0.0) + _MAX_AHEAD)]
        steps = np.diff(times, prepend=self._last)
        if len(times):
            self._last = max(float(times[-1]), self._last) if self._count else float(times[-1])
        times, steps = times[steps > 0.0], steps[steps > 0.0]
        if len(times):
            self._sizes.add(steps)
            usual = steps[steps <= MAX_GAP]
            self._square += float(((usual - self.period) ** 2).sum())
            self._count += len(usual)
            self._max = max(self._max, float(steps.max()))
            self._lost += int(np.maximum(np.rint(steps / self.period) - 1.0, 0.0).sum())
            self._gaps += int((steps > MAX_GAP).sum())
            self._intervals.add(times, 1000.0 * steps)
        for name, series in (("measurements", run.delays), ("estimates", run.estimate_delays)):
            if series is not None and len(series.stamps):
                delays = series.values[:, 0]
                self._delays[name].add(series.seconds(run.origin), 1000.0 * delays)
                self._delay_sizes[name].add(delays)

    def summary(self) -> TimingSummary:
        if not len(self._sizes.values):
            return TimingSummary()
        delays = self._delay_sizes["measurements"].values
        latency = float(np.median(delays)) if len(delays) else math.inf
        return TimingSummary(
            rate=1.0 / float(np.median(self._sizes.values)),
            jitter=math.sqrt(self._square / max(self._count, 1)),
            max_interval=self._max,
            lost=self._lost,
            gaps=self._gaps,
            latency=latency if abs(latency) < _OTHER_CLOCK else None,
        )

    def panels(self, diagnosed: Diagnosed) -> list[Panel]:
        made, found = [], self.summary()
        if found.rate is not None:
            remark = (
                f"median {found.rate:.4g} Hz, jitter {1e3 * found.jitter:.3f} ms",
                f"{found.lost} lost, {found.gaps} gaps, at most {1e3 * found.max_interval:.3g} ms",
            )
            curve = self._intervals.curve()
            plot = Plot("measurement interval", _around([curve.values], zero=True), dots=curve)
            plot = plot._replace(dense=self._intervals.dense)
            made.append(Panel("ms", remark, plot))
        if found.latency is not None:
            curves = {
                name: curve.curve()
                for name, curve in self._delays.items()
                if curve.there and abs(np.median(self._delay_sizes[name].values)) < _OTHER_CLOCK
            }
            medians = tuple(
                f"{name}: median {1e3 * np.median(self._delay_sizes[name].values):.2g} ms"
                for name in curves
            )
            made.append(_lines_panel("stamp to recording", "ms", curves, medians))
        for what, unit in (("latency", "ms"), ("tick time", "ms")):
            own = {
                name.removeprefix(f"{what} ").removesuffix(f" [{unit}]"): Curve(*each)
                for name, each in diagnosed.timing.items()
                if name.startswith(what)
            }
            if own:
                made.append(_lines_panel(f"{what} of the node", unit, own))
        return made


class _Health:
    """Gathers the history of noise scale and coloured power, and when no bound is claimed."""

    def __init__(self) -> None:
        self.count = 0
        self._scale, self._coloured = _Extremes(_SLOW_GAP), _Extremes(_SLOW_GAP)
        self._scales = ThinnedValues(_FOR_QUANTILES)
        self._void = 0
        self._hypotheses = np.zeros(len(Hypothesis), np.int64)
        # Times from which on no bound is claimed, and one is again, in turn.
        self._edges: list[float] = []
        self._last = 0.0

    def add(self, times: Array, values: Array) -> None:
        self._scale.add(times, values[:, 0])
        self._coloured.add(times, values[:, 1])
        self._scales.add(values[:, 0])
        void = values[:, CLAIMED] == 0.0
        was_void = len(self._edges) % 2
        changes = np.diff(void.astype(np.int8), prepend=was_void) != 0
        self._edges += times[changes].tolist()
        self._void += int(void.sum())
        self._hypotheses += [(values[:, HYPOTHESIS] == one).sum() for one in Hypothesis]
        self.count, self._last = self.count + len(times), float(times[-1])

    def panel(self) -> Panel:
        scale, coloured = self._scale.curve(), self._coloured.curve()
        known = self._scales.values
        sizes = "not known"
        if len(known):
            sizes = f"median {np.median(known):.2f}, at most {np.nanmax(scale.values):.2f}"
        shares = zip(Hypothesis, (self._hypotheses / self.count).tolist(), strict=True)
        remark = (
            sizes,
            f"marked: no bound is claimed, {100.0 * self._void / self.count:.3g} %",
            *(f"{100.0 * share:.3g} % {words(one)}" for one, share in shares if share),
        )
        ends = [*self._edges, self._last][: 2 * ((len(self._edges) + 1) // 2)]
        plot = Plot(
            "noise scale",
            _around([scale.values, coloured.values, np.array([1.5])], zero=True),
            estimate=scale,
            other=(coloured, "coloured power"),
            spans=tuple(zip(ends[::2], ends[1::2], strict=True)),
        )
        return Panel("design's = 1", remark, plot)


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
    return float(joined[np.isfinite(joined)].max(initial=0.0))
