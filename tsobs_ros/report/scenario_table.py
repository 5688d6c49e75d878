# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of observers on simulated scenarios: as plain data, and as a table for terminals."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tsobs_ros.methods import METHODS
from tsobs_ros.report.comparison import aligned, number_text
from tsobs_ros.report.metrics import SIGMAS, RunMetrics

BOUNDS = ("pcrb", "pcrb_augmented")
"""Names of the posterior Cramér–Rao bound with known parameters, and with those as states."""

ABOUT = {
    **METHODS,
    "certified_fixed": "the same without learning",
    "pcrb": "least error of an estimator that is not biased by the sensor's offset, if it knows "
    "the arm, the rest of the disturbance and when it jumps (posterior Cramér–Rao bound)",
    "pcrb_augmented": "the same if it does not know the uncertain parameters",
}
"""What each row of the table is."""

_BIASED = {
    "take the parameters for known, so that pcrb holds if they are right": (
        "certified_fixed",
        "ekf_plain",
        "ekf",
    ),
    "take an offset of the sensor for motion, so that no bound holds; their θ is the best one of "
    "the scenario's first run": ("high_gain", "proportional_integral"),
    "uses no measurement of the arm, see docs/method.md": ("paper",),
}
"""Why the bound does not hold for observers."""


def scores(runs: Sequence[RunMetrics]) -> dict[str, Any]:
    """Return an observer's errors in the runs of a scenario, as plain data."""
    quantities = {
        each[0].quantity.key: each for each in zip(*(run.quantities for run in runs), strict=True)
    }
    inside = {}
    for key, each in quantities.items():
        shares = [one.inside for one in each if one.inside is not None]
        if len(shares) == len(runs):
            inside[key] = float(np.mean(shares))
    return {
        "normalised_rmse": _root_mean([run.normalised_rmse for run in runs]),
        "rmse": {key: _root_mean([one.rmse for one in each]) for key, each in quantities.items()},
        "normalised_rmse_of_runs": [run.normalised_rmse for run in runs],
        **({f"inside_{SIGMAS:g}_sigma": inside} if inside else {}),
    }


def comparison_of(
    scenarios: Mapping[str, Mapping[str, Any]], observers: Sequence[str], seeds: int
) -> dict[str, Any]:
    """Return everything as plain data that JSON can hold, with notes for the reader.

    A scenario has the scores of each observer, and the least errors of a run by those of `BOUNDS`
    that it has; `theta` of observers of high gain [rad/s]; and in `unbounded` why it has no bounds,
    None if it has.
    """
    bounds = [name for name in BOUNDS if any(name in each for each in scenarios.values())]
    notes = [
        f"normalised RMSE of the four states over what counts as settled; root mean square "
        f"over {seeds} runs"
    ]
    for name, each in scenarios.items():
        if each["unbounded"]:
            notes.append(f"no bound for {name}: it has {each['unbounded']}")
    for reason, names in _BIASED.items():
        if own := [name for name in observers if name in names]:
            notes.append(f"{', '.join(own)}: {reason}")
    about = {name: ABOUT[name] for name in (*observers, *bounds)}
    return {"seeds": seeds, "observers": about, "scenarios": dict(scenarios), "notes": notes}


def render_scenarios(comparison: Mapping[str, Any]) -> str:
    """Return a comparison as text, a column for each scenario."""
    about, scenarios = comparison["observers"], comparison["scenarios"]
    table = [["", *scenarios]]
    for name in about:
        cells = (each.get(name, {}).get("normalised_rmse") for each in scenarios.values())
        table.append([name, *map(number_text, cells)])
    width = max(map(len, about))
    described = [f"{name:<{width}}  {text}" for name, text in about.items()]
    lines = [*aligned(table, text_columns=1), "", *described, "", *comparison["notes"]]
    return "\n".join(lines)


def _root_mean(values: Sequence[float | None]) -> float | None:
    """Return the root mean square; infinite if a run diverged, None if no run has a value."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    with np.errstate(over="ignore"):
        mean = float(np.mean(np.square(known)))
    return math.sqrt(mean) if math.isfinite(mean) and len(known) == len(values) else math.inf
