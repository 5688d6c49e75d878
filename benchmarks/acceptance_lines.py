# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the acceptance benchmark demands, evaluated on its results."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from acceptance_runs import Outcome

Results = Mapping[str, Mapping[str, Outcome]]
"""Outcomes by scenario and contender."""


class Line(NamedTuple):
    """A demand: a number that may not exceed its limit.

    Attributes:
        text: What it is.
        value: The number.
        limit: Most that it may be.
        median: For a ratio of means: the median of the ratios of each run, which a few runs in
            which a filter diverged do not move.
    """

    text: str
    value: float
    limit: float
    median: float | None = None

    @property
    def passed(self) -> bool:
        """Whether the demand is met; a number that is none is not."""
        return bool(self.value <= self.limit)


_RATIOS = (
    ("noise", "settled", "certified", "po", 0.65),
    ("noise", "settled", "certified", "pio", 0.80),
    ("noise", "settled", "certified", "ekf_true", 1.05),
    ("bias_step", "full", "certified", "ekf_augmented", 0.75),
    ("bias_step", "full", "certified", "po", 0.05),
    ("bias_step", "full", "certified", "pio", 0.05),
    ("drift", "settled", "certified", "ekf_true", 1.55),
    ("drift", "settled", "riccati", "ekf_true", 1.35),
    ("stiff", "settled", "certified", "ekf_true", 1.15),
    ("stiff", "settled", "certified", "fixed", 0.06),
    ("soft_heavy_bias_step", "settled", "certified", "ekf_augmented", 1.05),
    ("stiff_sinusoid", "settled", "certified", "ekf_true", 1.40),
    ("outliers", "settled", "certified", "ekf_true", 0.65),
)
"""Scenario, window, ours, whom it is compared with, limit of the ratio of mean errors."""

SETTLING_LIMIT = 3.0
"""Time until settled again after a step of the sensor [s], of 9 runs in 10."""

THETA_LIMIT = 0.005
"""RMSE of each parameter with 20 % more stiffness."""

STEP_LIMIT, STEP_RATIO_LIMIT = 60.0, 0.6
"""Median time of a step [µs], and as a share of filterpy's EKF with the same states."""


def lines(results: Results) -> Iterator[Line]:
    """Yield what can be evaluated on the scenarios that were run."""
    for scenario, window, ours, theirs, limit in _RATIOS:
        if scenario in results:
            one = results[scenario]
            mine, other = one[ours].errors[window], one[theirs].errors[window]
            text = f"{scenario}: {ours} / {theirs}, {window}"
            ratio = float(mine.mean() / other.mean())
            yield Line(text, ratio, limit, float(np.median(mine / other)))
    for scenario in ("bias_step", "stiff_bias_step"):
        if (
            scenario in results
            and (after := results[scenario]["certified"].settled_after) is not None
        ):
            slow = float(np.quantile(after, 0.9, method="higher"))
            yield Line(f"{scenario}: certified settled again [s]", slow, SETTLING_LIMIT)
    if "stiff" in results and (theta := results["stiff"]["certified"].theta) is not None:
        rmse = np.sqrt((theta**2).mean(axis=0))
        for name, value in zip(("stiffness", "gravity"), rmse.tolist(), strict=True):
            yield Line(f"stiff: certified, RMSE of θ {name}", value, THETA_LIMIT)


def cost_lines(cost: Mapping[str, float]) -> Iterator[Line]:
    """Yield the demands on the cost of a step [µs]."""
    yield Line("step, two parameters [µs]", cost["adaptive"], STEP_LIMIT)
    ratio = cost["adaptive"] / cost["filterpy"]
    yield Line("step / filterpy's EKF, same states", ratio, STEP_RATIO_LIMIT)
