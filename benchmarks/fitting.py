# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits of joints with known numbers, starting from a data sheet that is 30 % wrong everywhere.

Each joint is simulated for half a minute, moved by many tones, and fitted to its encoders. Then
observers of three requests observe another motion, with the motor's encoder alone: the fitted
request, the one with the true numbers, and that of the sheet. N is the root mean square of the
states' errors divided by the states' own deviations.
"""

import json
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from common import parser, use_one_thread

import tsobs_ros as ts
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest, Output, TorqueDisturbance
from tsobs_ros.model.arm import TorquePath
from tsobs_ros.model.disturbance import DisturbanceTerm
from tsobs_ros.model.flow import ProcessNoise

_NUMBERS = ("link_inertia", "motor_inertia", "stiffness", "gravity_torque", "motor_damping")
_LIGHT = ts.ElasticJointArm(0.0059, 0.0021, 1.61, 0.2372, 0.0, 0.1109)
_HEAVY = ts.ElasticJointArm(0.8, 0.3, 900.0, 12.0, 0.5, 4.0)
_LEVEL = ts.ElasticJointArm(0.0059, 0.0021, 1.61, 0.0, 0.0, 0.1109)


class Truth(NamedTuple):
    """A joint: arm, encoders in the recording, friction [N m], drive, and tones [N m, Hz]."""

    arm: ts.ElasticJointArm
    outputs: tuple[str, ...] = ("motor_angle", "link_angle")
    friction: float = 0.0
    path: TorquePath = TorquePath()
    size: float = 0.05
    fastest: float = 8.0


TRUTHS: Mapping[str, Truth] = {
    "both encoders": Truth(_LIGHT),
    "motor encoder": Truth(_LIGHT, ("motor_angle",)),
    "link encoder": Truth(_LIGHT, ("link_angle",)),
    "no gravity": Truth(_LEVEL),
    "friction": Truth(_LIGHT, friction=0.01),
    "late torque": Truth(_LIGHT, path=TorquePath(1.0, 0.01, 0.003)),
    "friction, late": Truth(_LIGHT, friction=0.01, path=TorquePath(1.0, 0.01, 0.003)),
    "heavy, stiff": Truth(_HEAVY, size=4.0, fastest=14.0),
}


def _request(truth: Truth, arm: ts.ElasticJointArm) -> ArmRequest:
    outputs = tuple(Output(name, 0.001) for name in truth.outputs)
    size = 0.1 * arm.reference_torque
    drift = DisturbanceTerm("gauss_markov", {"std": size, "time_constant": 0.5})
    return ArmRequest(
        arm,
        outputs=outputs,
        torque_disturbance=TorqueDisturbance(motor=(drift,)),
        process_noise=ProcessNoise(0.01, 0.01),
        rate=500.0,
        x_max=3.1,
        initial_std=(0.3, 2.0, 0.3, 2.0),
        uncertainty={},
    )


def _run(truth: Truth, request: ArmRequest, duration: float, seed: int) -> Any:
    rng, at = np.random.default_rng(seed), np.arange(round(500 * duration) + 1) / 500.0
    frequencies = 2.0 * np.pi * np.linspace(0.3, truth.fastest, 12)
    tones = np.sin(np.outer(at, frequencies) + rng.uniform(0.0, 2.0 * np.pi, 12)).sum(axis=1)
    (term,) = request.torque_disturbance.motor
    return ts.simulate(
        replace(request, torque=truth.path),
        duration=duration,
        seed=seed,
        torque=truth.size * tones,
        friction={"motor_coulomb": truth.friction} if truth.friction else None,
        torque_disturbance={"motor": {"gauss_markov": {"std": term["std"], "time_constant": 0.5}}},
        initial_state=[0.0] * 4,
    )


def _observed(request: ArmRequest, run: Any) -> tuple[float, float, float]:
    """Return N, the share of claimed samples, and the share of these inside three bounds."""
    chosen = [each for each in request.sensors if each.measures != "link_angle"]
    one = replace(request, outputs=chosen or list(request.sensors))
    angle = run.angle.reshape(len(run.time), -1)[:, :1]
    made = ts.estimate(ts.synthesise(one), run.time, angle, run.torque)
    late = run.time > 2.0
    errors: Array = (made.state - run.state)[late]
    claimed, bound = made.claimed[late], made.state_bound[late]
    inside = (np.abs(errors) <= 3.0 * bound)[claimed]
    size = float(np.sqrt(np.square(errors / run.state[late].std(axis=0)).mean()))
    return size, float(claimed.mean()), float(inside.mean()) if inside.size else 1.0


def trial(truth: Truth, seed: int) -> dict[str, Any]:
    """Fit one recording, and observe another."""
    true = _request(truth, truth.arm)
    rng = np.random.default_rng(100 + seed)
    wrong = {
        name: getattr(truth.arm, name) * (1.0 + 0.3 * rng.choice([-1.0, 1.0])) for name in _NUMBERS
    }
    sheet = _request(truth, replace(truth.arm, **wrong))
    run = _run(truth, true, 30.0, seed)
    begin = time.perf_counter()
    found = ts.fit(sheet, (run.time, run.angle, run.torque))
    seconds = time.perf_counter() - begin
    sigmas = [
        (found.number(name).value - getattr(truth.arm, name)) / found.number(name).std
        for name in _NUMBERS
        if getattr(truth.arm, name)
    ]
    other = _run(truth, true, 20.0, 1000 + seed)
    known = replace(true, torque=truth.path)
    observed = {
        name: _observed(request, other)
        for name, request in (("true", known), ("fit", found.request), ("sheet", sheet))
    }
    return {"seconds": seconds, "sigmas": sigmas, **observed}


def main() -> int:
    """Print a table of the trials."""
    options = parser(__doc__, design=False)
    options.add_argument("--seeds", type=int, default=20, help="recordings a truth")
    options.add_argument("--truth", action="append", choices=TRUTHS, help="only these")
    given = options.parse_args()
    results = {}
    if not given.json:
        print(f"{'truth':16} {'N fit/true':>16} {'sheet/true':>10} {'claimed':>8} {'inside':>7} "
              f"{'in 3 sigma':>10} {'time':>6}")  # fmt: skip
    for name in given.truth or TRUTHS:
        trials = [trial(TRUTHS[name], seed) for seed in range(given.seeds)]
        results[name] = trials
        ratios = [each["fit"][0] / each["true"][0] for each in trials]
        sheet = [each["sheet"][0] / each["true"][0] for each in trials]
        sigmas = np.abs([each["sigmas"] for each in trials])
        if not given.json:
            print(
                f"{name:16} {np.median(ratios):7.3f} ({max(ratios):6.3f}) "
                f"{np.median(sheet):10.2f} {np.mean([e['fit'][1] for e in trials]):8.3f} "
                f"{np.mean([e['fit'][2] for e in trials]):7.4f} {(sigmas <= 3.0).mean():10.3f} "
                f"{np.median([e['seconds'] for e in trials]):5.1f}s",
                flush=True,
            )
    if given.json:
        print(json.dumps(results))
    return 0


if __name__ == "__main__":
    use_one_thread()
    sys.exit(main())
