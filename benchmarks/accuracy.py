# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of the node's observer next to those of an EKF with the same model, over many seeds.

The observer is that of the node: the certified one under supervision. The EKF has the same
disturbance state and noise densities and is plain: it always uses the Kalman gain along its own
estimate, without gates or health logic. Errors are taken just before each sample, when an estimate
is oldest; these are the errors that the certificate bounds. Parts: `settled` 45-60 s, `full`
20-60 s, `around` all except 5 s after the start and after a jump at 30 s.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from common import at_least, design_of, parser, show, use_one_thread
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.estimator import GAIN_MODES, Estimator, SupervisionOptions
from tsobs_ros.report.metrics import SCALE, SIGMAS
from tsobs_ros.simulation.plant import Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate
from tsobs_ros.simulation.signals import BiasStep

_NO_ADAPTATION = ("noise", "bias_step", "drift", "outliers", "dropouts")


class _Estimates(NamedTuple):
    """States (rad, rad/s) and disturbance [rad] with their 1σ bounds, (runs, samples, 5) each."""

    values: Array
    bounds: Array


def _estimate(estimator: Estimator, runs: Trajectories) -> _Estimates:
    """Return the estimates of each run just before each sample."""
    shape = (*runs.measurements.shape[:2], 5)
    values, bounds = np.empty(shape), np.empty(shape)
    for run, (y, u) in enumerate(zip(runs.measurements, runs.torques, strict=True)):
        state = estimator.initial()
        for sample in range(shape[1]):
            known = estimator.readout(state)
            values[run, sample] = np.append(known.state, known.disturbance)
            bounds[run, sample] = np.append(known.state_bound, known.disturbance_bound)
            if np.isfinite(y[sample]).all():
                state, _ = estimator.correct(state, y[sample])
            state = estimator.predict(state, u[sample], estimator.period)
    return _Estimates(values, bounds)


def _parts(times: Array, jumps: bool) -> dict[str, NDArray[np.bool_]]:
    around = times >= 5.0
    if jumps:
        around &= (times < 30.0) | (times >= 35.0)
    return {"settled": times >= 45.0, "full": times >= 20.0, "around": around}


def _errors(error: Array, part: NDArray[np.bool_]) -> dict[str, Array]:
    """Return the normalised RMSE of the states and the RMSE of the disturbance, each (runs,)."""
    rmse = np.sqrt((error[:, part] ** 2).mean(axis=1))
    relative = rmse[:, :4] / np.array(SCALE)
    return {"normalised": np.sqrt((relative**2).mean(axis=1)), "disturbance": rmse[:, 4]}


def _quartiles(values: Array) -> dict[str, float]:
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
    return {"median": middle, "lower_quartile": low, "upper_quartile": high}


def _measure(design: Design, scenario: str, seeds: list[int], mode: str) -> dict[str, Any]:
    """Return errors, ratios to the EKF and the bound's hit rate of one scenario, by part."""
    runs = simulate(SCENARIOS[scenario], seeds)
    truth = np.concatenate([runs.physical, runs.disturbances], axis=2)
    ours = _estimate(design.observer(gain_mode=mode, supervision=SupervisionOptions()), runs)
    ekf = _estimate(design.observer(gain_mode="riccati"), runs)
    jumps = any(isinstance(one, BiasStep) for one in SCENARIOS[scenario].outputs[0].disturbance)
    results: dict[str, Any] = {}
    for name, part in _parts(runs.times, jumps).items():
        mine, theirs = (_errors(each.values - truth, part) for each in (ours, ekf))
        hits = np.abs(ours.values - truth)[:, part] <= SIGMAS * ours.bounds[:, part]
        results[name] = {
            "observer": {key: _quartiles(value) for key, value in mine.items()},
            "ekf": {key: _quartiles(value) for key, value in theirs.items()},
            "ratio": {key: _quartiles(mine[key] / theirs[key]) for key in mine},
            "inside_percent": {
                "worst_quantity": 100.0 * float(hits.mean(axis=(0, 1)).min()),
                "worst_run": 100.0 * float(hits.mean(axis=(1, 2)).min()),
            },
        }
    return results


def _table(results: dict[str, Any]) -> Iterator[str]:
    yield (
        "                    normalised RMSE              disturbance RMSE [mrad]      inside 3σ\n"
        "scenario   part     observer   EKF   ratio (IQR)         observer  EKF  ratio (IQR)"
        "         worst quantity / run"
    )
    for scenario, parts in results.items():
        for part, one in parts.items():
            cells = [f"{scenario:10s} {part:8s}"]
            for key, unit in (("normalised", 1.0), ("disturbance", 1e3)):
                mine, theirs = (one[who][key]["median"] * unit for who in ("observer", "ekf"))
                ratio = one["ratio"][key]
                digits = 4 if unit == 1.0 else 2
                cells.append(
                    f"{mine:.{digits}f}  {theirs:.{digits}f}  {ratio['median']:.2f} "
                    f"({ratio['lower_quartile']:.2f}-{ratio['upper_quartile']:.2f})    "
                )
            inside = one["inside_percent"]
            cells.append(f"{inside['worst_quantity']:.2f} % / {inside['worst_run']:.2f} %")
            yield "  ".join(cells)


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument(
        "--seeds", type=at_least(1, int), default=20, help="number of runs of each scenario"
    )
    made.add_argument("--first-seed", type=at_least(0, int), default=1000)
    made.add_argument("--gain-mode", choices=GAIN_MODES, default="certified")
    made.add_argument(
        "scenarios", nargs="*", metavar="SCENARIO", help=f"default: {', '.join(_NO_ADAPTATION)}"
    )
    options = made.parse_args()
    unknown = [name for name in options.scenarios if name not in SCENARIOS]
    if unknown:
        made.error(f"no scenario {unknown[0]}; there is {', '.join(SCENARIOS)}")
    design = design_of(options)
    seeds = list(range(options.first_seed, options.first_seed + options.seeds))
    names = options.scenarios or _NO_ADAPTATION
    mode = options.gain_mode
    results = {name: _measure(design, name, seeds, mode) for name in names}
    head = f"medians over {options.seeds} seeds from {options.first_seed}, 60 s each, {mode} gain\n"
    everything = {
        "seeds": options.seeds,
        "first_seed": options.first_seed,
        "gain_mode": mode,
        "scenarios": results,
    }
    show(everything, "\n".join([head, *_table(results)]), options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
