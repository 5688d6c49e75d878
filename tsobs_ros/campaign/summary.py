# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Summary of a campaign: errors, their sizes relative to the bounds, and the worst runs."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tsobs_ros.campaign.batches import CLAIMS, Columns
from tsobs_ros.campaign.definition import Campaign
from tsobs_ros.checks import Array, Flags
from tsobs_ros.design.file import identity
from tsobs_ros.report.comparison import aligned, number_text
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.report.quantities import quantities_of

_QUANTILES = {"5 %": 0.05, "median": 0.5, "95 %": 0.95, "99 %": 0.99, "largest": 1.0}
_WORST = 5


def summarise(campaign: Campaign, columns: Columns) -> dict[str, Any]:
    """Return the summary of a campaign's runs as plain data, None for unknown values.

    `failed` counts the runs with an unknown error. Quantiles are those of the table's head. For
    each claim, `bounds` has the share of samples and, for each quantity, the share of errors inside
    three bounds, and the root mean square and the maximum of error / bound.
    """
    design, entries = campaign.design, campaign.entries
    quantities = quantities_of(design.arm_request)
    keys = [each.key for each in quantities]
    broken = Counter(
        reason for text in columns["violated"].tolist() for reason in text.split(", ") if reason
    )
    scenarios = {}
    for name in entries.scenarios:
        chosen = columns["scenario"] == name
        if chosen.any():
            inside = np.array([columns[f"{key}_inside"][chosen] for key in keys])
            known = inside[np.isfinite(inside)]
            scenarios[name] = {
                "runs": int(chosen.sum()),
                "premises_hold": float(columns["premises_hold"][chosen].mean()),
                "normalised_rmse": _quantiles(columns["normalised_rmse"][chosen]),
                "inside": float(known.mean()) if len(known) else None,
            }
    held = columns["premises_hold"]
    return {
        "runs": len(columns["run"]),
        "duration": entries.duration,
        "design": identity(design),
        "scenarios": scenarios,
        "quantities": {
            each.key: {"unit": each.unit, "rmse": _quantiles(columns[f"{each.key}_rmse"])}
            for each in quantities
        },
        "bounds": {
            group: {claim: _claim(columns, keys, claim, chosen) for claim in CLAIMS}
            for group, chosen in (("premises hold", held), ("they do not", ~held))
        },
        "violated": dict(broken.most_common()),
        "worst": _worst(columns, keys, entries.repeats),
        "failed": int((~np.isfinite(columns["normalised_rmse"])).sum()),
    }


def render(summary: Mapping[str, Any]) -> str:
    """Return the tables of a summary for people."""
    head = (
        f"{summary['runs']:,} runs of {summary['duration']:g} s, design {summary['design']}; "
        f"{summary['failed']:,} with an error that is not known"
    )
    scenarios = [["normalised RMSE", "runs", "premises hold", *_QUANTILES, "inside"]]
    for name, one in summary["scenarios"].items():
        errors = map(number_text, one["normalised_rmse"])
        shares = _share(one["premises_hold"]), *errors, _share(one["inside"])
        scenarios.append([name, f"{one['runs']:,}", *shares])
    quantities = [["RMSE", "unit", *_QUANTILES]]
    for name, one in summary["quantities"].items():
        quantities.append([name, one["unit"], *map(number_text, one["rmse"])])
    bounds = [["bounds said to be", "samples", "inside", "rms", "worst", "of run"]]
    for group, claims in summary["bounds"].items():
        for claim, one in claims.items():
            if each := list(one["quantities"].values()):
                worst = max(each, key=lambda own: float(own["worst"]))
                inside, rms = min(own["inside"] for own in each), max(own["rms"] for own in each)
                sizes = number_text(rms), number_text(worst["worst"]), str(worst["run"])
                shares = _share(one["samples"]), _share(inside)
                bounds.append([f"{claim}; {group}", *shares, *sizes])
    tables = [scenarios, quantities, bounds]
    for measure, worst in summary["worst"].items():
        tables.append([["run", "scenario", measure, "premises that do not hold"]])
        for one in worst:
            value, reasons = number_text(one["value"]), one["violated"] or "none"
            tables[-1].append([str(one["run"]), one["scenario"], value, reasons])
    counts = ", ".join(f"{name} {count:,}" for name, count in summary["violated"].items())
    note = (
        f"inside: share of errors within {SIGMAS:g} bounds; rms, worst: of error / bound; of the "
        f"quantity where they are worst\npremises that do not hold, in so many runs: "
        f"{counts or 'none'}"
    )
    return "\n\n".join([head, *("\n".join(aligned(table, 1)) for table in tables), note])


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


def _worst(columns: Columns, keys: Sequence[str], repeats: int) -> dict[str, list[dict[str, Any]]]:
    """Return the worst runs by each measure, only one of those that share the drawn numbers."""
    claims = [claim for claim in CLAIMS if claim != "none"]
    claimed = np.array([columns[f"{key}_{claim}_worst"] for key in keys for claim in claims])
    ratio, held = np.fmax.reduce(claimed), columns["premises_hold"]
    found = {}
    for measure, values in (
        # Runs without a number count as the worst.
        ("normalised RMSE", np.nan_to_num(columns["normalised_rmse"], nan=np.inf)),
        ("error / claimed bound, premises hold", np.where(held, ratio, np.nan)),
        ("error / claimed bound, others", np.where(held, np.nan, ratio)),
    ):
        by_draw: dict[int, int] = {}
        for place in np.argsort(-values, kind="stable")[: np.count_nonzero(values == values)]:
            by_draw.setdefault(int(columns["run"][place]) // repeats, place)
        found[measure] = [
            {
                **{name: columns[name][place].item() for name in ("run", "scenario", "seed")},
                "value": float(values[place]) if np.isfinite(values[place]) else None,
                "violated": str(columns["violated"][place]),
                "drawn": json.loads(str(columns["drawn"][place])),
            }
            for place in list(by_draw.values())[:_WORST]
        ]
    return {measure: rows for measure, rows in found.items() if rows}


def _quantiles(values: Array) -> list[float | None]:
    known = values[np.isfinite(values)]
    if not len(known):
        return [None] * len(_QUANTILES)
    return [float(value) for value in np.quantile(known, list(_QUANTILES.values()))]


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100.0 * value:.2f} %"
