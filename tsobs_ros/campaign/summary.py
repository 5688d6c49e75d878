# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Summary of a campaign: errors, the bounds against them, what was learnt, the worst runs."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tsobs_ros.campaign.batches import CLAIMS
from tsobs_ros.campaign.definition import Campaign
from tsobs_ros.campaign.execution import Columns
from tsobs_ros.checks import Array, Flags
from tsobs_ros.report.comparison import aligned
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.report.quantities import quantities_of

# What errors are summed up by; the last is the largest.
_QUANTILES = (0.05, 0.5, 0.95, 0.99, 1.0)
_NAMES = ["5 %", "median", "95 %", "99 %", "largest"]
_WORST = 5
_COUNTS = ("outliers_left_out", "sensor_jumps", "hits", "losses_of_track")


def summarise(campaign: Campaign, columns: Columns) -> dict[str, Any]:
    """Return the summary of runs as plain data, None for what is not known.

    Args:
        campaign: The campaign.
        columns: Of its runs, of all or of some.

    Returns:
        Numbers of `runs`, of those `asked` for and of those that `failed`, with an error that is
        not known; `duration` of a run [s]; `design`, the beginning of its file's checksum; for each
        of `scenarios` runs, how many keep the premises, quantiles of the normalised RMSE, share of
        errors inside and what the supervision counted; for each of `quantities` unit and quantiles
        of the RMSE; `bounds` of runs that keep the premises and of others, by what they are said to
        be: the share of samples, and of each quantity the share of errors inside three bounds, root
        mean square and largest of error / bound with its run; runs that `violated` each premise;
        for each parameter that is `learnt` the share of runs in which it is valid at the end, and
        there quantiles of its error and the share inside three of its 1σ; the `worst` runs by
        measure.
    """
    file, entries = campaign.file, campaign.entries
    quantities = quantities_of(file.design.arm_request)
    keys = [each.key for each in quantities]
    texts = columns["violated"].tolist()
    broken = Counter(reason for text in texts for reason in text.split(", ") if reason)
    there = set(columns["scenario"].tolist())
    held = columns["premises_hold"]
    return {
        "runs": len(columns["run"]),
        "asked": entries.runs,
        "duration": entries.duration,
        "design": file.identity,
        "scenarios": {
            name: _scenario(columns, keys, columns["scenario"] == name)
            for name in entries.scenarios
            if name in there
        },
        "quantities": {
            each.key: {"unit": each.unit, "rmse": _quantiles(columns[f"{each.key}_rmse"])}
            for each in quantities
        },
        "bounds": {
            group: {claim: _claim(columns, keys, claim, chosen) for claim in CLAIMS}
            for group, chosen in (("premises hold", held), ("they do not", ~held))
        },
        "violated": dict(broken.most_common()),
        "learnt": {name: _learnt(columns, name) for name in campaign.settings.learnt(file.design)},
        "worst": _worst(columns, keys, entries.repeats),
        "failed": int((~np.isfinite(columns["normalised_rmse"])).sum()),
    }


def render(summary: Mapping[str, Any]) -> str:
    """Return the tables of a summary for people."""
    runs, asked, failed = (summary[name] for name in ("runs", "asked", "failed"))
    there = f"{runs:,}" + (f" of {asked:,}" if runs < asked else "")
    head = f"{there} runs of {summary['duration']:g} s, design {summary['design']}"
    if failed:
        head += f"; {failed:,} runs with an error that is not known"
    scenarios = [
        [
            name,
            f"{one['runs']:,}",
            _share(one["premises_hold"]),
            *map(_number, one["normalised_rmse"]),
            _share(one["inside"]),
        ]
        for name, one in summary["scenarios"].items()
    ]
    errors = [[name, one["unit"], *map(_number, one["rmse"])]
              for name, one in summary["quantities"].items()]  # fmt: skip
    bounds = [
        [f"{claim}; {group}", _share(one["samples"]), *_hardest(one["quantities"])]
        for group, claims in summary["bounds"].items()
        for claim, one in claims.items()
        if one["samples"]
    ]
    parts = [
        head,
        _table(["normalised RMSE", "runs", "premises hold", *_NAMES, "inside"], scenarios),
        _table(["RMSE", "unit", *_NAMES], errors),
        _table(["bounds said to be", "samples", "inside", "rms", "worst", "of run"], bounds)
        + f"\ninside: share of errors within {SIGMAS:g} bounds; rms, worst: of error / bound; "
        "of the quantity where they are worst",
    ]
    if violated := summary["violated"]:
        counts = ", ".join(f"{name} {count:,}" for name, count in violated.items())
        parts.append(f"premises that do not hold, in so many runs: {counts}")
    if summary["learnt"]:
        learnt = [
            [name, _share(one["valid"]), *map(_number, one["error"]), _share(one["inside"])]
            for name, one in summary["learnt"].items()
        ]
        parts.append(_table(["error of what is learnt", "valid", *_NAMES, "inside"], learnt))
    for measure, worst in summary["worst"].items():
        rows = [
            [str(one["run"]), one["scenario"], _number(one["value"]), one["violated"] or "none"]
            for one in worst
        ]
        parts.append(_table(["run", "scenario", measure, "premises that do not hold"], rows))
    return "\n\n".join(parts)


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
        return [None] * len(_QUANTILES)
    return [float(value) for value in np.quantile(known, _QUANTILES)]


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


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(aligned([head, *rows], text_columns=1))
