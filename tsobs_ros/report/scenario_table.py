# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of observers on simulated scenarios, as a table for terminals and for JSON."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

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


Runs: TypeAlias = Sequence[RunMetrics]
"""An observer's errors in the runs of a scenario."""


def typical(runs: Runs) -> float | None:
    """Return the root mean square of the normalised RMSE over runs; None without errors."""
    return _root_mean([run.normalised_rmse for run in runs])


def _mapping(runs: Runs) -> dict[str, Any]:
    """Return the errors of runs as plain data."""
    quantities = {
        each[0].quantity.key: each for each in zip(*(run.quantities for run in runs), strict=True)
    }
    inside = {}
    for key, each in quantities.items():
        shares = [one.inside for one in each if one.inside is not None]
        if len(shares) == len(runs):
            inside[key] = float(np.mean(shares))
    return {
        "normalised_rmse": typical(runs),
        "rmse": {key: _root_mean([one.rmse for one in each]) for key, each in quantities.items()},
        "normalised_rmse_of_runs": [run.normalised_rmse for run in runs],
        **({f"inside_{SIGMAS:g}_sigma": inside} if inside else {}),
    }


class ScenarioRow(NamedTuple):
    """A scenario: errors by observer, and least errors of a run by the names of `BOUNDS`.

    `unbounded` is why there are no bounds, empty if there are; `thetas` are θ of the observers of
    high gain [rad/s].
    """

    scenario: str
    cells: dict[str, Runs]
    unbounded: str
    thetas: Mapping[str, float]


@dataclass(frozen=True)
class ScenarioComparison:
    """Observers on scenarios; remarks are notes such as why an observer was left out."""

    rows: tuple[ScenarioRow, ...]
    observers: tuple[str, ...]
    seeds: int
    remarks: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The observers, and the bounds that any scenario has."""
        bounds = (name for name in BOUNDS if any(name in row.cells for row in self.rows))
        return (*self.observers, *bounds)

    def as_mapping(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        return {
            "seeds": self.seeds,
            "observers": {name: ABOUT[name] for name in self.names},
            "scenarios": {
                row.scenario: {
                    **{name: _mapping(runs) for name, runs in row.cells.items()},
                    "theta": dict(row.thetas),
                    "unbounded": row.unbounded or None,
                }
                for row in self.rows
            },
            "notes": self.notes(),
        }

    def notes(self) -> list[str]:
        """Return what a reader has to know: the measure, and why cells are empty."""
        lines = [
            f"normalised RMSE of the four states over what counts as settled; root mean square "
            f"over {self.seeds} runs"
        ]
        for row in self.rows:
            lines += [f"no bound for {row.scenario}: it has {row.unbounded}"] * bool(row.unbounded)
        for reason, names in _BIASED.items():
            own = [name for name in self.observers if name in names]
            lines += [f"{', '.join(own)}: {reason}"] * bool(own)
        return [*lines, *self.remarks]

    def __str__(self) -> str:
        table = [["", *(row.scenario for row in self.rows)]]
        for name in self.names:
            cells = (typical(row.cells.get(name, ())) for row in self.rows)
            table.append([name, *map(number_text, cells)])
        width = max(map(len, self.names))
        about = [f"{name:<{width}}  {ABOUT[name]}" for name in self.names]
        return "\n".join([*aligned(table, text_columns=1), "", *about, "", *self.notes()])


def _root_mean(values: Sequence[float | None]) -> float | None:
    """Return the root mean square; infinite if a run diverged, None if no run has a value."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    with np.errstate(over="ignore"):
        mean = float(np.mean(np.square(known)))
    return math.sqrt(mean) if math.isfinite(mean) and len(known) == len(values) else math.inf
