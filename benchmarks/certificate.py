# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certified bound X next to the covariance of the errors of many simulated runs.

For each rate a gain is designed, and a batch of arms is observed with it alone. Every run begins
with an error drawn from N(0, X), as wide as the certificate allows, and its bias wanders as the
design assumes. The arms are integrated by Runge-Kutta. The premise is the estimate, which depends
on the noise, so the runs check a case that the certificate does not prove.

At the design's own rate everything is repeated with a sensor that is s times as noisy, with process
noise as designed and s times as large, and with errors from N(0, s²X) at the start.

The printed number is the largest eigenvalue of X⁻¹cov(e)/s² just before a sample. For a sample
covariance this is biased upwards: the first line gives its values if cov(e) were X itself.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from common import at_least, design_of, parser, show, use_one_thread

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.records import Basis
from tsobs_ros.estimation.state import likeliest
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.series import stamps_of
from tsobs_ros.simulation.plant import Plant, Scenario
from tsobs_ros.simulation.sensor import Sensor, SimulatedOutput
from tsobs_ros.simulation.signals import GaussMarkov, Multisine, Sine

_INSTANTS = (0.5, 1.0, 2.0, 5.0, 10.0)
_ACCEPTED = 1.15
_RESAMPLES = 200
_WALK = 1e6
"""A drift with a time constant this long is a random walk over the length of a run [s]."""

_SAMPLES = 1_000_000
"""Number of samples that are simulated at a time, which bounds the memory."""

_REST = {"initial_state": (0.0,) * 4, "initial_spread": (0.01, 0.01, 0.1, 0.1)}
_MOTIONS: dict[str, dict[str, Any]] = {
    "small angles": {**_REST, "inputs": (Sine(0.1, 1.0),)},
    # A little below the usual start, so that no run of a thousand leaves the domain.
    "u = .9 sin t": {"initial_state": (0.26, 0.0, 1.7, 0.0), "inputs": (Sine(0.9, 1.0),)},
    "multisine": {**_REST, "inputs": (Multisine(1.7, 0.4, 6.5, 8),)},
}


class _Noise(NamedTuple):
    """Factors of the designed standard deviations of the sensor's and of the process noise."""

    sensor: float = 1.0
    process: float = 1.0


class _Spread(NamedTuple):
    """The result of one campaign.

    Attributes:
        largest: Largest eigenvalue of X⁻¹cov(e)/s² at each instant, shape (instants,).
        deviation: 1σ of each, by resampling normal errors with the covariance that was found.
        widest: Largest |q₁| and |q̂₁| of all runs [rad].
    """

    largest: Array
    deviation: Array
    widest: float


def _scenario(design: Design, motion: dict[str, Any], scale: _Noise) -> Scenario:
    """Return the design's assumptions as a scenario, with a motion and larger noise."""
    request, square = design.request, scale.process * scale.process
    density = square * request.disturbance[0]["density"]
    noise = request.process_noise
    return Scenario(
        arm=request.arm,
        rate=request.rate,
        process_noise=ProcessNoise(square * noise.link, square * noise.motor),
        outputs=(
            SimulatedOutput(
                sensor=Sensor(noise_std=scale.sensor * request.measurement_std),
                disturbance=(GaussMarkov(np.sqrt(0.5 * density * _WALK), _WALK),),
            ),
        ),
        **motion,
    )


def _largest(errors: Array, root: Array) -> float:
    """Return the largest eigenvalue of X⁻¹cov(e) for errors of shape (runs, n), P = root rootᵀ."""
    scaled = errors @ root
    return float(np.linalg.eigvalsh(scaled.T @ scaled / len(scaled))[-1])


def _campaign(
    design: Design, motion: dict[str, Any], scale: _Noise, runs: int, first_seed: int
) -> _Spread:
    """Observe all runs at once with the certified gain, from errors as wide as s²X."""
    observer, arm, X = design.observer(), design.arm_request.arm, design.covariance_bound
    root, rng = np.linalg.cholesky(design.P), np.random.default_rng(first_seed)
    scenario, widest, n = _scenario(design, motion, scale), 0.0, len(X)
    start, tracker = likeliest(observer.model["initial"]), Tracker(observer, max_steps=1)
    start["covariance"][:n, :n], start["settling"], start["certified"] = X, 0.0, 1
    instants = [round(time * design.request.rate) for time in _INSTANTS]
    found: list[list[Array]] = [[] for _ in instants]
    block = max(1, _SAMPLES // instants[-1])
    for begin in range(first_seed, first_seed + runs, block):
        seeds = range(begin, min(begin + block, first_seed + runs))
        part = Plant(scenario, seeds).run(instants[-1] + 1)
        truth = np.concatenate([part.states, part.disturbances], axis=2)
        drawn = rng.standard_normal(truth[:, 0].shape) @ np.linalg.cholesky(X).T
        stamps = stamps_of(part.times)
        for index, errors in zip(instants, found, strict=True):
            rows, seen = [], slice(index + 1)
            # If the last sample is lost, the estimate stays as it is just before the sample.
            y = part.measurements[:, seen].copy()
            y[:, index] = np.nan
            for run in range(len(seeds)):
                start["x"][:n] = truth[run, 0] - scale.sensor * drawn[run]
                tracker.reset()
                rows.append(tracker.follow(stamps[seen], y[run], part.torques[run, seen]))
            known = np.stack(rows).view(np.recarray)
            assert (known.basis == Basis.CERTIFIED).all()
            last = [arm.from_physical(known.state[:, index]), known.disturbance[:, index]]
            errors.append((truth[:, index] - np.hstack(last)) / scale.sensor)
            angles = (truth[:, : index + 1, 0], known.state[..., 0])
            widest = max(widest, *(float(np.abs(each).max()) for each in angles))
    joined = [np.concatenate(errors) for errors in found]
    largest = np.array([_largest(errors, root) for errors in joined])
    deviation = np.array([_deviation(errors, root, rng) for errors in joined])
    return _Spread(largest, deviation, widest)


def _deviation(errors: Array, root: Array, rng: np.random.Generator) -> float:
    """Return the sampling deviation of the largest eigenvalue, by a parametric bootstrap."""
    half = np.linalg.cholesky(errors.T @ errors / len(errors)).T
    again = [_largest(rng.standard_normal(errors.shape) @ half, root) for _ in range(_RESAMPLES)]
    return float(np.std(again))


def _if_tight(runs: int, n: int) -> dict[str, float]:
    """Return the distribution of the largest eigenvalue if cov(e) were X itself."""
    rng = np.random.default_rng(0)
    drawn = [_largest(rng.standard_normal((runs, n)), np.eye(n)) for _ in range(5 * _RESAMPLES)]
    middle, high = np.quantile(drawn, [0.5, 0.99]).tolist()
    return {"median": middle, "quantile_99": high, "edge": (1.0 + np.sqrt(n / runs)) ** 2}


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--runs", type=at_least(2, int), default=1500)
    made.add_argument("--first-seed", type=at_least(0, int), default=7000)
    made.add_argument(
        "--rates", type=at_least(1.0), nargs="+", default=[100.0, 200.0, 500.0, 1000.0]
    )
    made.add_argument("--scales", type=at_least(1.0), nargs="*", default=[1.5, 3.0], metavar="S")
    options = made.parse_args()
    if options.runs < 100:
        made.error("runs: expected at least 100 for a meaningful covariance")
    request = design_of(options).request
    if [term["kind"] for term in request.disturbance] != ["bias"]:
        made.error("design: expected one whose disturbance is a bias, which is what is simulated")
    tight = _if_tight(options.runs, request.flow.state_count)
    lines = [
        f"largest eigenvalue of X⁻¹cov(e)/s² over {options.runs} runs; for cov(e) = X: median "
        f"{tight['median']:.3f}, 99 % below {tight['quantile_99']:.3f}, "
        f"Marchenko-Pastur edge {tight['edge']:.3f}\n",
        "rate [Hz]  noise, process  motion         widest [rad]  "
        + "".join(f"{f't = {t:g} s':>16s}" for t in _INSTANTS),
    ]
    campaigns, seed = [], options.first_seed
    scales = [_Noise(s, process) for s in options.scales for process in (1.0, s)]
    cases = [(rate, _Noise()) for rate in options.rates] + [(request.rate, one) for one in scales]
    for rate, scale in cases:
        design = synthesise(replace(request, rate=rate))
        for name, motion in _MOTIONS.items():
            # Different seeds in each campaign, for independent samples.
            found = _campaign(design, motion, scale, options.runs, seed)
            seed += options.runs
            pairs = zip(found.largest, found.deviation, strict=True)
            cells = "".join(f"{f'{value:.3f} ± {std:.3f}':>16s}" for value, std in pairs)
            times = f"x {scale.sensor:g}, x {scale.process:g}"
            lines.append(f"{rate:9g}  {times:14s}  {name:13s}  {found.widest:12.2f}  {cells}")
            campaigns.append(
                {
                    "rate": rate,
                    "scales": scale,
                    "motion": name,
                    "widest": found.widest,
                    "x_max": request.x_max,
                    "instants": _INSTANTS,
                    "largest": found.largest.tolist(),
                    "deviation": found.deviation.tolist(),
                }
            )
    worst = max(max(one["largest"]) for one in campaigns)
    inside = all(one["widest"] <= request.x_max for one in campaigns)
    verdict = "accepted" if worst <= _ACCEPTED and inside else "not accepted"
    lines.append(
        f"\nworst {worst:.3f}, expected at most {_ACCEPTED}; all angles "
        f"{'inside' if inside else 'NOT inside'} |q1| <= {request.x_max:g}: {verdict}"
    )
    everything = {"runs": options.runs, "tight": tight, "campaigns": campaigns, "worst": worst}
    show(everything, "\n".join(lines), options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
