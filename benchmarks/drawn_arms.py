# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Randomly drawn arms, encoders, rates and faults: ours next to two gated EKFs.

Each arm gets its own design and one run of half a minute. The draw covers inertias, stiffness and
dampings, process noise, the encoder's side and noise, the motion, the errors of the parameters, and
other faults. The errors of the four states are divided by the standard deviations of their motion;
the rivals are those of acceptance.py.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from math import exp, inf, isfinite, log, sqrt
from multiprocessing import Pool
from typing import NamedTuple

import numpy as np
from acceptance_runs import kalman, ours
from common import parser, use_one_thread
from pages import end, head, options_of, row

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.simulation.plant import Friction, Mismatch, Scenario
from tsobs_ros.simulation.scenarios import simulate
from tsobs_ros.simulation.sensor import Sensor, SimulatedOutput
from tsobs_ros.simulation.signals import BiasStep, GaussMarkov, Signal, Sine, Sinusoid

DURATION, _JUDGED = 30.0, 10.0
"""Length of a run, and time at which judging begins [s]."""

_RATES = (100.0, 200.0, 250.0, 500.0, 1000.0)
_WORSE = 1.15
"""A ratio above this counts as worse."""

_LOG_RATIO = log(100.0)
"""In the mean, a ratio counts as a hundred at most and as a hundredth at least."""


class Case(NamedTuple):
    """A drawn arm: the request of its design, its scenario, and its group in the table."""

    request: ArmRequest
    scenario: Scenario
    group: str


class Judged(NamedTuple):
    """Our error over the better EKF's, share of claimed samples, share of these beyond 3 bounds."""

    group: str
    ratio: float
    claimed: float
    broken: float


def drawn(seed: int) -> Case:
    """Draw an arm with its encoder and its faults."""
    random = np.random.default_rng(seed)

    def between(least: float, most: float) -> float:
        return exp(random.uniform(log(least), log(most)))

    def happens(probability: float) -> bool:
        return bool(random.random() < probability)

    link, swing = between(0.005, 3.0), between(2.5, 8.0)  # [kg m^2], [rad/s]
    spring = swing * between(1.5, 12.0)
    motor, damping = link * between(0.2, 4.0), between(1e-3, 0.05)
    arm = ElasticJointArm(
        link, motor, link * spring**2, link * swing**2, damping * link * swing,
        damping * motor * spring,
    )  # fmt: skip
    fastest = spring * sqrt(1.0 + link / motor)
    rate = next((each for each in _RATES if each > 2.5 * fastest), _RATES[-1])
    side = "link_angle" if happens(0.67) else "motor_angle"
    sigma, walk = between(3e-4, 0.03), between(1e-6, 2e-4)
    biased = side == "link_angle" and happens(0.7)
    bias = DisturbanceTerm("bias", {"density": walk, "initial_std": 0.3})
    noise = ProcessNoise(*(between(1e-5, 0.1) * swing**2 / 10.0 for _ in range(2)))
    request = ArmRequest(
        arm, process_noise=noise, outputs=(Output(side, sigma, (bias,) if biased else ()),),
        rate=rate, x_max=0.9 if biased else 1.5,
    )  # fmt: skip
    wrong = Mismatch(
        stiffness=happens(0.65) * random.uniform(-0.3, 0.3),
        gravity_torque=happens(0.4) * random.uniform(-0.25, 0.25),
        link_inertia=happens(0.15) * random.uniform(-0.1, 0.1),
    )
    rub = Friction(motor_coulomb=happens(0.2) * random.uniform(0.005, 0.04) * arm.gravity_torque)
    sensor = Sensor(
        sigma * (between(0.5, 2.5) if happens(0.35) else 1.0),
        outlier_probability=happens(0.25) * random.uniform(0.005, 0.05),
        outlier_size=between(20.0 * sigma, 2.0),
        outlier_is_uniform=True,
        loss_probability=happens(0.15) * random.uniform(0.05, 0.3),
    )
    what, signals, fault = random.random(), list[Signal](), ""
    if biased and what < 0.25:
        signals.append(BiasStep(between(3.0, 30.0) * sigma, random.uniform(8.0, 20.0)))
    elif biased and what < 0.4:
        signals.append(GaussMarkov(sqrt(500.0 * walk), 1000.0))
    elif what > 0.85:
        fault = "an unknown tone"
        signals.append(Sinusoid(between(2.0, 20.0) * sigma, between(0.9, 12.0), 2.0))
    if rub.motor_coulomb or wrong.link_inertia:
        fault = fault or "friction or another inertia"
    learnt = wrong.stiffness or wrong.gravity_torque
    frequency = random.uniform(0.3, 1.2) * min(swing, 3.0)
    amplitude = random.uniform(0.15, 0.6) * arm.gravity_torque
    scenario = Scenario(
        arm=arm, mismatch=wrong, friction=rub, process_noise=noise, rate=rate, duration=DURATION,
        outputs=(SimulatedOutput(side, sensor, tuple(signals)),),
        inputs=(Sine(amplitude * max(0.1, abs(1.0 - (frequency / swing) ** 2)), frequency),),
        initial_state=(0.0,) * 4, initial_spread=(0.1,) * 4,
    )  # fmt: skip
    group = fault or ("other stiffness or gravity" if learnt else "the arm is as designed")
    return Case(request, scenario, group)


def compared(
    group: str, states: Array, rows: Mapping[str, Array], claims: Array, rivals: Sequence[Array]
) -> Judged:
    """Judge estimates of a run, `state` and `state_bound` of rows, against those of the rivals."""
    broken = (np.abs(rows["state"] - states) > SIGMAS * rows["state_bound"]).any(axis=1)
    claimed = claims > 0.0
    return Judged(
        group,
        _error(states, rows["state"]) / min(_error(states, each) for each in rivals),
        float(claimed.mean()),
        float((claimed & broken).sum() / max(claimed.sum(), 1)),
    )


def _error(states: Array, estimates: Array) -> float:
    with np.errstate(all="ignore"):  # a filter that diverges is a result
        away = (estimates - states) / states.std(axis=0)
        error = float(np.sqrt((away**2).mean(axis=0)).mean())
    return error if isfinite(error) else inf


def judged(seed: int) -> Judged:
    """Design, simulate and judge an arm."""
    case = drawn(seed)
    design: Design = synthesise(case.request)
    runs = simulate(case.scenario, [seed])
    mine, late = ours(design, runs), runs.times >= _JUDGED
    rivals = [kalman(design, runs, learns=own, gated=True) for own in (False, True)]
    state, bound = mine.estimates[0, late, :4], mine.bounds[0, late, :4]
    return compared(
        case.group, runs.states[0, late], {"state": state, "state_bound": bound},
        mine.rows["claimed"][0, late], [each.estimates[0, late, :4] for each in rivals],
    )  # fmt: skip


def table(results: Sequence[Judged], groups: Sequence[str], *first: str) -> Iterator[str]:
    """Yield a row per group and one for all, in Markdown; `first` has the heads of two columns."""
    yield from head(*first, "ratio", f"above {_WORSE}", "claimed", "broken")
    for group in [*groups, "all"]:
        each = [one for one in results if group in (one.group, "all")]
        ratios = np.array([one.ratio for one in each])
        mean = exp(np.clip(np.log(ratios), -_LOG_RATIO, _LOG_RATIO).mean())
        claimed, broken = (
            np.mean([getattr(one, name) for one in each]) for name in ("claimed", "broken")
        )
        yield row(
            group, str(len(each)), f"{mean:.2f}", str((ratios > _WORSE).sum()), f"{claimed:.2f}",
            f"{broken:.3f}",
        )  # fmt: skip


def _page(results: Sequence[Judged], first: int) -> Iterator[str]:
    """Yield the results, as Markdown."""
    yield f"{len(results)} arms, seeds {first} to {first + len(results) - 1}.\n"
    groups = sorted({one.group for one in results}, key=len)
    yield from table(results, groups, "what is wrong", "arms")


def main() -> None:
    """Measure and print."""
    options, results = options_of(parser(__doc__, design=False), (), 240), []
    with Pool(options.processes) as pool:
        for one in pool.imap(judged, options.seeds):
            results.append(one)
            print(f"{len(results)}/{options.runs} {one.ratio:.2f}", file=sys.stderr, flush=True)
    arms = {"first_seed": options.first_seed, "arms": [one._asdict() for one in results]}
    end(options, __file__, "\n".join(_page(results, options.first_seed)), arms, [])


if __name__ == "__main__":
    use_one_thread()
    main()
