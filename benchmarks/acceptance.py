# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every scenario, every contender, on the same simulated data; and the demands on our observer.

`certified` and `riccati` are the node's observer, with either gain; `fixed` is the certified gain
alone. The rivals are two EKFs with a gate and a reset: `ekf_gated` with the nominal arm, and
`ekf_gated_augmented` with stiffness and gravity as states. Both also run without the reset.
`ekf_plain`, `ekf_augmented` and `ekf_true`, which has the true arm, have no gate. PO and PIO have
the best θ of a grid for each scenario and window.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from multiprocessing import Pool
from typing import Any

import numpy as np
from acceptance_demands import PLAIN, Demand, cost_demands, demands, ratio_of
from acceptance_runs import Found, Outcome, high_gain, kalman, ours, outcome
from common import design_of, parser, use_one_thread
from observer_step import step_costs
from pages import end, head, options_of, row

from tsobs_ros.design.record import Design
from tsobs_ros.design.request import DisturbanceTerm
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation import baselines
from tsobs_ros.simulation.plant import Scenario, Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

_CHUNK = 10
_TONE = 3.0
_CLOSE = 1.05
"""A ratio below this counts as no difference."""

_SHOWN = ("ratio", "inside", "claimed")
"""Kinds of demands with a column of the table."""

Contender = Callable[[Design, Scenario, Trajectories], Found]

_EVERYWHERE: dict[str, Contender] = {
    "certified": lambda design, _, runs: ours(design, runs),
    "ekf_gated": lambda design, _, runs: kalman(design, runs, gated=True),
    "ekf_gated_augmented": lambda design, _, runs: kalman(design, runs, learns=True, gated=True),
    "ekf_without_reset": lambda design, _, runs: kalman(design, runs, gated=True, resets=False),
    "ekf_without_reset_augmented": lambda design, _, runs: kalman(
        design, runs, learns=True, gated=True, resets=False
    ),
    "ekf_plain": lambda design, _, runs: kalman(design, runs),
    "ekf_true": lambda design, scenario, runs: kalman(design, runs, scenario.true_arm),
    "ekf_augmented": lambda design, _, runs: kalman(design, runs, learns=True),
}
_PLAIN: dict[str, Contender] = {
    "riccati": lambda design, _, runs: ours(design, runs, "riccati"),
    "fixed": lambda design, _, runs: ours(design, runs, adapt=False, alone=True),
}
_WITHOUT_RESET = ("ekf_without_reset", "ekf_without_reset_augmented")
_TUNED = {"po": baselines.high_gain, "pio": baselines.proportional_integral}

Job = tuple[str, Design, tuple[int, ...], bool]
"""Scenario, design, seeds, and whether the contenders are those that are tuned on all runs."""


def _work(job: Job) -> tuple[str, dict[str, Outcome]]:
    """Return the outcomes of one scenario for some seeds."""
    name, design, seeds, tuned = job
    scenario = SCENARIOS[name]
    runs = simulate(scenario, seeds)
    if tuned:
        return name, {who: high_gain(kind, design, runs) for who, kind in _TUNED.items()}
    contenders = _EVERYWHERE | (_PLAIN if name in PLAIN else {})
    found = {
        who: outcome(scenario, runs, contender(design, scenario, runs))
        for who, contender in contenders.items()
    }
    return name, found


def _joined(parts: Sequence[Outcome]) -> Outcome:
    """Return the outcomes of several batches of runs as one."""
    if len(parts) == 1:
        return parts[0]
    values: dict[str, Any] = {}
    for name, first in parts[0]._asdict().items():
        each = [getattr(part, name) for part in parts]
        if isinstance(first, np.ndarray):
            values[name] = np.concatenate(each)
        elif name == "errors":
            values[name] = {key: np.concatenate([one[key] for one in each]) for key in first}
        elif name == "events" and first is not None:
            values[name] = [event for one in each for event in one]
    return Outcome(**values)


def measure(
    design: Design, names: Sequence[str], seeds: Sequence[int], processes: int
) -> dict[str, dict[str, Outcome]]:
    """Return the outcomes by scenario and contender."""
    tone = DisturbanceTerm("sinusoid", {"frequency": _TONE})
    terms = (*design.request.disturbance, tone)
    toned = synthesise(replace(design.request, disturbance=terms))
    jobs: list[Job] = []
    for name in names:
        used = toned if "sinusoid" in name else design
        if name in PLAIN:
            jobs.append((name, used, tuple(seeds), True))
        for begin in range(0, len(seeds), _CHUNK):
            jobs.append((name, used, tuple(seeds[begin : begin + _CHUNK]), False))
    parts: dict[str, dict[str, list[Outcome]]] = {name: {} for name in names}
    with Pool(processes) as pool:
        for done, (name, found) in enumerate(pool.imap(_work, jobs), 1):
            print(f"{done}/{len(jobs)} {name}", file=sys.stderr, flush=True)
            for who, one in found.items():
                parts[name].setdefault(who, []).append(one)
    return {
        name: {who: _joined(each) for who, each in found.items()} for name, found in parts.items()
    }


def _plain(one: Outcome) -> dict[str, Any]:
    """Return an outcome for JSON, which has no infinity."""

    def listed(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return np.where(np.isfinite(value), value, None).tolist()
        if isinstance(value, dict):
            return {key: listed(each) for key, each in value.items()}
        return value

    return {name: listed(value) for name, value in one._asdict().items() if value is not None}


def _number(value: float) -> str:
    return f"{value:.4f}" if value < 10.0 else "diverges"


def _mean(one: Outcome) -> float:
    """Return the mean error of the settled window."""
    return float(one.errors["settled"].mean())


def _bold(text: str, demand: Demand | None) -> str:
    """Return a number, bold if it misses a demand."""
    return text if demand is None or demand.passed else f"**{text}**"


def _summary(
    results: Mapping[str, Mapping[str, Outcome]], found: Sequence[Demand]
) -> Iterator[str]:
    """Yield the scenarios in which ours loses, and by how much."""
    ratios = {name: ratio_of(one) for name, one in results.items()}
    worse = sorted(
        ((ratio, name) for name, ratio in ratios.items() if ratio > _CLOSE), reverse=True
    )
    listed = ", ".join(f"{name} {ratio:.2f}" for ratio, name in worse) or "none"
    yield (
        f"**Where it loses.** The error is more than {_CLOSE:g} times that of the better of two "
        f"gated EKFs in {len(worse)} of {len(ratios)} scenarios: {listed}. The median of the "
        f"ratios is {np.median(list(ratios.values())):.2f}, the least {min(ratios.values()):.3f}."
    )
    unreset = {
        name: _mean(one["certified"]) / np.nanmin([_mean(one[who]) for who in _WITHOUT_RESET])
        for name, one in results.items()
    }
    better = [(ratio, name) for name, ratio in unreset.items() if ratio > max(ratios[name], _CLOSE)]
    listed = ", ".join(f"{name} {ratio:.2f}" for ratio, name in sorted(better, reverse=True))
    yield (
        "\nWithout their reset these filters wait until a sensor is right again. The better one is "
        f"{_CLOSE:g} times better than ours, and than the rivals, in: {listed or 'none'}; the "
        f"median of the ratios is {np.nanmedian(list(unreset.values())):.2f}."
    )
    outside = []
    for name, one in results.items():
        assert one["certified"].inside is not None
        share = one["certified"].inside.mean(axis=0).min()
        if share < 0.97:
            outside.append((share, f"{name} {share:.2f}"))
    listed = ", ".join(text for _, text in sorted(outside)) or "none"
    yield f"\nLess than 0.97 of the samples lie within three bounds in: {listed}."
    failed = [one for one in found if not one.passed]
    listed = "; ".join(
        f"{one.scenario}, {one.text} {one.value:.3g} ({'≥' if one.at_least else '≤'} {one.bar:g})"
        for one in failed
        if one.kind not in _SHOWN
    )
    yield (
        f"\n{len(failed)} of {len(found)} demands are missed. Those on ratio, inside and claimed "
        f"are bold below; the others: {listed or 'none'}."
    )


def _fair_table(
    results: Mapping[str, Mapping[str, Outcome]], found: Sequence[Demand]
) -> Iterator[str]:
    by_place = {(one.scenario, one.kind): one for one in found}
    yield from head("scenario", "ours", "ratio", "inside", "claimed", "width")
    for name, one in results.items():
        mine = one["certified"]
        assert mine.inside is not None
        assert mine.claimed is not None
        assert mine.width is not None
        shown = (
            f"{ratio_of(one):.2f}",
            f"{mine.inside.mean(axis=0).min():.3f}",
            f"{mine.claimed.mean():.2f}",
        )
        cells = (
            _bold(text, by_place.get((name, kind)))
            for kind, text in zip(_SHOWN, shown, strict=True)
        )
        width = float(np.exp(np.log(mine.width[:, :4]).mean()))
        yield row(name, _number(_mean(mine)), *cells, f"{width:.1f}")


def _plain_table(results: Mapping[str, Mapping[str, Outcome]]) -> Iterator[str]:
    yield from head("scenario", "plain EKF", "with the true arm", "PO", "PIO")
    who = ("ekf_plain", "ekf_true", "po", "pio")
    for name, found in results.items():
        if "po" in found:
            yield row(name, *(_number(_mean(found[each])) for each in who))


def _page(
    results: Mapping[str, Mapping[str, Outcome]],
    found: Sequence[Demand],
    cost: Mapping[str, float],
    what: str,
) -> Iterator[str]:
    """Yield the results, as Markdown."""
    yield from _summary(results, found)
    yield f"\n{what}\n\n## Ours and its rivals\n"
    yield from _fair_table(results, found)
    yield "\n## The other observers\n"
    yield from _plain_table(results)
    yield "\nA step: " + ", ".join(f"{who} {time:.1f} µs" for who, time in cost.items()) + "."


def main() -> None:
    """Measure and print."""
    options = options_of(parser(__doc__), SCENARIOS)
    design = design_of(options)
    # Before the other processes start, which would slow it down.
    cost = step_costs("adaptive", design, 30.0)
    results = measure(design, options.scenarios, options.seeds, options.processes)
    found = [*demands(results), *cost_demands(cost)]
    seeds = options.seeds
    what = f"{options.runs} runs of each scenario, seeds {seeds[0]} to {seeds[-1]}."
    everything = {
        "first_seed": options.first_seed,
        "scenarios": {
            name: {who: _plain(one) for who, one in each.items()} for name, each in results.items()
        },
        "step_us": cost,
    }
    end(options, __file__, "\n".join(_page(results, found, cost, what)), everything, found)


if __name__ == "__main__":
    use_one_thread()
    main()
