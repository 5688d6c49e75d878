# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The constants of the bank of hypotheses: effects of halving and doubling each, and of each part.

Every variant runs over the same scenarios. Its error is the geometric mean, over scenarios and
runs, of the normalised error, relative to that with the present constants. A claim is broken if any
error is beyond three bounds. The ablations switch off one part each.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from multiprocessing import Pool
from typing import NamedTuple

import numpy as np
from acceptance_runs import SCALE
from common import parser, use_one_thread
from pages import end, head, options_of, row
from precise_joints import CASES, simulated

from tsobs_ros.campaign.batches import Observed, observe
from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.plant import Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

CONSTANTS = {name: (value, what) for name, value, what in native.BANK_CONSTANTS}
"""Value and meaning by name."""

SCENES = (
    "noise", "stiff_bias_step", "softer_heavier", "stiff_many_outliers", "stiff_bursts",
    "stiff_loud_2", "stiff_pulses", "steps", "slight_friction", "stiff_friction",
    "correlated_0.9", "drift", "late_payload", "wrong_effort_50", "stiff_dropouts",
    "tone_0.1_3", "tone_0.03_8", "wander", "heavy_link", "backlash_0.03", "stiff_missing",
    "light_link", "mix_stiff_outliers_step",
)  # fmt: skip
"""Scenarios that together need all parts of the bank."""

JOINTS = ("stiff_hits_3", "stiff_motor", "light_hits_10", "light_motor_hits_3")
"""Precise joints."""

ELSEWHERE = "put_elsewhere"
"""A scenario with an arm that is 20 % stiffer and is moved elsewhere after 40 s."""

_OFF = 1e9
"""A value above any price or sign."""

ABLATIONS: dict[str, dict[str, float]] = {
    "no FORCE": {"FORCE_SHARE": 0.0},
    "no IMPERFECT": {"IMPERFECTION": 1.0},
    "no LOUD": {"NOISE_FACTOR": 1.0},
    "no COLOURED_NOISE": {"COLOUR_SIZE": 0.0},
    "no DRIFT": {"DRIFT_SIZE": 0.0},
    "no TONE": {"TONE_SIGN": _OFF},
    "no forks of jumps and hits": {"FORK_PRICE": _OFF},
    "no forks of moved arms": {"LOST_PRICE": _OFF},
    "no forks": {"FORK_PRICE": _OFF, "LOST_PRICE": _OFF, "TORQUE_PRICE": _OFF},
    "the design alone": {
        "FORCE_SHARE": 0.0, "IMPERFECTION": 1.0, "NOISE_FACTOR": 1.0, "COLOUR_SIZE": 0.0,
        "DRIFT_SIZE": 0.0, "TONE_SIGN": _OFF, "FORK_PRICE": _OFF, "LOST_PRICE": _OFF,
        "TORQUE_PRICE": _OFF,
    },
    "jumps at outliers only": {"SUDDEN": _OFF},
    "no significance": {"significance": 0.0},
    "no passes": {"pass_time": _OFF},
    "no widening": {"QUIET": _OFF},
    "no CURVED": {"CURVED": 0.0},
}  # fmt: skip
"""Changes of constants and of the model's record, by the part that is lost."""


def put_elsewhere(seeds: Sequence[int]) -> Trajectories:
    """Return runs whose arm is suddenly at another angle from 40 s on."""
    before = SCENARIOS["stiff"]
    after = replace(before, initial_state=(1.0, 0.0, 1.0, 0.0))
    one, other = simulate(before, seeds), simulate(after, [seed + 1000 for seed in seeds])
    place = int(np.searchsorted(one.times, 40.0))
    joined = [
        np.concatenate([a[:, :place], b[:, : a.shape[1] - place]], axis=1)
        for a, b in zip(one[1:], other[1:], strict=True)
    ]
    return Trajectories(one.times, *joined)


class Score(NamedTuple):
    """The results of a variant in a scenario, each of shape (runs,).

    Attributes:
        errors: Normalised error; for a precise joint, the error of the hidden angle [rad].
        claimed: Share of samples with claimed bounds.
        broken: Share of samples with claimed bounds and an error beyond them.
    """

    errors: Array
    claimed: Array
    broken: Array


def variants() -> dict[str, dict[str, float]]:
    """Return all changes by the name of the variant."""
    found: dict[str, dict[str, float]] = {"": {}} | ABLATIONS
    for name, (value, _) in CONSTANTS.items():
        found |= {f"{name} / 2": {name: 0.5 * value}, f"{name} × 2": {name: 2.0 * value}}
    return found


def observed(runs: Trajectories, design: Design, changes: Mapping[str, float]) -> Observed:
    """Return the node's estimates with other constants."""
    settings = ObserverSettings()
    estimator = make_estimator(design, settings)
    names, model = list(CONSTANTS), estimator.model[0]
    for name, value in changes.items():
        if name == "FORCE_SHARE":
            model["force"] *= value / CONSTANTS[name][0]
        if name in CONSTANTS:
            model["constants"][names.index(name)] = value
        else:
            model[name] = value
    return observe(design, runs, settings, estimator)


def _judged(runs: Trajectories, found: Observed, hidden: int | None) -> Score:
    """Return the score of estimates over the second half of the runs."""
    late = runs.times >= 0.5 * runs.times[-1]
    away = (found.rows["state"] - runs.physical)[:, late]
    kept = (np.abs(away) <= SIGMAS * found.rows["state_bound"][:, late]).all(axis=2)
    if hidden is None:
        wrong = np.abs(found.rows["disturbance"] - runs.disturbances)[:, late]
        kept &= (wrong <= SIGMAS * found.rows["disturbance_bound"][:, late]).all(axis=2)
    claims = found.rows["claimed"][:, late] > 0.0
    weights = np.eye(4)[0 if hidden is None else hidden]
    if hidden is None:
        to_design = SCENARIOS["noise"].arm.from_physical(np.ones(4))
        weights = (to_design / SCALE) ** 2 / 4.0
    errors = np.sqrt((away**2 @ weights).mean(axis=1))
    return Score(errors, claims.mean(axis=1), (claims & ~kept).mean(axis=1))


def _work(job: tuple[str, tuple[int, ...]]) -> tuple[str, dict[str, Score]]:
    """Return the scores of all variants in a scenario."""
    name, seeds = job
    if name not in JOINTS:
        design, hidden = load_design(config_path(SHIPPED_DESIGN)), None
        is_put = name == ELSEWHERE
        runs = put_elsewhere(seeds) if is_put else simulate(SCENARIOS[name], seeds)
    else:
        case = CASES[name]
        design, hidden, runs = synthesise(case.request), case.hidden, simulated(case, seeds)
    return name, {
        variant: _judged(runs, observed(runs, design, changes), hidden)
        for variant, changes in variants().items()
    }


class Effect(NamedTuple):
    """The effect of a variant over all scenarios.

    Attributes:
        error: Geometric mean of the errors, relative to that with the present constants.
        worst: The scenario in which it loses most, and by how much.
        claimed: Share of samples with claimed bounds.
        broken: Share of these with an error beyond them.
    """

    error: float
    worst: tuple[str, float]
    claimed: float
    broken: float


def effects(results: Mapping[str, Mapping[str, Score]]) -> dict[str, Effect]:
    """Return the effect of each variant."""
    found = {}
    for variant in variants():
        lost = {
            name: float(np.log(one[variant].errors / one[""].errors).mean())
            for name, one in results.items()
        }
        worst = max(lost, key=lambda name: lost[name])
        claimed, broken = (
            float(np.mean([getattr(one[variant], share) for one in results.values()]))
            for share in ("claimed", "broken")
        )
        found[variant] = Effect(
            float(np.exp(np.mean(list(lost.values())))),
            (worst, float(np.exp(lost[worst]))),
            claimed,
            broken / max(claimed, 1e-9),
        )
    return found


def _claims(one: Effect, now: Effect) -> str:
    """Return the shares of claims in brackets if they change."""
    if abs(one.claimed - now.claimed) < 0.01 and abs(one.broken - now.broken) < 0.003:
        return ""
    return f" ({one.claimed:.2f}, {one.broken:.3f})"


def _page(found: Mapping[str, Effect], what: str) -> Iterator[str]:
    """Yield both tables, as Markdown."""
    now = found[""]
    yield f"{what} As they are: claimed {now.claimed:.2f}, of these broken {now.broken:.3f}.\n"
    yield from head("constant", "value", "what it is", "half", "twice")
    for name, (value, meaning) in CONSTANTS.items():
        cells = []
        for one in (found[f"{name} / 2"], found[f"{name} × 2"]):
            cells.append(f"{one.error:.2f}{_claims(one, now)}")
        yield row(f"`{name}`", f"{value:g}", meaning, *cells)
    yield ""
    yield from head("switched off", "error", "where most")
    for name in ABLATIONS:
        one = found[name]
        worst = f"{one.worst[0]} {one.worst[1]:.1f}" if one.worst[1] >= 1.1 else ""
        yield row(name, f"{one.error:.2f}{_claims(one, now)}", worst)


def main() -> None:
    """Measure and print."""
    known = (*SCENES, ELSEWHERE, *JOINTS)
    options = options_of(parser(__doc__, design=False), known)
    jobs = [(name, tuple(options.seeds)) for name in options.scenarios]
    results: dict[str, dict[str, Score]] = {}
    with Pool(options.processes) as pool:
        for name, one in pool.imap_unordered(_work, jobs):
            results[name] = one
            print(f"{len(results)}/{len(jobs)} {name}", file=sys.stderr, flush=True)
    found = effects({name: results[name] for name in options.scenarios})
    runs = f"{options.runs} run{'s' if options.runs > 1 else ''}"
    what = f"{runs} of each of {len(options.scenarios)} scenarios."
    listed = {variant or "as it is": one._asdict() for variant, one in found.items()}
    end(options, __file__, "\n".join(_page(found, what)), {"variants": listed}, [])


if __name__ == "__main__":
    use_one_thread()
    main()
