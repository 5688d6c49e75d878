# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Summary of a campaign: errors, the bounds against them, what was learnt, the worst runs."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.campaign.batches import CLAIMS
from tsobs_ros.campaign.definition import Campaign
from tsobs_ros.campaign.runs import Columns
from tsobs_ros.checks import Array
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.report.quantities import quantities_of

QUANTILES = (0.05, 0.5, 0.95, 0.99, 1.0)
"""What errors are summed up by; the last is the largest."""

_WORST = 5
_GROUPS = {True: "premises hold", False: "they do not"}
_COUNTS = (
    "outliers_left_out",
    "sensor_jumps",
    "hits",
    "losses_of_track",
)

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Summary:
    """A campaign in numbers.

    Attributes:
        runs: Number of runs.
        asked: Number of runs that the campaign has.
        duration: Of a run [s].
        design: Beginning of the checksum of the design's file.
        scenarios: For each scenario: runs, how many keep the bound's premises, quantiles of the
            normalised RMSE, share of errors inside, and what the supervision counted.
        quantities: For each quantity its unit and quantiles of its RMSE.
        bounds: For runs that keep the premises and for others, by what the bounds are said to be:
            the share of samples, and for each quantity the share of errors inside three bounds,
            the root mean square of error / bound, the largest one and the run it is of.
        violated: Number of runs that do not keep a premise, by its name.
        learnt: For each learnt parameter: share of runs in which it is valid at the end, quantiles
            of its error then, share inside three of its 1σ.
        worst: The worst runs, by measure, each with its number.
        failed: Runs with an error that is not known.
    """

    runs: int
    asked: int
    duration: float
    design: str
    scenarios: dict[str, dict[str, Any]]
    quantities: dict[str, dict[str, Any]]
    bounds: dict[str, dict[str, dict[str, Any]]]
    violated: dict[str, int]
    learnt: dict[str, dict[str, Any]]
    worst: dict[str, list[dict[str, Any]]]
    failed: int

    def as_mapping(self) -> dict[str, Any]:
        """Return everything as plain data; what is not known is None."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def text(self) -> str:
        """Return the tables for people."""
        there = f"{self.runs:,}" + (f" of {self.asked:,}" if self.runs < self.asked else "")
        head = f"{there} runs of {self.duration:g} s, design {self.design}"
        if self.failed:
            head += f"; {self.failed:,} runs with an error that is not known"
        names = ["5 %", "median", "95 %", "99 %", "largest"]
        parts = [
            head,
            _table(
                ["normalised RMSE", "runs", "premises hold", *names, "inside"],
                [
                    [name, f"{one['runs']:,}", _share(one["premises_hold"])]
                    + [_number(value) for value in one["normalised_rmse"]]
                    + [_share(one["inside"])]
                    for name, one in self.scenarios.items()
                ],
            ),
            _table(
                ["RMSE", "unit", *names],
                [
                    [name, one["unit"], *map(_number, one["rmse"])]
                    for name, one in self.quantities.items()
                ],
            ),
            _table(
                ["bounds said to be", "samples", "inside", "rms", "worst", "of run"],
                [
                    [f"{claim}; {group}", _share(one["samples"]), *_hardest(one["quantities"])]
                    for group, claims in self.bounds.items()
                    for claim, one in claims.items()
                    if one["samples"]
                ],
            )
            + f"\ninside: share of errors within {SIGMAS:g} bounds; rms, worst: of error / bound; "
            "of the quantity where they are worst",
        ]
        if self.violated:
            counts = ", ".join(f"{name} {count:,}" for name, count in self.violated.items())
            parts.append(f"premises that do not hold, in so many runs: {counts}")
        if self.learnt:
            rows = [
                [name, _share(one["valid"]), *map(_number, one["error"]), _share(one["inside"])]
                for name, one in self.learnt.items()
            ]
            parts.append(_table(["error of what is learnt", "valid", *names, "inside"], rows))
        for measure, runs in self.worst.items():
            rows = [
                [str(one["run"]), one["scenario"], _number(one["value"]), one["violated"] or "none"]
                for one in runs
            ]
            parts.append(_table(["run", "scenario", measure, "premises that do not hold"], rows))
        return "\n\n".join(parts)


def summarise(campaign: Campaign, columns: Columns) -> Summary:
    """Return the summary of runs.

    Args:
        campaign: The campaign.
        columns: Of its runs, of all or of some.
    """
    request = campaign.file.design.arm_request
    quantities = quantities_of(request)
    keys = [each.key for each in quantities]
    file, entries = campaign.file, campaign.entries
    broken = Counter(
        reason for text in columns["violated"].tolist() for reason in text.split(", ") if reason
    )
    return Summary(
        runs=len(columns["run"]),
        asked=entries.runs,
        duration=entries.duration,
        design=file.identity,
        scenarios={
            name: _scenario(columns, keys, columns["scenario"] == name)
            for name in entries.scenarios
            if (columns["scenario"] == name).any()
        },
        quantities={
            each.key: {"unit": each.unit, "rmse": _quantiles(columns[f"{each.key}_rmse"])}
            for each in quantities
        },
        bounds={
            group: {
                claim: _claim(columns, keys, claim, columns["premises_hold"] == held)
                for claim in CLAIMS
            }
            for held, group in _GROUPS.items()
        },
        violated=dict(broken.most_common()),
        learnt={name: _learnt(columns, name) for name in campaign.settings.learnt(file.design)},
        worst=_worst(columns, keys, entries.repeats),
        failed=int((~np.isfinite(columns["normalised_rmse"])).sum()),
    )


def _scenario(columns: Columns, keys: Sequence[str], chosen: Flags) -> dict[str, Any]:
    inside = np.array([columns[f"{key}_inside"][chosen] for key in keys])
    return {
        "runs": int(chosen.sum()),
        "premises_hold": float(columns["premises_hold"][chosen].mean()),
        "normalised_rmse": _quantiles(columns["normalised_rmse"][chosen]),
        "inside": _known(inside[np.isfinite(inside)].mean()) if np.isfinite(inside).any() else None,
        **{name: int(columns[name][chosen].sum()) for name in _COUNTS if name in columns},
    }


def _claim(columns: Columns, keys: Sequence[str], claim: str, chosen: Flags) -> dict[str, Any]:
    samples = sum(columns[f"{name}_samples"][chosen].sum() for name in CLAIMS)
    own = columns[f"{claim}_samples"]
    used = chosen & (own > 0)
    weights = own[used]
    found: dict[str, Any] = {
        "samples": float(weights.sum() / samples) if samples else 0.0,
        "quantities": {},
    }
    for key in keys if used.any() else ():
        inside, ratio, worst = (
            columns[f"{key}_{claim}_{what}"][used] for what in ("inside", "ratio", "worst")
        )
        there = np.isfinite(worst)
        if not there.any():
            continue
        total = weights[there].sum()
        place = int(np.argmax(np.where(there, worst, -np.inf)))
        found["quantities"][key] = {
            "inside": float((weights[there] * inside[there]).sum() / total),
            "rms": float(np.sqrt((weights[there] * ratio[there] ** 2).sum() / total)),
            "worst": float(worst[place]),
            "run": int(columns["run"][used][place]),
        }
    return found


def _learnt(columns: Columns, name: str) -> dict[str, Any]:
    valid = columns["learnt_valid"]
    error = np.abs(columns[f"learnt_{name}"] - columns[f"true_{name}"])
    inside = error <= SIGMAS * columns[f"learnt_bound_{name}"]
    return {
        "valid": float(valid.mean()),
        "error": _quantiles(error[valid]),
        "inside": float(inside[valid].mean()) if valid.any() else None,
    }


def _worst(columns: Columns, keys: Sequence[str], repeats: int) -> dict[str, list[dict[str, Any]]]:
    """Return the worst runs by each measure, one of those that share what is drawn."""
    claims = [claim for claim in CLAIMS if claim != "none"]
    claimed = np.array([columns[f"{key}_{claim}_worst"] for key in keys for claim in claims])
    ratio = np.where(np.isfinite(claimed), claimed, -np.inf).max(axis=0)
    held = columns["premises_hold"]
    measures = {
        "normalised RMSE": columns["normalised_rmse"],
        "error / claimed bound, premises hold": np.where(held, ratio, -np.inf),
        "error / claimed bound, others": np.where(held, -np.inf, ratio),
    }
    found = {}
    for measure, values in measures.items():
        # Runs without a number are the worst by their error.
        ranked = np.where(np.isnan(values), np.inf, values)
        by_draw: dict[int, int] = {}
        for place in np.argsort(-ranked, kind="stable").tolist():
            if ranked[place] > -np.inf and len(by_draw) < _WORST:
                by_draw.setdefault(int(columns["run"][place]) // repeats, place)
        order = list(by_draw.values())
        if order:
            found[measure] = [
                {
                    "run": int(columns["run"][place]),
                    "scenario": str(columns["scenario"][place]),
                    "seed": int(columns["seed"][place]),
                    "value": _known(values[place]),
                    "violated": str(columns["violated"][place]),
                    "drawn": json.loads(str(columns["drawn"][place])),
                }
                for place in order
            ]
    return found


def _quantiles(values: Array) -> list[float | None]:
    known = values[np.isfinite(values)]
    if not len(known):
        return [None] * len(QUANTILES)
    return [float(value) for value in np.quantile(known, QUANTILES)]


def _known(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def _hardest(quantities: dict[str, dict[str, Any]]) -> list[str]:
    worst = max(quantities.values(), key=lambda one: float(one["worst"]), default=None)
    if worst is None:
        return ["-"] * 4
    return [
        _share(min(one["inside"] for one in quantities.values())),
        _number(max(one["rms"] for one in quantities.values())),
        _number(worst["worst"]),
        str(worst["run"]),
    ]


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.2f} %"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return lines with columns, the first to the left and the others to the right."""
    lines = [list(head), *map(list, rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = []
    for line in lines:
        cells = [line[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)]
        text.append("  ".join(cells).rstrip())
    return "\n".join(text)
