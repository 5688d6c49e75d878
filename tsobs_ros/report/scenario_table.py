# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of observers on simulated scenarios, as a table for terminals and for JSON."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.methods import METHODS
from tsobs_ros.report.comparison import aligned, number_text
from tsobs_ros.report.metrics import SIGMAS, RunMetrics
from tsobs_ros.report.quantities import QUANTITIES

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


class Cell(NamedTuple):
    """Errors over the settled parts of a scenario's runs; NaN if there are none.

    RMSE of `QUANTITIES` and shares of errors inside `SIGMAS` times the bound, shape (runs, 5), and
    the root mean square over the states of RMSE / scale, shape (runs,).
    """

    rmse: Array
    inside: Array
    normalised: Array

    @classmethod
    def of(cls, runs: Sequence[RunMetrics]) -> "Cell":
        """Return the errors of some runs."""
        numbers = np.array(
            [[(one.rmse, one.inside) for one in run.quantities] for run in runs], np.float64
        )
        normalised = np.array([run.normalised_rmse for run in runs], np.float64)
        return cls(numbers[..., 0], numbers[..., 1], normalised)

    @property
    def typical(self) -> float | None:
        """Root mean square of the normalised RMSE over the runs; None without errors."""
        return _root_mean(self.normalised)

    def as_mapping(self) -> dict[str, Any]:
        """Return everything as plain data."""
        inside = {
            quantity.key: float(shares.mean())
            for quantity, shares in zip(QUANTITIES, self.inside.T, strict=True)
            if np.isfinite(shares).all()
        }
        return {
            "normalised_rmse": self.typical,
            "rmse": {
                one.key: _root_mean(rmse) for one, rmse in zip(QUANTITIES, self.rmse.T, strict=True)
            },
            "normalised_rmse_of_runs": self.normalised.tolist(),
            **({f"inside_{SIGMAS:g}_sigma": inside} if inside else {}),
        }


class ScenarioRow(NamedTuple):
    """A scenario: errors by observer, and least errors of a run by the names of `BOUNDS`.

    `unbounded` is why there are no bounds, empty if there are; `thetas` are θ of the observers of
    high gain [rad/s].
    """

    scenario: str
    cells: dict[str, Cell]
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
                    **{name: one.as_mapping() for name, one in row.cells.items()},
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
            cells = (row.cells.get(name) for row in self.rows)
            table.append([name, *(number_text(one and one.typical) for one in cells)])
        width = max(map(len, self.names))
        about = [f"{name:<{width}}  {ABOUT[name]}" for name in self.names]
        return "\n".join([*aligned(table, text_columns=1), "", *about, "", *self.notes()])


def _root_mean(values: Array) -> float | None:
    """Return the root mean square; infinite if a run diverged, None if no run has a value."""
    if np.isnan(values).all():
        return None
    with np.errstate(over="ignore"):
        mean = float(np.mean(np.square(values)))
    return math.sqrt(mean) if math.isfinite(mean) else math.inf
