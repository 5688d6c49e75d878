# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of a fit: what was found, how well it is known, and what the model lacks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.identification.joint import Joint


class Found(NamedTuple):
    """A number that was estimated.

    Attributes:
        name: Its place in the request, e.g. "arm.stiffness".
        unit: Its unit, empty for none.
        before: The request's value.
        value: The likeliest one.
        std: Its 1σ.
        known: Share of the prior's variance that the recordings took away, from 0 to 1.
        prior_std: 1σ of the value without the recordings.
    """

    name: str
    unit: str
    before: float
    value: float
    std: float
    known: float
    prior_std: float

    @property
    def seen(self) -> bool:
        """Whether the recordings show it: its 1σ is at most half of the prior's."""
        return self.known >= 0.75

    @property
    def significant(self) -> bool:
        """Whether it is surely not 0."""
        return abs(self.value) > 3.0 * self.std


class Unseen(NamedTuple):
    """A direction of the numbers that the recordings cannot tell.

    Attributes:
        numbers: Their names and how much of each is in it, the largest first.
        text: In words, with a motion that would show it.
    """

    numbers: tuple[tuple[str, float], ...]
    text: str


class Lack(NamedTuple):
    """Something that the model lacks.

    Attributes:
        what: In plain words, with a number.
        entry: The request's entry that would add it, as YAML in one line; empty if none would.
    """

    what: str
    entry: str


class OutputFit(NamedTuple):
    """How well an output is predicted in the part that was held out.

    Attributes:
        name: The output's name.
        one_step: 100 (1 − |y − ŷ|/|y − mean y|) with ŷ one sample ahead [%].
        free_run: The same with ŷ simulated from the torque alone for `horizon` [%].
        horizon: [s].
        innovation_std: 1σ of the innovations by what the model expects; 1 if it is right.
        correlation: Of neighbouring innovations; 0 if they are white.
        whiteness: Probability of correlations as large as these, up to 20 samples, if they were
            white.
    """

    name: str
    one_step: float
    free_run: float
    horizon: float
    innovation_std: float
    correlation: float
    whiteness: float


class Traces(NamedTuple):
    """The held-out part, or the end of the recording without one, for figures.

    Attributes:
        time: [s], shape (n,).
        measured: Outputs, shape (n, p).
        predicted: One sample ahead, shape (n, p).
        simulated: From the torque alone, piece by piece, shape (n, p).
        residual: Innovations by their expected 1σ, shape (n, p).
        torque: Of the log [N m], shape (n,).
        state: Estimated [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (n, 4).
        unexplained: Torque at the motor that model and log lack [N m], shape (n,).
    """

    time: Array
    measured: Array
    predicted: Array
    simulated: Array
    residual: Array
    torque: Array
    state: Array
    unexplained: Array


@dataclass(frozen=True)
class Fit:
    """What recordings say about a joint.

    Attributes:
        request: The request to design for: it has what was found.
        before: The request that it came from.
        joint: The likeliest joint, with friction, which the request has as a torque disturbance.
        numbers: What was estimated.
        unseen: What the recordings cannot tell.
        lacks: What the model still lacks.
        outputs: How well each output is predicted.
        log_likelihood: Per sample, before and after [nat].
        log_likelihood_held_out: The same of the part that was held out.
        samples: Number of samples that were fitted, and of those held out.
        outliers: Number of innovations that were taken for outliers.
        notes: Remarks.
        traces: For figures.
    """

    request: ArmRequest
    before: ArmRequest
    joint: Joint
    numbers: tuple[Found, ...]
    unseen: tuple[Unseen, ...]
    lacks: tuple[Lack, ...]
    outputs: tuple[OutputFit, ...]
    log_likelihood: tuple[float, float]
    log_likelihood_held_out: tuple[float, float]
    samples: tuple[int, int]
    outliers: int
    notes: tuple[str, ...]
    traces: Traces

    def number(self, name: str) -> Found:
        """Return what was found of a number.

        Raises:
            KeyError: It was not estimated.
        """
        for one in self.numbers:
            if name in (one.name, one.name.removeprefix("arm.")):
                return one
        raise KeyError(name)

    def summary(self) -> dict[str, Any]:
        """Return the result as plain data."""
        return {
            "samples": {"fitted": self.samples[0], "held_out": self.samples[1]},
            "log_likelihood_per_sample": {
                "before": self.log_likelihood[0],
                "after": self.log_likelihood[1],
                "held_out_before": self.log_likelihood_held_out[0],
                "held_out_after": self.log_likelihood_held_out[1],
            },
            "numbers": [each._asdict() | {"seen": each.seen} for each in self.numbers],
            "unseen": [{"numbers": dict(e.numbers), "text": e.text} for e in self.unseen],
            "lacks": [each._asdict() for each in self.lacks],
            "outputs": [each._asdict() for each in self.outputs],
            "outliers": self.outliers,
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        return "\n".join(_lines(self))


def _lines(fit: Fit) -> list[str]:
    """Return a fit as text."""
    width = max(len(each.name) for each in fit.numbers)
    lines = [f"{'number':{width}}  {'before':>10}  {'fitted':>10}  {'1 sigma':>9}  unit"]
    for each in fit.numbers:
        seen = "" if each.seen else "   not shown by the recording"
        lines.append(
            f"{each.name:{width}}  {each.before:>10.4g}  {each.value:>10.4g}  {each.std:>9.2g}  "
            f"{each.unit}{seen}"
        )
    before, after = fit.log_likelihood
    held_before, held_after = fit.log_likelihood_held_out
    lines.append(
        f"log likelihood per sample: {before:.4g} before, {after:.4g} after ({fit.samples[0]:,} "
        f"samples); held out: {held_before:.4g} before, {held_after:.4g} after "
        f"({fit.samples[1]:,} samples)"
    )
    for one in fit.outputs:
        lines.append(
            f"{one.name}, held out: one sample ahead {one.one_step:.4g} %, simulated for "
            f"{one.horizon:.3g} s {one.free_run:.4g} %; innovations {one.innovation_std:.3g} times "
            f"as large as expected, neighbours correlated by {one.correlation:.2f}"
        )
    lines += [f"not shown: {each.text}" for each in fit.unseen]
    lines += [f"the model lacks {_with_entry(each)}" for each in fit.lacks]
    return lines + list(fit.notes)


def _with_entry(lack: Lack) -> str:
    return f"{lack.what}; {lack.entry}" if lack.entry else lack.what


def ranked(pairs: Sequence[tuple[str, float]], least: float) -> tuple[tuple[str, float], ...]:
    """Return the pairs whose number is at least so large, the largest first."""
    chosen = [each for each in pairs if abs(each[1]) >= least]
    return tuple(sorted(chosen, key=lambda each: -abs(each[1])))
