# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of a fit: numbers, how well they predict, what the model lacks, and the residuals."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tsobs_ros import __version__
from tsobs_ros.checks import Array
from tsobs_ros.estimation.health import Level
from tsobs_ros.identification.fit import GATE
from tsobs_ros.identification.result import Fit, OutputFit
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.report.page import write_html
from tsobs_ros.report.panels import (
    MEASUREMENT_COLOUR,
    Curve,
    Picture,
    Plot,
    Strip,
    Style,
    limits_around,
    lines,
    thinned_curve,
)
from tsobs_ros.report.quantities import outputs_of
from tsobs_ros.report.summary import About, Summary, Table
from tsobs_ros.style import BLUE, MUTED, ORANGE

_EXPECTED = (0.8, 1.25)
"""Innovations by their expected size, of a model that is about right."""

_CORRELATED, _SIMULATED = 0.2, 50.0
"""Correlation of neighbours from which on there is more to predict, and a poor simulation [%]."""

_DOTS, _GROUPS = 2500, 40
"""Dots over another quantity than time, and groups of neighbours whose means are drawn."""

_MAX_LENGTH = 4096
"""Samples of which a spectrum is made, and of many such parts the mean."""

_WORDS = {"measurement_std": "noise", "std": "size"}
_SEEN = ("hardly", "yes")


def write_page(path: Path, fit: Fit, names: str) -> None:
    """Write a fit as a page that needs nothing but itself.

    Args:
        path: The page; it is replaced.
        fit: The fit.
        names: Of the recordings.

    Raises:
        OSError: The page cannot be written.
    """
    seconds = float(fit.traces.time[-1] - fit.traces.time[0])
    part = f"the {'held-out' if fit.samples[1] else 'last (fitted)'} {seconds:.3g} s"
    counts = "{:,} numbers  ·  {:,} samples fitted  ·  {:,} held out  ·  {:,} outliers".format(
        len(fit.numbers), *fit.samples, fit.outliers
    )
    facts = [
        ("recordings", names),
        ("rate", f"{fit.request.rate:g} Hz"),
        ("version of this report", f"tsobs_ros {__version__}"),
    ]
    elsewhere = "the tables have the numbers"
    about = About(_verdict(fit, part), (), facts, fit.notes, elsewhere, list(_tables(fit, part)))
    span = float(fit.traces.time[0]), float(fit.traces.time[-1])
    headline = f"{counts}  ·  figures: {part}"
    write_html(Picture(f"Fit to {names}", headline, tuple(_rows(fit)), span), path, about)


def _verdict(fit: Fit, part: str) -> Summary:
    """Return in plain words how well a fit predicts, what is not shown, and what it lacks."""
    ahead = _listed([_percent(each.one_step) for each in fit.outputs])
    simulated = _listed([_percent(each.free_run) for each in fit.outputs])
    outputs = _listed([f"the {_words(each.name)}" for each in fit.outputs])
    prediction = (
        f"Of {outputs} in {part}, it predicts {ahead} one sample ahead and {simulated} over "
        f"{fit.outputs[0].horizon:g} s from the torque alone."
    )
    faults = [fault for each in fit.outputs for fault in _faults(each)]
    hidden = [each.name for each in fit.numbers if not each.seen]
    of = f"{len(hidden)} of {len(fit.numbers)} numbers: {_listed([*map(_words, hidden)])}"
    seen = f"The recordings hardly show {of}." if hidden else "The recordings show all numbers."
    added, still = (
        "; ".join(each.what for each in fit.lacks if each.is_added == there)
        for there in (True, False)
    )
    found = (f"Found, and in the fitted request: {added}.",) if added else ()
    lack = f"The model still lacks {still or 'nothing that the recordings show'}."
    unseen = any(name.startswith("arm.") for name in hidden)
    level = Level.WARN if faults or still or unseen else Level.OK
    sentences = (prediction, *faults, seen, *found, lack)
    return Summary(level, sentences)


def _faults(output: OutputFit) -> Iterator[str]:
    """Yield what is wrong with the prediction of an output."""
    name, size = _words(output.name), output.innovation_std
    if not _EXPECTED[0] <= size <= _EXPECTED[1]:
        yield f"The innovations of the {name} are {size:.3g} times as large as expected."
    if abs(output.correlation) > _CORRELATED:
        yield f"Neighbouring innovations of the {name} are correlated by {output.correlation:.2f}."
    if output.free_run < _SIMULATED:
        yield f"The torque alone does not explain the {name}."


def _tables(fit: Fit, part: str) -> Iterator[Table]:
    """Yield the tables of a page; those without rows are not shown."""
    rows = [
        (_words(n.name), f"{n.before:.4g}", f"{n.value:.4g}", f"{n.std:.2g}", n.unit, _SEEN[n.seen])
        for n in fit.numbers
    ]
    yield Table("Numbers", ("number", "before", "fitted", "1σ", "unit", "shown"), rows)
    predicted = [
        (_words(name), f"{ahead:.4g}", f"{run:.4g}", f"{std:.3g}", f"{near:.2f}")
        for name, ahead, run, _, std, near in fit.outputs
    ]
    horizon = f"simulated for {fit.outputs[0].horizon:g} s [%]"
    head = ("one sample ahead [%]", horizon, "innovations / expected", "correlation")
    note = (
        f"Of {part}. 100 % is without error, 0 % no better than the mean. Correlation is that of "
        "neighbouring innovations, 0 if they are white."
    )
    yield Table("Prediction", ("output", *head), predicted, 1, note)
    lacks = [
        (each.what, "the fitted request has it" if each.is_added else each.entry or "none")
        for each in fit.lacks
    ]
    yield Table("What the model lacked", ("what", "entry of the request that adds it"), lacks, 2)
    unseen = [(_words(each.partition(": ")[0]), each.partition(": ")[2]) for each in fit.unseen]
    title = "What the recordings do not show"
    yield Table(title, ("numbers", "motion that would show them"), unseen, 2)


def _rows(fit: Fit) -> Iterator[tuple[Plot, ...]]:
    """Yield the plots of a page: outputs with residuals, torques, spectra and information."""
    traces, gap = fit.traces, 4.0 * fit.request.period
    time, rest = traces.time, traces.unexplained
    columns = traces.measured.T, traces.simulated.T, traces.predicted.T, traces.residual.T
    outputs = list(zip(outputs_of(fit.request), fit.outputs, *columns, strict=True))
    for (name, unit), one, measured, simulated, predicted, r in outputs:
        values = {"measured": measured, "simulated": simulated, "predicted": predicted}
        remark = (
            f"{_percent(one.one_step)} predicted one sample ahead",
            f"{_percent(one.free_run)} simulated, from the estimate every {one.horizon:g} s",
        )
        curves = tuple(thinned_curve(key, time, y, max_gap=gap) for key, y in values.items())
        value = Plot(name, unit, limits_around(values.values()), curves, remark)
        yield value, _residual(name, time, r, gap)
    torques = {"applied": (time, traces.torque), "unexplained": (time, rest)}
    yield (lines("torque", "N m", torques, gap),)
    link, _, motor, speed = traces.state.T
    friction, nothing = -fit.joint.friction[0] * np.sign(speed), np.zeros(len(time))
    label = "unexplained torque"
    yield (_over("motor velocity [rad/s]", speed, f"friction and {label}", rest, friction),)
    yield (
        _over("motor angle [rad]", motor, label, rest, nothing),
        _over("deflection of the spring [rad]", link - motor, label, rest, nothing),
    )
    for (name, _), *_, r in outputs:
        yield from _spectrum(name, r, fit.request.period)
    yield (_information(fit),)


def _words(name: str) -> str:
    """Return the name of an output, or of a number by its place in the request, for people."""
    first, *rest = name.removeprefix("arm.").split(".")
    plain = [_WORDS.get(each, each.replace("_", " ")) for each in (first, *rest)]
    places = [str(int(each) + 1) if each.isdigit() else each for each in plain[1:]]
    return ": ".join(filter(None, (plain[0], " ".join(places))))


def _percent(value: float) -> str:
    return f"{value:.3g} %" if math.isfinite(value) else "not known"


def _listed(names: list[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def _residual(name: str, time: Array, r: Array, gap: float) -> Plot:
    """Return the plot of innovations by their expected 1σ."""
    there = np.isfinite(r)
    time, r = time[there], r[there]
    share = 100.0 * float((np.abs(r) > SIGMAS).sum()) / max(len(r), 1)
    curve = thinned_curve("measured", time, r, max_gap=gap)._replace(name="residual")
    size = min(max(4.5, 1.1 * float(np.abs(r).max(initial=0.0))), 2.0 * GATE)
    remark = (f"– – ±{SIGMAS:g}σ", f"{share:.2g} % outside; 0.27 % if normal")
    label = f"residual of {name}"
    return Plot(label, "expected 1σ", (-size, size), (curve,), remark, level=SIGMAS)


def _over(axis: str, x: Array, label: str, rest: Array, fitted: Array) -> Plot:
    """Return the plot of a fitted torque and the rest over a quantity, with neighbours' means."""
    order, y = np.argsort(x), fitted + rest
    groups = np.array_split(order, min(_GROUPS, len(order)))
    at, means = (np.array([values[each].mean() for each in groups]) for values in (x, y))
    some = order[:: max(1, len(order) // _DOTS)]
    curves = [Curve("samples", x[some], y[some], Style(MEASUREMENT_COLOUR, 0.6, "."))]
    if fitted.any():
        curves.append(Curve("fitted", x[some], fitted[some], Style(ORANGE, 1.8)))
    curves.append(Curve("mean", at, means, Style(BLUE, 2.0)))
    limits = limits_around([np.quantile(y, (0.002, 0.998)), fitted])
    return Plot(label, "N m", limits, tuple(curves), axis=axis)


def _spectrum(name: str, r: Array, period: float) -> Iterator[tuple[Plot]]:
    """Yield the plot of residuals' power over frequency, by Welch's mean; none of too few."""
    length = min(1 << (len(r) // 8).bit_length(), _MAX_LENGTH)
    if length < 16:
        return
    r = np.nan_to_num(np.clip(r, -GATE, GATE))
    window: Array = np.hanning(length)
    parts = np.lib.stride_tricks.sliding_window_view(r, length)[:: length // 2] * window
    power = np.square(np.abs(np.fft.rfft(parts))).mean(axis=0)[1:-1] / np.square(window).sum()
    hertz = np.arange(1.0, length // 2) / (length * period)
    # Of parts that overlap by a half.
    deviation = math.sqrt((19.0 * len(parts) - 1.0) / 18.0) / len(parts)
    white = Curve("white noise", hertz[[0, -1]], np.ones(2), Style(MUTED, 1.2, "--"))
    curves = Curve("residual", hertz, np.maximum(power, 1e-6), Style(BLUE)), white
    limits = max(min(float(power.min()), 0.1), 1e-6) / 1.3, 1.3 * max(float(power.max()), 10.0)
    remark = (f"white noise: 1 ± {2.0 * deviation:.2g} at 95 % of the frequencies",)
    label = f"residual of {name}: power by that of white noise"
    yield (Plot(label, "", limits, curves, remark, axis="frequency [Hz]", logarithmic="xy"),)


def _information(fit: Fit) -> Plot:
    """Return the plot of how well each number was known before and after, by its value."""
    std, before = np.array([(each.std, each.prior_std) for each in fit.numbers]).T
    # An offset may be about 0.
    scale = np.maximum(np.abs([each.value for each in fit.numbers]), 0.5 * before) / 100.0
    after, before = std / scale, before / scale
    least = 10.0 ** math.floor(math.log10(after.min()) - 0.3)
    strips = []
    for place in reversed(range(len(fit.numbers))):
        name, seen = _words(fit.numbers[place].name), fit.numbers[place].seen
        for size, colour in ((before, "#C4C9D0"), (after, BLUE if seen else ORANGE)):
            strips.append(Strip(name, least, float(size[place]), colour))
    remark = ("grey: before", "blue: after", "orange: after, hardly shown")
    return Plot(
        "1σ of each number by its value", "", (-0.6, len(scale) - 0.4), remark=remark,
        strips=tuple(strips), axis="1σ / value [%]", logarithmic="x",
    )  # fmt: skip
