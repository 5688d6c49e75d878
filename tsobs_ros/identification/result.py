# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of a fit: what was found, how well it is known, and what the model lacks."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import yaml

from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.identification.joint import Joint, numbers_of
from tsobs_ros.schema import encode


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
        is_added: Whether the fitted request has it.
    """

    what: str
    entry: str
    is_added: bool = False


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
        lacks: What the request's model lacks, and what the fitted one still lacks.
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
        by_name = {each.name: each for each in self.numbers}
        return by_name.get(name) or by_name[f"arm.{name}"]

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
            "lacks": [{"what": each.what, "entry": each.entry} for each in self.lacks],
            "outputs": [each._asdict() for each in self.outputs],
            "outliers": self.outliers,
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        width = max(len(each.name) for each in self.numbers)
        lines = [f"{'number':{width}}  {'before':>10}  {'fitted':>10}  {'1 sigma':>9}  unit"]
        for each in self.numbers:
            seen = "" if each.seen else "   not shown by the recording"
            lines.append(
                f"{each.name:{width}}  {each.before:>10.4g}  {each.value:>10.4g}  "
                f"{each.std:>9.2g}  {each.unit}{seen}"
            )
        before, after = self.log_likelihood
        held_before, held_after = self.log_likelihood_held_out
        fitted, held_out = self.samples
        lines.append(
            f"log likelihood per sample: {before:.4g} before, {after:.4g} after ({fitted:,} "
            f"samples); held out: {held_before:.4g} before, {held_after:.4g} after "
            f"({held_out:,} samples)"
        )
        for one in self.outputs:
            lines.append(
                f"{one.name}, held out: one sample ahead {one.one_step:.4g} %, simulated for "
                f"{one.horizon:.3g} s {one.free_run:.4g} %; innovations {one.innovation_std:.3g} "
                f"times as large as expected, neighbours correlated by {one.correlation:.2f}"
            )
        lines += [f"not shown: {each.text}" for each in self.unseen]
        if added := [f"  {each.what}" for each in self.lacks if each.is_added]:
            lines += ["found, and in the fitted request:", *added]
        if rest := [each for each in self.lacks if not each.is_added]:
            lines.append("the model still lacks:")
            lines += [f"  {each.what}" + f"; {each.entry}" * bool(each.entry) for each in rest]
        return "\n".join([*lines, *self.notes])


_HEADER = """\
# What `tsobs design` is asked for, with numbers of `tsobs fit`: {samples} samples of
# {names}.
# ± is the 1 sigma of a fitted number. One that is hardly shown stays near its value before.
# Units are SI and radians.
"""


def request_text(fit: Fit, names: str) -> str:
    """Return the fitted request as a file, in which comments say where each number comes from.

    Args:
        fit: The fit.
        names: Of the recordings.
    """
    request, found = fit.request, {each.name: each for each in fit.numbers}
    data: dict[str, Any] = encode(request)
    # Others stand for these.
    unwritten = ("disturbance", "measurement_std") if request.outputs else ("outputs",)
    lines = [_HEADER.format(samples=f"{fit.samples[0]:,}", names=names), "design:\n"]
    for name in [each.name for each in fields(ArmRequest) if each.name not in unwritten]:
        if data.get(name) not in (None, {}, []) or name == "uncertainty":
            lines.append(_entry(name, data[name], found, request))
    lines += [f"# The model lacks {lack.what}.\n" for lack in fit.lacks]
    return "".join(lines)


def _entry(name: str, value: Any, found: Mapping[str, Found], request: ArmRequest) -> str:
    """Return the lines of one entry of the request."""
    written = {key: each.value for key, each in found.items()}
    written |= {each.name: each.start for each in numbers_of(request)}

    def comments(indent: str, *prefixes: str) -> str:
        return "".join(
            f"{indent}# {key}: {_words(one, written[key])}\n"
            for key, one in found.items()
            # No request has an offset of an output.
            if key.startswith(prefixes) and not key.endswith("_angle.offset")
        )

    if isinstance(value, Mapping) and name in ("arm", "torque"):
        lines = [f"  {name}:\n"]
        for key, each in value.items():
            one = found.get(f"{name}.{key}")
            lines.append(f"    {key}: {_flow(each)}{f'  # {_words(one, each)}' if one else ''}\n")
        return "".join(lines)
    if name == "outputs":
        lines = ["  outputs:\n"]
        for each in value:
            lines.append(comments("    ", f"{each['measures']}.") + f"    - {_flow(each)}\n")
        return "".join(lines)
    comment = comments("  ", f"{name}.", f"link_angle.{name}")
    if name == "uncertainty" and value:
        comment = "  # Three sigmas of the fit; the prior's bound of what it does not show.\n"
    return f"{comment}  {name}: {_flow(value)}\n"


def _words(one: Found, value: float) -> str:
    if not (value or one.significant):
        return f"nothing is shown ({one.value:.2g} ± {one.std:.2g} {one.unit})"
    if not one.seen:
        return f"the recording hardly shows it (± {one.std:.2g} {one.unit})".replace(" )", ")")
    if abs(value / one.value - 1.0) > 1e-4:
        return f"likeliest of a filter without friction; with it {one.value:.4g} ± {one.std:.2g}"
    return f"fitted, ± {one.std:.2g} {one.unit}; it was {one.before:.4g}".replace(" ;", ";")


def _flow(value: Any) -> str:
    """Return plain data as YAML in one line."""
    text: str = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
    return text.removesuffix("\n").removesuffix("\n...")
