# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The result of a fit: the numbers, their accuracy, and the effects that the model lacks."""

from dataclasses import dataclass
from typing import Any

import yaml

from tsobs_ros.design.file import arm_entries
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.identification.diagnosis import HORIZON, OutputFit, Traces
from tsobs_ros.identification.joint import Found, Joint, found_named, table


@dataclass(frozen=True)
class Fit:
    """The result of fitting a joint to recordings.

    Attributes:
        request: The request to design for, with the fitted numbers.
        before: The request before the fit.
        joint: The likeliest joint, with friction, which the request has as a torque disturbance.
        numbers: The estimated numbers.
        unseen: Directions that the recordings do not show, a line each: the numbers that look
            alike, and a motion that would show them.
        added: Effects that the given request lacks and the fitted one has, a line each.
        lacks: Effects that the fitted request still lacks.
        outputs: Quality of each output's prediction.
        samples: Number of samples that were fitted, and of those held out.
        outliers: Number of fitted innovations beyond the gate; `notes` have other outliers.
        notes: Remarks.
        traces: For figures.
    """

    request: ArmRequest
    before: ArmRequest
    joint: Joint
    numbers: tuple[Found, ...]
    unseen: tuple[str, ...]
    added: tuple[str, ...]
    lacks: tuple[str, ...]
    outputs: tuple[OutputFit, ...]
    samples: tuple[int, int]
    outliers: int
    notes: tuple[str, ...]
    traces: Traces

    def number(self, name: str) -> Found:
        """Return an estimated number; other names raise `KeyError`."""
        return found_named(self.numbers, name)

    def summary(self) -> dict[str, Any]:
        """Return the result as plain data."""
        return {
            "samples": {"fitted": self.samples[0], "held_out": self.samples[1]},
            "numbers": [each._asdict() | {"seen": each.seen} for each in self.numbers],
            "unseen": list(self.unseen),
            "added": list(self.added),
            "lacks": list(self.lacks),
            "outputs": [each._asdict() for each in self.outputs],
            "outliers": self.outliers,
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        lines = table(self.numbers, {"before": "before", "fitted": "value", "1 sigma": "std"})
        fitted, held_out = self.samples
        lost = f" ({self.outliers:,} innovations left out as outliers)" * bool(self.outliers)
        lines.append(f"{fitted:,} samples fitted{lost}, {held_out:,} held out")
        for one in self.outputs:
            lost = f" ({one.outliers:,} samples left out as outliers)" * bool(one.outliers)
            lines.append(
                f"{one.name}, held out{lost}: one sample ahead {one.one_step:.4g} %, simulated for "
                f"{HORIZON:.3g} s {one.free_run:.4g} %; innovations {one.innovation_std:.3g} "
                f"times as large as expected, neighbours correlated by {one.correlation:.2f}"
            )
        lines += [f"not shown: {each}" for each in self.unseen]
        for title, found in (
            ("found, and in the fitted request:", self.added),
            ("the model still lacks:", self.lacks),
        ):
            lines += [title, *(f"  {each}" for each in found)] if found else []
        return "\n".join([*lines, *self.notes])


def request_text(fit: Fit, names: str) -> str:
    """Return the fitted request as a file; its comments have the recordings' names and the fit."""
    comments = [
        f"A request for `tsobs design`, with numbers of `tsobs fit` from {names}.",
        "Units are SI and radians. Noises below are those of a filter without Coulomb friction.",
        "A delay below 0 is 0 in the request: other outputs' are longer, the torque's is shorter.",
        *str(fit).splitlines(),
    ]
    lines = [*(f"# {each}" for each in comments), "design:"]
    for name, value in arm_entries(fit.request).items():
        if name == "outputs":
            # Each in a line that can be left out.
            lines += ["  outputs:", *(f"    - {_flow(each)}" for each in value)]
        else:
            lines.append(f"  {name}: {_flow(value)}")
    return "\n".join([*lines, ""])


def _flow(value: Any) -> str:
    """Return plain data as YAML in one line."""
    text: str = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
    return text.removesuffix("\n").removesuffix("\n...")
