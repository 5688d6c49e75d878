# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Precise encoders on stiff and light joints that get hit: ours next to a plain and a gated EKF.

A joint with a vertical axis swings between two angles; its drive is controlled with a motor encoder
of 4096 counts. The design has the numbers of a data sheet. The joint has Coulomb friction, another
stiffness and other inertias, and gets hit sometimes: the link's speed jumps by 2 to 5 rad/s. The
observers get one encoder, of link or motor; the error is that of the other angle.
"""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from multiprocessing import Pool
from typing import NamedTuple

import numpy as np
from acceptance_demands import Demand
from common import parser, use_one_thread
from pages import end, head, options_of, row

from tsobs_ros.campaign.batches import observe
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TorqueDisturbance
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.model.arm import QUANTITIES, ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.simulation.plant import Trajectories

_COUNT = 2.0 * math.pi / 4096.0
_DURATION, _JUDGED = 8.0, 0.5
"""Length of a run, and time at which judging begins [s]."""

_SUBSTEP = 5e-5
_CALM_BAR, _HIT_BAR, _INSIDE_BAR = 1.005, 0.5, 0.95
"""Bars of the ratio of ours to the better EKF without hits, where both filters differ only in one
sample in hundreds, and with hits; share of the angle's errors within three bounds."""


class Joint(NamedTuple):
    """A joint and its drive.

    Attributes:
        arm: The design's.
        coulomb: Coulomb friction of the motor [N m].
        gains: Gains of the drive's controller, on angle and speed.
        most: Largest torque of the drive [N m].
        friction: 1σ of the design's unknown torque [N m].
    """

    arm: ElasticJointArm
    coulomb: float
    gains: tuple[float, float]
    most: float
    friction: float


def _arm(link: float, motor: float, spring: float, damping: tuple[float, float]) -> ElasticJointArm:
    return ElasticJointArm(link, motor, spring, 0.0, *damping)


JOINTS = {
    "stiff": Joint(_arm(0.0038037, 0.0020842, 1.3, (0.0, 0.0943)), 0.02, (1.6, 0.05), 0.55, 0.05),
    "light": Joint(_arm(0.0008, 0.0006, 0.6, (0.0, 0.01)), 0.004, (0.5, 0.008), 0.2, 0.01),
}
_LINK_DAMPING = {"stiff": 0.0003, "light": 0.00005}
"""Damping between link and motor, which no design has [N m s/rad]."""


class Case(NamedTuple):
    """A design, and the differences of the true joint.

    Attributes:
        joint: Name in `JOINTS`.
        hits: Hits per second.
        side: Side of the encoder.
        sigma: 1σ of the encoder, in truth and in the design [rad].
        rate: Sampling rate [Hz].
        stiffness: Relative change of the stiffness.
        link_inertia: Relative change of the link's inertia.
        motor_inertia: Relative change of the motor's inertia.
        friction: Factor of Coulomb friction.
    """

    joint: str = "stiff"
    hits: float = 0.0
    side: str = "link"
    sigma: float = 0.001
    rate: float = 500.0
    stiffness: float = 0.085
    link_inertia: float = 0.0
    motor_inertia: float = 0.0
    friction: float = 1.0

    @property
    def measured(self) -> int:
        """Place of the measured angle in the state."""
        return QUANTITIES.index(f"{self.side}_angle")

    @property
    def hidden(self) -> int:
        """Place of the other angle in the state."""
        return 2 - self.measured

    @property
    def request(self) -> ArmRequest:
        """The request of the design."""
        joint = JOINTS[self.joint]
        torque = {"std": joint.friction, "time_constant": 0.3}
        return ArmRequest(
            joint.arm,
            process_noise=ProcessNoise(1.0, 1.0),
            outputs=(Output(f"{self.side}_angle", self.sigma),),
            torque_disturbance=TorqueDisturbance(motor=(DisturbanceTerm("gauss_markov", torque),)),
            rate=self.rate,
            x_max=3.1,
            initial_std=(0.01, 0.1, 0.01, 0.1),
            uncertainty={},
        )


CASES = {
    "stiff": Case(),
    "stiff_hits_1": Case(hits=1.0),
    "stiff_hits_3": Case(hits=3.0),
    "stiff_hits_10": Case(hits=10.0),
    "stiff_motor": Case(side="motor"),
    "stiff_motor_hits_3": Case(side="motor", hits=3.0),
    "stiff_coarse_hits_3": Case(sigma=0.002, hits=3.0),
    "stiff_fine_motor_hits_3": Case(rate=1000.0, sigma=0.0004, side="motor", hits=3.0),
    "stiffer": Case(stiffness=0.25, link_inertia=-0.2),
    "stiffer_hits_3": Case(stiffness=0.25, link_inertia=-0.2, hits=3.0),
    "softer_rubbing_hits_1": Case(stiffness=-0.2, motor_inertia=0.3, friction=2.5, hits=1.0),
    "light": Case("light", stiffness=0.1),
    "light_hits_3": Case("light", 3.0, stiffness=0.1),
    "light_hits_10": Case("light", 10.0, stiffness=0.1),
    "light_motor_hits_3": Case("light", 3.0, "motor", stiffness=0.1),
    "light_fine_hits_3": Case("light", 3.0, rate=1000.0, sigma=0.0004, stiffness=0.1),
    "light_softer_hits_3": Case("light", 3.0, stiffness=-0.25, link_inertia=0.2, friction=2.0),
}


class Found(NamedTuple):
    """The results of a case, each of shape (runs,).

    Attributes:
        errors: RMSE of the hidden angle by contender, "learning" with a design that learns the
            stiffness [rad].
        inside: Share of our errors of the hidden angle within three bounds.
        claimed: Share of samples with claimed bounds.
        broken: Share of these with an error of an angle or a speed beyond three bounds.
    """

    errors: dict[str, Array]
    inside: Array
    claimed: Array
    broken: Array


def simulated(case: Case, seeds: Sequence[int]) -> Trajectories:
    """Return runs of a joint, one for each seed, by semi-implicit steps of 50 µs."""
    joint, nominal, count = JOINTS[case.joint], JOINTS[case.joint].arm, round(_DURATION * case.rate)
    link = nominal.link_inertia * (1.0 + case.link_inertia)
    motor = nominal.motor_inertia * (1.0 + case.motor_inertia)
    spring = nominal.stiffness * (1.0 + case.stiffness)
    between, coulomb = _LINK_DAMPING[case.joint], joint.coulomb * case.friction
    hits, noise = np.zeros((count, len(seeds))), np.zeros((count, len(seeds)))
    for run, seed in enumerate(seeds):
        random = np.random.default_rng(seed)
        hit = random.random(count) < case.hits / case.rate
        sizes = random.choice([-1.0, 1.0], count) * random.uniform(2.0, 5.0, count)
        hits[:, run] = np.where(hit, sizes, 0.0)
        noise[:, run] = random.standard_normal(count)
    x = np.zeros((4, len(seeds)))
    states, torques = np.empty((count, 4, len(seeds))), np.empty((count, len(seeds)))
    steps = round(1.0 / (case.rate * _SUBSTEP))
    for k in range(count):
        time = k / case.rate
        x[1] += hits[k]
        wanted = 0.52 * np.sign(math.sin(2.0 * math.pi * 0.45 * time - 0.3)) if time > 0.2 else 0.0
        u = joint.gains[0] * (wanted - _COUNT * np.round(x[2] / _COUNT)) - joint.gains[1] * x[3]
        u = np.clip(u, -joint.most, joint.most)
        states[k], torques[k] = x, u
        for _ in range(steps):
            twist, turn = x[0] - x[2], x[1] - x[3]
            rub = nominal.motor_damping * x[3] + coulomb * np.tanh(x[3] / 0.02)
            x[1] -= _SUBSTEP * (spring * twist + between * turn) / link
            x[3] += _SUBSTEP * (spring * twist + u - rub) / motor
            x[0] += _SUBSTEP * x[1]
            x[2] += _SUBSTEP * x[3]
    # The part of the encoder's 1σ that does not come from the counts is white noise.
    rest = math.sqrt(max(0.0, case.sigma**2 - _COUNT**2 / 12.0))
    angles = states[:, case.measured] + rest * noise
    physical = states.transpose(2, 0, 1).copy()
    none = np.zeros((*physical.shape[:2], 2))
    return Trajectories(
        np.arange(count) / case.rate,
        nominal.from_physical(physical),
        none[..., :1],
        (_COUNT * np.round(angles / _COUNT)).T[..., np.newaxis].copy(),
        torques.T[..., np.newaxis].copy(),
        physical,
        none,
    )


def judged(case: Case, design: Design, learning: Design, runs: Trajectories) -> Found:
    """Return the results of ours, of ours with the other design, and of the two EKFs."""
    late, place = runs.times >= _JUDGED, case.hidden
    mine = observe(design, runs)
    states = {"ours": mine.rows["state"], "learning": observe(learning, runs).rows["state"]}
    for who, method in (("plain", "ekf_plain"), ("gated", "ekf")):
        states[who] = observe(design, runs, ObserverSettings(method=method)).rows["state"]
    away = {who: (each - runs.physical)[:, late] for who, each in states.items()}
    kept = np.abs(away["ours"]) <= SIGMAS * mine.rows["state_bound"][:, late]
    claims = mine.rows["claimed"][:, late] > 0.0
    return Found(
        {who: np.sqrt((each[..., place] ** 2).mean(axis=1)) for who, each in away.items()},
        kept[..., place].mean(axis=1),
        claims.mean(axis=1),
        (claims & ~kept.all(axis=2)).sum(axis=1) / np.maximum(claims.sum(axis=1), 1),
    )


def _work(job: tuple[str, tuple[int, ...]]) -> tuple[str, Found]:
    """Design, simulate and judge a case."""
    name, seeds = job
    case = CASES[name]
    learning = replace(case.request, uncertainty={"stiffness": 0.3})
    runs = simulated(case, seeds)
    return name, judged(case, synthesise(case.request), synthesise(learning), runs)


def demands(results: Mapping[str, Found]) -> Iterator[Demand]:
    """Yield the demands."""
    for name, found in results.items():
        means = {who: float(each.mean()) for who, each in found.errors.items()}
        ratio = means["ours"] / min(means["plain"], means["gated"])
        bar = _HIT_BAR if CASES[name].hits else _CALM_BAR
        yield Demand(name, "ratio", "error / the better EKF's", ratio, bar)
        text = "hidden angle within three bounds"
        inside = float(found.inside.mean())
        yield Demand(name, "inside", text, inside, _INSIDE_BAR, at_least=True)


def _page(results: Mapping[str, Found], found: Sequence[Demand], options: str) -> Iterator[str]:
    """Yield the results, as Markdown."""
    failed = sum(not one.passed for one in found)
    yield f"{options} {failed} of {len(found)} demands are missed. Errors are in mrad.\n"
    by_place = {(one.scenario, one.kind): one for one in found}
    yield from head("joint", "ours", "plain EKF", "ratio", "inside", "broken", "learning")
    for name, one in results.items():
        cells = [f"{1e3 * one.errors[who].mean():.1f}" for who in ("ours", "plain")]
        for kind in ("ratio", "inside"):
            demand = by_place[name, kind]
            text = f"{demand.value:.2f}"
            cells.append(text if demand.passed else f"**{text}**")
        best = min(one.errors[who].mean() for who in ("plain", "gated"))
        learning = one.errors["learning"].mean() / best
        yield row(name, *cells, f"{one.broken.mean():.2f}", f"{learning:.2f}")


def main() -> None:
    """Measure and print."""
    options = options_of(parser(__doc__, design=False), CASES)
    jobs = [(name, tuple(options.seeds)) for name in options.scenarios]
    results: dict[str, Found] = {}
    with Pool(options.processes) as pool:
        for name, one in pool.imap(_work, jobs):
            print(f"{len(results) + 1}/{len(jobs)} {name}", file=sys.stderr, flush=True)
            results[name] = one
    found = list(demands(results))
    what = f"{options.runs} runs of each."
    everything = {
        "first_seed": options.first_seed,
        "joints": {
            name: {
                "errors": {who: each.tolist() for who, each in one.errors.items()},
                **{key: getattr(one, key).tolist() for key in ("inside", "claimed", "broken")},
            }
            for name, one in results.items()
        },
    }
    end(options, __file__, "\n".join(_page(results, found, what)), everything, found)


if __name__ == "__main__":
    use_one_thread()
    main()
