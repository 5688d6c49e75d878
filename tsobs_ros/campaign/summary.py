# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Summary of a campaign: errors, the bounds against them, what was learnt, the worst runs."""

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tsobs_ros.campaign.batches import CLAIMS
from tsobs_ros.campaign.definition import Campaign
from tsobs_ros.campaign.runs import Columns
from tsobs_ros.checks import Array, Flags
from tsobs_ros.report.comparison import aligned
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.report.quantities import quantities_of

QUANTILES = (0.05, 0.5, 0.95, 0.99, 1.0)
"""What errors are summed up by; the last is the largest."""

_NAMES = ["5 %", "median", "95 %", "99 %", "largest"]
_WORST = 5
_GROUPS = {True: "premises hold", False: "they do not"}
_COUNTS = (
    "outliers_left_out",
    "sensor_jumps",
    "hits",
    "losses_of_track",
)


@dataclass(frozen=True)
class Summary:
    """A campaign in numbers, None for what is not known.

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
        """Return everything as plain data."""
        return asdict(self)

    def text(self) -> str:
        """Return the tables for people."""
        there = f"{self.runs:,}" + (f" of {self.asked:,}" if self.runs < self.asked else "")
        head = f"{there} runs of {self.duration:g} s, design {self.design}"
        if self.failed:
            head += f"; {self.failed:,} runs with an error that is not known"
        scenarios = (
            [
                name,
                f"{one['runs']:,}",
                _share(one["premises_hold"]),
                *map(_number, one["normalised_rmse"]),
                _share(one["inside"]),
            ]
            for name, one in self.scenarios.items()
        )
        errors = ([name, one["unit"], *map(_number, one["rmse"])]
                  for name, one in self.quantities.items())  # fmt: skip
        bounds = (
            [f"{claim}; {group}", _share(one["samples"]), *_hardest(one["quantities"])]
            for group, claims in self.bounds.items()
            for claim, one in claims.items()
            if one["samples"]
        )
        parts = [
            head,
            _table(["normalised RMSE", "runs", "premises hold", *_NAMES, "inside"], scenarios),
            _table(["RMSE", "unit", *_NAMES], errors),
            _table(["bounds said to be", "samples", "inside", "rms", "worst", "of run"], bounds)
            + f"\ninside: share of errors within {SIGMAS:g} bounds; rms, worst: of error / bound; "
            "of the quantity where they are worst",
        ]
        if self.violated:
            counts = ", ".join(f"{name} {count:,}" for name, count in self.violated.items())
            parts.append(f"premises that do not hold, in so many runs: {counts}")
        if self.learnt:
            learnt = (
                [name, _share(one["valid"]), *map(_number, one["error"]), _share(one["inside"])]
                for name, one in self.learnt.items()
            )
            parts.append(_table(["error of what is learnt", "valid", *_NAMES, "inside"], learnt))
        for measure, runs in self.worst.items():
            worst = (
                [str(one["run"]), one["scenario"], _number(one["value"]), one["violated"] or "none"]
                for one in runs
            )
            parts.append(_table(["run", "scenario", measure, "premises that do not hold"], worst))
        return "\n\n".join(parts)


def summarise(campaign: Campaign, columns: Columns) -> Summary:
    """Return the summary of runs.

    Args:
        campaign: The campaign.
        columns: Of its runs, of all or of some.
    """
    file, entries = campaign.file, campaign.entries
    quantities = quantities_of(file.design.arm_request)
    keys = [each.key for each in quantities]
    texts = columns["violated"].tolist()
    broken = Counter(reason for text in texts for reason in text.split(", ") if reason)
    there = set(columns["scenario"].tolist())
    return Summary(
        runs=len(columns["run"]),
        asked=entries.runs,
        duration=entries.duration,
        design=file.identity,
        scenarios={
            name: _scenario(columns, keys, columns["scenario"] == name)
            for name in entries.scenarios
            if name in there
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
    known = inside[np.isfinite(inside)]
    return {
        "runs": int(chosen.sum()),
        "premises_hold": float(columns["premises_hold"][chosen].mean()),
        "normalised_rmse": _quantiles(columns["normalised_rmse"][chosen]),
        "inside": float(known.mean()) if len(known) else None,
        **{name: int(columns[name][chosen].sum()) for name in _COUNTS if name in columns},
    }


def _claim(columns: Columns, keys: Sequence[str], claim: str, chosen: Flags) -> dict[str, Any]:
    samples = sum(columns[f"{name}_samples"][chosen].sum() for name in CLAIMS)
    used = chosen & (columns[f"{claim}_samples"] > 0)
    weights, runs = columns[f"{claim}_samples"][used], columns["run"][used]
    found = {}
    for key in keys:
        inside, ratio, worst = (
            columns[f"{key}_{claim}_{what}"][used] for what in ("inside", "ratio", "worst")
        )
        there = np.isfinite(worst)
        if there.any():
            own = weights[there]
            found[key] = {
                "inside": float(np.average(inside[there], weights=own)),
                "rms": float(np.sqrt(np.average(ratio[there] ** 2, weights=own))),
                "worst": float(worst[there].max()),
                "run": int(runs[there][worst[there].argmax()]),
            }
    return {"samples": float(weights.sum() / samples) if samples else 0.0, "quantities": found}


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
            if ranked[place] > -np.inf:
                by_draw.setdefault(int(columns["run"][place]) // repeats, place)
        if by_draw:
            found[measure] = [
                {
                    **{name: columns[name][place].item() for name in ("run", "scenario", "seed")},
                    "value": float(values[place]) if np.isfinite(values[place]) else None,
                    "violated": str(columns["violated"][place]),
                    "drawn": json.loads(str(columns["drawn"][place])),
                }
                for place in list(by_draw.values())[:_WORST]
            ]
    return found


def _quantiles(values: Array) -> list[float | None]:
    known = values[np.isfinite(values)]
    if not len(known):
        return [None] * len(QUANTILES)
    return [float(value) for value in np.quantile(known, QUANTILES)]


def _hardest(quantities: dict[str, dict[str, Any]]) -> list[str]:
    if not quantities:
        return ["-"] * 4
    worst = max(quantities.values(), key=lambda one: float(one["worst"]))
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


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(aligned([head, *rows], text_columns=1))
