# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every scenario, every contender, on the same simulated data; and what is demanded of ours.

The EKFs are plain: no gates, no search for jumps, no projection. `ekf_true` predicts with the true
arm; `ekf_augmented` has θ of stiffness and gravity as states. Ours learns the same two, under
supervision, with either gain; `fixed` is ours without learning. PO and PIO have the best θ of a
grid for each scenario and window.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from multiprocessing import Pool
from typing import Any

import numpy as np
from acceptance_cost import step_cost
from acceptance_lines import Line, cost_lines, lines
from acceptance_runs import (
    Outcome,
    augmented,
    high_gain,
    knowing,
    observe,
    outcome,
    supervised,
)
from common import design_of, parser, show, use_one_thread

from tsobs_ros.design.record import Design
from tsobs_ros.design.request import DisturbanceTerm
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation import baselines
from tsobs_ros.estimation.options import GainMode
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

_CONTENDERS = (
    "certified", "riccati", "fixed", "ekf_true", "ekf_augmented", "po", "pio",
)  # fmt: skip
_CHUNK = 10
_TONE = 3.0

Job = tuple[str, Design, tuple[int, ...], bool]
"""Scenario, design, seeds, and whether it is the contenders that take a batch."""


def _work(job: Job) -> tuple[str, bool, dict[str, Outcome]]:
    """Return the outcomes of one scenario for some seeds."""
    name, design, seeds, batch = job
    scenario = SCENARIOS[name]
    runs = simulate(scenario, seeds)
    if batch:
        kinds = {"po": baselines.high_gain, "pio": baselines.proportional_integral}
        found = {who: high_gain(kind, design, runs) for who, kind in kinds.items()}
        found["ekf_true"] = outcome(scenario, runs, knowing(design, scenario, runs))
        found["ekf_augmented"] = outcome(scenario, runs, *augmented(design, runs))
        return name, batch, found
    contenders = {
        "certified": (GainMode.CERTIFIED, True),
        "riccati": (GainMode.RICCATI, True),
        "fixed": (GainMode.CERTIFIED, False),
    }
    found = {}
    for who, (mode, adaptive) in contenders.items():
        estimates = observe(design, lambda m=mode, a=adaptive: supervised(design, m, a), runs)  # type: ignore[misc]
        found[who] = outcome(scenario, runs, *estimates)
    return name, batch, found


def _joined(parts: Sequence[Outcome]) -> Outcome:
    """Return the outcomes of several batches of runs as one."""
    if len(parts) == 1:
        return parts[0]
    thetas = [part.theta for part in parts if part.theta is not None]
    after = [part.settled_after for part in parts if part.settled_after is not None]
    return Outcome(
        {name: np.concatenate([part.errors[name] for part in parts]) for name in parts[0].errors},
        np.concatenate(thetas) if thetas else None,
        np.concatenate(after) if after else None,
        [event for part in parts for event in part.events or []],
    )


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
        jobs.append((name, used, tuple(seeds), True))
        for begin in range(0, len(seeds), _CHUNK):
            jobs.append((name, used, tuple(seeds[begin : begin + _CHUNK]), False))
    parts: dict[str, dict[str, list[Outcome]]] = {name: {} for name in names}
    with Pool(processes) as pool:
        for done, (name, _, found) in enumerate(pool.imap(_work, jobs), 1):
            print(f"{done}/{len(jobs)} {name}", file=sys.stderr, flush=True)
            for who, one in found.items():
                parts[name].setdefault(who, []).append(one)
    return {
        name: {who: _joined(parts[name][who]) for who in _CONTENDERS} for name in names
    }  # fmt: skip


def _plain(one: Outcome) -> dict[str, Any]:
    """Return an outcome for JSON, which has no infinity."""

    def listed(values: Any) -> Any:
        return np.where(np.isfinite(values), values, None).tolist()

    events = one.events or []
    return {
        "errors": {name: listed(values) for name, values in one.errors.items()},
        "theta_rmse": None if one.theta is None else listed(one.theta),
        "settled_after_s": None if one.settled_after is None else listed(one.settled_after),
        "events": {key: [event[key] for event in events] for key in (events or [{}])[0]},
        "tuning": one.tuning,
    }


def _table(results: dict[str, dict[str, Outcome]]) -> Iterator[str]:
    yield "| scenario | " + " | ".join(_CONTENDERS) + " | worst certified, riccati |"
    yield "|---" * (len(_CONTENDERS) + 2) + "|"
    for name, found in results.items():
        cells = []
        for who in _CONTENDERS:
            means = [found[who].errors[window].mean() for window in ("settled", "full")]
            spread = found[who].errors["settled"].std()
            cells.append(f"{means[0]:.4f} ± {spread:.4f} / {means[1]:.4f}")
        worst = [f"{found[who].errors['settled'].max():.4f}" for who in ("certified", "riccati")]
        yield f"| {name} | " + " | ".join(cells) + f" | {', '.join(worst)} |"
    yield "\n| scenario | θ RMSE certified | riccati | ekf_augmented | settled again [s] |"
    yield "|---" * 5 + "|"
    for name, found in results.items():
        cells = []
        for who in ("certified", "riccati", "ekf_augmented"):
            theta = found[who].theta
            assert theta is not None
            cells.append(", ".join(f"{v:.4f}" for v in np.sqrt((theta**2).mean(axis=0))))
        after = []
        for who in ("certified", "riccati", "ekf_true", "ekf_augmented"):
            times = found[who].settled_after
            if times is not None:
                low, high, most = np.quantile(times, [0.5, 0.9, 1.0], method="higher")
                after.append(f"{who} {low:.1f}, {high:.1f}, {most:.1f}")
        yield f"| {name} | " + " | ".join(cells) + f" | {'; '.join(after)} |"


def _verdicts(demands: Sequence[Line]) -> Iterator[str]:
    yield "| demand | number | limit | | median of ratios |\n|---|---|---|---|---|"
    for line in demands:
        median = "" if line.median is None else f"{line.median:.3f}"
        verdict = "PASS" if line.passed else "FAIL"
        yield f"| {line.text} | {line.value:.4g} | {line.limit:g} | {verdict} | {median} |"


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--runs", type=int, default=40, help="number of runs of each scenario")
    made.add_argument("--first-seed", type=int, default=9000)
    made.add_argument("--processes", type=int, default=2)
    made.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="default: all")
    options = made.parse_args()
    unknown = [name for name in options.scenarios if name not in SCENARIOS]
    if unknown:
        made.error(f"no scenario {unknown[0]}; there is {', '.join(SCENARIOS)}")
    design = design_of(options)
    # Before the other processes start, which would be in its way.
    cost = step_cost(design)
    seeds = range(options.first_seed, options.first_seed + options.runs)
    results = measure(design, options.scenarios or list(SCENARIOS), seeds, options.processes)
    demands = [*lines(results), *cost_lines(cost)]
    text = "\n".join(
        [
            f"{options.runs} runs from seed {options.first_seed}, 60 s each. Normalised RMSE,",
            "settled (mean ± deviation) / full (mean). The EKFs are plain, without health logic.\n",
            *_table(results),
            "\nSettled again: median, nine in ten, slowest run.\n",
            *_verdicts(demands),
            "\nstep, median: " + ", ".join(f"{who} {time:.1f} µs" for who, time in cost.items()),
        ]
    )
    everything = {
        "runs": options.runs,
        "first_seed": options.first_seed,
        "scenarios": {
            name: {who: _plain(one) for who, one in found.items()}
            for name, found in results.items()
        },
        "demands": [{**line._asdict(), "passed": line.passed} for line in demands],
        "step_us": cost,
    }
    show(everything, text, options.json)
    sys.exit(0 if all(line.passed for line in demands) else 1)


if __name__ == "__main__":
    use_one_thread()
    main()
