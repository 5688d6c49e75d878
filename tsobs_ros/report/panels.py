# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Panels of curves on one time axis: the content of a run's figure and of its page."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.estimation.events import BOUNDS
from tsobs_ros.estimation.health import Level
from tsobs_ros.estimation.records import Hypothesis
from tsobs_ros.replay.thinning import ThinnedValues
from tsobs_ros.report.metrics import SIGMAS, Event, RunMetrics, inside_windows
from tsobs_ros.report.quantities import Quantity
from tsobs_ros.report.run import RecordedRun

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


_NOT_VOID = [basis for basis, (level, _) in BOUNDS.items() if level is Level.OK]


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


class Plot(NamedTuple):
    """Curves over time; what is None is not drawn.

    Attributes:
        label: The quantity, or "error".
        limits: Range of values to show.
        dots: Measured values.
        truth: True values.
        estimate: Estimated values, or their error.
        bands: Bounds of it.
        level: A constant ± line, e.g. what is expected of noise, and what to call it.
        other: Values of a second quantity, and what to call it.
        spans: Parts of the time that are marked, (begin, end) in seconds.
    """

    label: str
    limits: tuple[float, float]
    dots: Curve | None = None
    truth: Curve | None = None
    estimate: Curve | None = None
    bands: Bands | None = None
    level: tuple[float, str] | None = None
    other: tuple[Curve, str] | None = None
    spans: tuple[tuple[float, float], ...] = ()


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
    """

    name: str
    headline: str
    panels: tuple[Panel, ...]
    time_range: tuple[float, float]
    unsettled: tuple[tuple[float, float], ...]
    events: tuple[Event, ...]
    has_truth: bool


def picture(
    run: RecordedRun | Iterable[RecordedRun],
    metrics: RunMetrics,
    innovation_std: Sequence[float] = (),
    outputs: Sequence[tuple[str, str]] = (("link angle", "rad"),),
) -> Picture:
    """Return what is shown of a run.

    Args:
        run: The recorded run, or its parts.
        metrics: Its metrics.
        innovation_std: 1σ the design expects of each output's innovation; empty if unknown.
        outputs: Names of the outputs with their units.
    """
    quantities: list[_Quantity] = []
    innovations = [(_Extremes(), ThinnedValues(_FOR_QUANTILES)) for _ in outputs]
    health = _Health()
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
        if part.innovations is not None and len(part.innovations.stamps):
            times = part.innovations.seconds(part.origin)
            for (curve, sizes), values in zip(innovations, part.innovations.values.T, strict=True):
                there = np.isfinite(values)
                curve.add(times[there], values[there])
                sizes.add(np.abs(values[there]))
        if part.health is not None and len(part.health.stamps):
            health.add(part.health.seconds(part.origin), part.health.values)
    assert part is not None, "a run has a part"
    made = [quantity.panel() for quantity in quantities]
    for place, ((curve, sizes), (name, unit)) in enumerate(zip(innovations, outputs, strict=True)):
        if curve.there:
            label = "innovation" if len(outputs) == 1 else f"innovation of {name}"
            std = innovation_std[place] if innovation_std else None
            nis = metrics.output_nis[place] if metrics.output_nis else None
            made.append(_innovation_panel(label, unit, (curve.curve(), sizes), nis, std))
    if health.count:
        made.append(health.panel())
    return Picture(
        name=part.name,
        headline=_headline(metrics, has_truth=known),
        panels=tuple(made),
        # A stamp from a wrong clock must not squeeze the rest.
        time_range=(0.0, measured if last <= measured <= last + 1.0 else last),
        unsettled=tuple(_unsettled(first, last, metrics)),
        events=metrics.events,
        has_truth=has_truth,
    )


def thin(curve: Curve, max_points: int = MAX_CURVE) -> Curve:
    """Return the lowest and the highest point of each of equal times, if there are too many.

    Args:
        curve: In ascending order of times.
        max_points: The largest number of points that are left.
    """
    times, values = curve
    if len(times) <= max_points:
        return curve
    bins = _bins(times, max_points // 2)
    begins = np.flatnonzero(np.diff(bins, prepend=-1))
    finite = np.isfinite(values)
    order = np.lexsort((values, ~finite, bins))
    counts = np.add.reduceat(finite, begins, dtype=np.int64)
    chosen = np.unique([order[begins], order[begins + np.maximum(counts - 1, 0)]])
    return Curve(times[chosen], values[chosen])


def _bins(times: Array, count: int) -> NDArray[np.int64]:
    """Return the number of each time among as many equal times."""
    edges = np.linspace(times[0], times[-1], count + 1)[1:-1]
    return np.searchsorted(edges, times, side="right").astype(np.int64)


class _Extremes:
    """A curve that is thinned as it grows; none of its extremes is lost."""

    def __init__(self) -> None:
        self._parts: list[Curve] = []
        self._count = 0

    @property
    def there(self) -> bool:
        return self._count > 0

    def add(self, times: Array, values: Array) -> None:
        self._parts.append(Curve(times, values))
        self._count += len(times)
        if self._count > _WAITING * MAX_CURVE:
            self._parts = [self.curve()]
            self._count = len(self._parts[0].times)

    def curve(self) -> Curve:
        times, values = (np.concatenate(each) for each in zip(*self._parts, strict=True))
        order = np.argsort(times, kind="stable")
        return thin(Curve(times[order], values[order]))


class _Ranges:
    """Bands that are thinned as they grow, so that each is as wide as it ever was at its time."""

    def __init__(self) -> None:
        self._parts: list[Bands] = []
        self._count = 0

    def add(self, times: Array, centre: Array, bound: Array) -> None:
        edges = [centre + sigmas * bound for sigmas in (-SIGMAS, -1.0, 1.0, SIGMAS)]
        self._parts.append(Bands(times, np.column_stack(edges)))
        self._count += len(times)
        if self._count > _WAITING * MAX_BAND:
            self._parts = [self.bands()]
            self._count = len(self._parts[0].times)

    def bands(self) -> Bands:
        times = np.concatenate([part.times for part in self._parts])
        edges = np.concatenate([part.edges for part in self._parts])
        if len(times) <= MAX_BAND:
            return Bands(times, edges)
        begins = np.flatnonzero(np.diff(_bins(times, MAX_BAND), prepend=-1))
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
        self._show("estimate", values)
        self._show("upper", values + SIGMAS * bound)
        self._show("lower", values - SIGMAS * bound)
        if truth is not None:
            own = run.covers(truth.stamps)
            self._truth.add(truth.seconds(run.origin)[own], truth.values[own, 0])
        if key in run.measured and len(run.measurements.stamps):
            measured = run.measurements.ordered()
            times, column = measured.seconds(run.origin), run.measured[key]
            # What is outside of the time axis must not squeeze the rest.
            own = (times >= 0.0) & (times <= run.times.max(initial=0.0) + _MAX_AHEAD)
            self._dots.add(times[own], measured.values[own, column])
            self._show("dots", measured.values[:, column])
        if truth is not None:
            error = one.error
            self._error_is_known |= bool(np.isfinite(error).any())
            self._error.add(run.times, error)
            self._error_bands.add(run.times, np.zeros(len(bound)), bound)
            size = _max_error(run, self._metrics, error, bound)
            self._error_size = max(self._error_size, size)
        return truth is not None

    def _show(self, name: str, values: Array) -> None:
        self._shares[name][1].add(values[np.isfinite(values)])

    def panel(self) -> Panel:
        quantity = self._quantity
        truth = self._truth.curve() if self._truth.there else None
        shown = Plot(
            label=quantity.name,
            limits=self._limits(truth),
            dots=self._dots.curve() if self._dots.there else None,
            truth=truth,
            estimate=self._estimate.curve(),
            bands=self._bands.bands(),
        )
        error = None
        if self._error_is_known:
            size = self._error_size or 1.0
            bands = self._error_bands.bands()
            error = Plot(ERROR, (-size, size), estimate=self._error.curve(), bands=bands)
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


class _Health:
    """Gathers the history of noise scale and coloured power; void bounds are marked."""

    def __init__(self) -> None:
        self.count = 0
        self._scale, self._coloured = _Extremes(), _Extremes()
        self._scales = ThinnedValues(_FOR_QUANTILES)
        self._void = 0
        self._hypotheses = np.zeros(len(Hypothesis), np.int64)
        # Times at which bounds become void and others again, in turn.
        self._edges: list[float] = []
        self._last = 0.0

    def add(self, times: Array, values: Array) -> None:
        self._scale.add(times, values[:, 0])
        self._coloured.add(times, values[:, 1])
        self._scales.add(values[:, 0])
        void = ~np.isin(values[:, 2], _NOT_VOID)
        was_void = len(self._edges) % 2
        changes = np.diff(void.astype(np.int8), prepend=was_void) != 0
        self._edges += times[changes].tolist()
        self._void += int(void.sum())
        self._hypotheses += [(values[:, 4] == one).sum() for one in Hypothesis]
        self.count, self._last = self.count + len(times), float(times[-1])

    def panel(self) -> Panel:
        scale, coloured = self._scale.curve(), self._coloured.curve()
        largest = float(scale.values.max())
        low = min(0.0, float(coloured.values.min()))
        high = max(largest, 1.5, float(coloured.values.max()))
        margin = 0.08 * (high - low)
        shares = zip(Hypothesis, (self._hypotheses / self.count).tolist(), strict=True)
        remark = (
            f"median {np.median(self._scales.values):.2f}, at most {largest:.2f}",
            f"marked: void bound, {100.0 * self._void / self.count:.3g} %",
            *(f"{100.0 * share:.3g} % {_words(one)}" for one, share in shares if share),
        )
        ends = [*self._edges, self._last][: 2 * ((len(self._edges) + 1) // 2)]
        plot = Plot(
            "noise scale",
            (low - margin, high + margin),
            estimate=scale,
            other=(coloured, "coloured power"),
            spans=tuple(zip(ends[::2], ends[1::2], strict=True)),
        )
        return Panel("design's = 1", remark, plot)


def _words(code: Hypothesis) -> str:
    return code.name.lower().replace("_", " ")


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
