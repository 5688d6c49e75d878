# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cost of one estimator, by step, in a series, in batches, with late samples and more outputs.

A step is correct + predict + readout of the supervised estimator, on data of a simulated arm. The
reference is bayesian-filters' extended Kalman filter with the same model and states, whose step is
update + predict. All contenders take the same samples one after another in short turns, so that a
change of the machine's speed affects all of them.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from bayesian_filters.kalman import ExtendedKalmanFilter
from common import at_least, design_of, parser, show, timed, use_one_thread
from scipy.linalg import block_diag

import tsobs_ros as ts
from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TorqueDisturbance
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.baselines import THETA_STD, THETA_WANDER
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.records import Hypothesis, Measurement
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import ObserverSettings, make_estimator, make_tracker
from tsobs_ros.model.arm import LINK_ANGLE, LINK_VELOCITY, MOTOR_VELOCITY
from tsobs_ros.model.flow import SINE
from tsobs_ros.model.prediction import Record
from tsobs_ros.resources import FIXED_DESIGN, config_path
from tsobs_ros.series import NANOSECONDS, stamps_of
from tsobs_ros.simulation.plant import Scenario, SimulatedOutput, Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate
from tsobs_ros.simulation.sensor import Sensor

_TURN = 200
STANDING = len(Hypothesis)
_ROWS = [LINK_VELOCITY, MOTOR_VELOCITY]
_SCENARIOS = {"fixed": "bias_step", "adaptive": "stiff"}

Step = Callable[[int], object]


class _LibraryEkf(ExtendedKalmanFilter):  # type: ignore[misc]
    """The library's EKF with our model and states: exact prediction, Jacobian at the estimate."""

    def __init__(self, design: Design) -> None:
        flow = design.arm_request.flow
        super().__init__(dim_x=flow.state_count, dim_z=1, dim_u=1)
        self.flow = flow
        self.x = np.zeros((flow.state_count, 1))
        self.P = design.request.initial_covariance.copy()
        self.Q = flow.nominal.noise
        self.R = design.request.measurement_covariance
        self.C = flow.output_matrix

    def predict_x(self, u: Any = 0) -> None:
        """Predict, and linearise at the same points, with NumPy's products."""
        step, x = self.flow.nominal, self.x[:, 0].copy()
        half = 0.5 * step.duration * self.flow.gravity_gain
        x[1] -= half * np.sin(x[0])
        before = self._kick(half * np.cos(x[0]))
        x = step.phi @ x + step.gamma @ u
        self.F = self._kick(half * np.cos(x[0])) @ step.phi @ before
        x[1] -= half * np.sin(x[0])
        self.x = x[:, np.newaxis]

    def step(self, y: Array, u: Array) -> None:
        """Correct by a sample y (1,) and predict with the torque u (1,) held."""
        self.update(y[:, np.newaxis], lambda _: self.C, lambda x: self.C @ x)
        self.predict(u)

    def _kick(self, gain: float) -> Array:
        matrix = np.eye(self.dim_x)
        matrix[1, 0] = -gain
        return matrix


class _LibraryAugmentedEkf(ExtendedKalmanFilter):  # type: ignore[misc]
    """The same filter with θ as additional states."""

    def __init__(self, design: Design) -> None:
        request = design.arm_request
        flow, uncertainty = request.flow, request.uncertainty_model
        n, k, step = flow.state_count, uncertainty.count, flow.nominal
        super().__init__(dim_x=n + k, dim_z=1, dim_u=1)
        self.flow, self.effects = flow, uncertainty.directions[:, 0, _ROWS]
        self.phi, self.Q = block_diag(step.phi, np.eye(k)), np.zeros((n + k, n + k))
        self.Q[:n, :n] = step.noise
        self.Q[n:, n:] = THETA_WANDER * flow.period * np.eye(k)
        self.gamma = np.concatenate([step.gamma[:, 0], np.zeros(k)])
        self.x = np.zeros((n + k, 1))
        self.P = block_diag(request.initial_covariance, THETA_STD**2 * np.eye(k))
        self.R = request.measurement_covariance
        self.H = np.hstack([flow.output_matrix, np.zeros((1, k))])
        self._identity = np.eye(n + k)

    def predict_x(self, u: Array) -> None:  # type: ignore[override]
        """Predict as the observer does, and linearise at the same points."""
        torque = float(u[0])
        x, first = self._kick(self.x[:, 0], torque)
        x, second = self._kick(self.phi @ x + self.gamma * torque, torque)
        self.x = x[:, np.newaxis]
        self.F = second @ self.phi @ first

    def step(self, y: Array, u: Array) -> None:
        """Correct by a sample y (1,) and predict with the torque u (1,) held."""
        self.update(y[:, np.newaxis], lambda _: self.H, lambda x: self.H @ x)
        self.predict(u)

    def _kick(self, x: Array, torque: float) -> tuple[Array, Array]:
        step, n = self.flow.nominal, self.flow.state_count
        half, theta = 0.5 * step.duration, x[n:]
        gravity = half * self.flow.gravity_gain
        push = (self.effects @ [*x[:4], np.sin(x[LINK_ANGLE]), torque, 0.0, torque]).T
        change = np.tensordot(theta, self.effects, 1)
        jacobian = self._identity.copy()
        jacobian[_ROWS, :4] += half * change[:, :4]
        jacobian[_ROWS, LINK_ANGLE] += half * change[:, SINE] * np.cos(x[LINK_ANGLE])
        jacobian[_ROWS, n:] = half * push
        jacobian[LINK_VELOCITY, LINK_ANGLE] -= gravity * np.cos(x[LINK_ANGLE])
        kicked = x.copy()
        kicked[_ROWS] += half * (push @ theta)
        kicked[LINK_VELOCITY] -= gravity * np.sin(x[LINK_ANGLE])
        return kicked, jacobian


def _pure(estimator: Estimator, y: Array, u: Array) -> Step:
    """Return a step that uses the pure functions."""
    state, period = estimator.initial(), estimator.period

    def step(sample: int) -> None:
        nonlocal state
        corrected, _ = estimator.correct(state, y[sample])
        state = estimator.predict(corrected, u[sample], period)
        estimator.readout(state)

    return step


def _in_place(estimator: Estimator, y: Array, u: Array) -> Step:
    """Return a step that uses the calls of the pure functions, but in place."""
    records = (
        estimator.model,
        estimator.initial(),
        estimator.new_record("correction"),
        estimator.new_record("estimate"),
        estimator.new_record("work"),
    )
    model, states, corrections, rows, work = (each.view(np.float64) for each in records)
    samples, inputs, period = list(y), list(u), estimator.period

    def step(sample: int) -> None:
        native.estimator_correct(model, states, samples[sample], corrections)
        native.estimator_predict(model, states, inputs[sample], period, False, work)
        native.estimator_read(model, states, rows, work)

    return step


def _tracking(design: Design, y: Array, u: Array) -> Step:
    """Return a step that offers a sample to a tracker and gets the estimate of a tick."""
    tracker, period = make_tracker(design), design.request.period

    def step(sample: int) -> None:
        stamp = NANOSECONDS + round(sample * period * NANOSECONDS)
        tracker.offer(Measurement(stamp, y[sample], u[sample]), stamp)
        tracker.estimate(stamp + 1_000_000)

    return step


def _medians(contenders: dict[str, Step], samples: int) -> dict[str, float]:
    """Return the median time of one step of each contender [µs]."""
    times: dict[str, list[int]] = {name: [] for name in contenders}
    for begin in range(0, samples - _TURN, _TURN):
        for name, step in contenders.items():
            for sample in range(begin, begin + _TURN):
                started = time.perf_counter_ns()
                step(sample)
                times[name].append(time.perf_counter_ns() - started)
    # During the first half, caches fill and the certified gain takes over.
    return {name: float(np.median(each[len(each) // 2 :])) / 1e3 for name, each in times.items()}


def step_costs(kind: str, design: Design, seconds: float) -> dict[str, float]:
    """Return the median times of one step [µs]."""
    runs = simulate(SCENARIOS[_SCENARIOS[kind]], [1], seconds)
    y, u = runs.measurements[0], runs.torques[0]
    ekf: Any = _LibraryAugmentedEkf(design) if kind == "adaptive" else _LibraryEkf(design)
    contenders: dict[str, Step] = {
        "in place": _in_place(make_estimator(design, ObserverSettings()), y, u),
        "pure functions": _pure(make_estimator(design, ObserverSettings()), y, u),
        "tracker": _tracking(design, y, u),
        "bayesian-filters": lambda sample: ekf.step(y[sample], u[sample]),
    }
    return _medians(contenders, len(y))


def _awake(estimator: Estimator, y: Array, u: Array) -> Record:
    """Return the state after some samples, with all hypotheses live and equal."""
    state = estimator.initial()
    for sample, torque in zip(y, u, strict=True):
        corrected, _ = estimator.correct(state, sample)
        state = estimator.predict(corrected, torque, estimator.period)
    record = state[0]
    hypotheses, best = record["hypotheses"], int(record["best"])
    for place in range(len(hypotheses)):
        kind = place if place < STANDING else int(Hypothesis.DRIFT)
        hypotheses[place] = hypotheses[best]
        hypotheses["kind"][place] = kind
        hypotheses["certified"][place] = hypotheses["output"][place] = 0
        # Hypotheses with parts of the sensors have the most states to move.
        n, width = estimator.shape.n, hypotheses["x"].shape[1]
        parts = range(n, width)
        hypotheses["covariance"][place][parts, parts] = 1e-4
        if kind == Hypothesis.TONE:
            hypotheses["x"][place, n + 3], hypotheses["size"][place] = 5.0, 0.01
    hypotheses["live"], hypotheses["score"], hypotheses["age"] = 1, 0.0, 0.0
    record["awake"] = 5.0
    return state


def _worst(design: Design, turns: int) -> dict[str, float]:
    """Return times of one step with all hypotheses awake [µs], of the three compiled calls.

    Each step begins from the same state. Samples alternate between one that fits and an outlier, at
    which forks are tried. Results are medians of both, and the slowest steps, due to the machine.
    """
    estimator = make_estimator(design, ObserverSettings())
    runs = simulate(SCENARIOS["stiff"], [1], 10.0)
    y, u = runs.measurements[0], runs.torques[0]
    start = _awake(estimator, y[:-1], u[:-1])
    states, work = start.copy(), estimator.new_record("work")
    model = estimator.model.view(np.float64)
    memory, scratch = states.view(np.float64), work.view(np.float64)
    corrections = estimator.new_record("correction").view(np.float64)
    rows = estimator.new_record("estimate").view(np.float64)
    samples, inputs, period = [y[-1], y[-1] + 1.0], u[-1].copy(), estimator.period
    numbers, before = states.view(np.float64), start.view(np.float64)
    times = []
    for turn in range(turns):
        numbers[:] = before
        sample = samples[turn % 2]
        started = time.perf_counter_ns()
        native.estimator_correct(model, memory, sample, corrections)
        native.estimator_predict(model, memory, inputs, period, False, scratch)
        native.estimator_read(model, memory, rows, scratch)
        times.append(time.perf_counter_ns() - started)
        assert int(states["hypotheses"]["live"].sum()) >= len(states["hypotheses"][0]) - 1
    found = 1e-3 * np.array(times[turns // 20 * 2 :])
    return {
        "regular": float(np.median(found[::2])),
        "outlier": float(np.median(found[1::2])),
        "99 % of all": float(np.percentile(found, 99.0)),
        "slowest": float(found.max()),
    }


def _batch(design: Design, runs: Trajectories, arms: int, turns: int) -> dict[str, float]:
    """Return the arm-steps per second of whole runs, on one core and on all; medians."""
    estimator, cores = make_estimator(design, ObserverSettings()), len(os.sched_getaffinity(0))
    stamps = stamps_of(runs.times)
    copies = -(-arms // len(runs.states))
    y = np.tile(runs.measurements, (copies, 1, 1))[:arms]
    u = np.tile(runs.torques, (copies, 1, 1))[:arms]
    parts = list(zip(np.array_split(y, cores), np.array_split(u, cores), strict=True))
    times: dict[str, list[float]] = {"one core": [], "all cores": []}

    def follow(arms: tuple[Array, Array]) -> None:
        tracker = Tracker(estimator, history=0.0, max_steps=1)
        for samples in zip(*arms, strict=True):
            tracker.reset()
            tracker.follow(stamps, *samples)

    with ThreadPoolExecutor(cores) as pool:

        def together() -> None:
            list(pool.map(follow, parts))

        together()
        for _ in range(turns):
            times["one core"].append(timed(lambda: follow((y, u))))
            times["all cores"].append(timed(together))
    return {name: y.shape[0] * y.shape[1] / float(np.median(each)) for name, each in times.items()}


def _series(design: Design, runs: Trajectories, turns: int) -> float:
    """Return the median time of `ts.estimate` of a run [s]."""
    y, u = runs.measurements[0, :, 0], runs.torques[0, :, 0]
    times = [timed(lambda: ts.estimate(design, runs.times, y, u)) for _ in range(turns + 1)]
    return float(np.median(times[1:]))


def _late(design: Design, count: int, turns: int) -> dict[str, float]:
    """Return the median times for using samples that come together [s], by their order."""
    runs = simulate(SCENARIOS["noise"], [1], (count + 2) * design.request.period)
    y, u = runs.measurements[0, :count], runs.torques[0, :count]
    stamps = stamps_of(runs.times[:count])
    limits = {"x_max": design.arm_request.x_max, "history": 2.0 * count * design.request.period}
    now, order = int(stamps[-1]), np.arange(count)
    orders = {"ascending": order, "descending": order[::-1]}
    times: dict[str, list[float]] = {name: [] for name in orders}
    for _ in range(turns):
        for name, places in orders.items():
            tracker = Tracker(make_estimator(design, ObserverSettings()), **limits, max_steps=count)
            given = (stamps[places], y[places], u[places])
            times[name].append(timed(lambda: tracker.offer_many(*given, now)))  # noqa: B023
    return {name: float(np.median(each)) for name, each in times.items()}


def _outputs(design: Design, turns: int) -> dict[str, float]:
    """Return the median costs of a sample of one output, or of two with unknown torques [µs]."""
    drift = DisturbanceTerm("gauss_markov", {"std": 2.0, "time_constant": 1.0})
    outputs = (
        Output("link_angle", 0.005, (DisturbanceTerm("bias"),)),
        Output("motor_angle", 0.002),
    )
    request = ArmRequest(outputs=outputs, torque_disturbance=TorqueDisturbance((drift,), (drift,)))
    sensors = tuple(
        SimulatedOutput(each.measures, Sensor(noise_std=each.measurement_std)) for each in outputs
    )
    contenders = {}
    for design_, scenario in (
        (design, Scenario()),
        (synthesise(request), Scenario(outputs=sensors)),
    ):
        tracker, runs = make_tracker(design_), simulate(scenario, [1], 60.0)
        stamps = stamps_of(runs.times)
        shape = tracker.estimator.shape
        name = (
            f"{shape.p} outputs, {shape.n} states" if shape.p > 1 else f"1 output, {shape.n} states"
        )
        contenders[name] = (tracker, stamps, runs.measurements[0], runs.torques[0])
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(turns + 1):
        for name, (tracker, *samples) in contenders.items():
            tracker.reset()
            cost = timed(lambda: tracker.follow(*samples))  # noqa: B023
            times[name].append(1e6 * cost / len(samples[0]))
    return {name: float(np.median(each[1:])) for name, each in times.items()}


_START = """
import time
begun, cpu = time.perf_counter(), time.process_time()
import numpy as np
import tsobs_ros as ts
tracker = ts.make_tracker(ts.load_design())
tracker.offer(ts.Measurement(10**9, np.array([0.1]), np.array([0.0])), 10**9)
assert tracker.estimate(10**9 + 10**6) is not None
print(time.perf_counter() - begun, time.process_time() - cpu)
"""


def _start(turns: int) -> dict[str, float]:
    """Return the elapsed and the CPU time from the import to the first estimate; medians [s]."""

    def once() -> list[float]:
        done = subprocess.run([sys.executable, "-c", _START], capture_output=True, check=True)
        return [float(each) for each in done.stdout.split()]

    found = np.median([once() for _ in range(turns)], axis=0).tolist()
    return dict(zip(("wall", "cpu"), found, strict=True))


def _of_steps(kind: str, found: dict[str, float]) -> Sequence[str]:
    reference = found["bayesian-filters"]
    lines = [f"supervised, {kind}; medians, and as a share of bayesian-filters' EKF:"]
    lines += [
        f"  {name:28s} {cost:7.2f} µs  {cost / reference:6.3f}" for name, cost in found.items()
    ]
    return lines


def _measure(options: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    """Return the results of the chosen parts, as numbers and as lines."""
    parts = set(options.parts)
    results: dict[str, Any] = {}
    lines: list[str] = []
    fixed, adaptive = load_design(config_path(FIXED_DESIGN)), design_of(options)
    if "steps" in parts:
        for kind, design in (("fixed", fixed), ("adaptive", adaptive)):
            found = results[f"step_us {kind}"] = step_costs(kind, design, options.seconds)
            lines += _of_steps(kind, found)
    if "worst" in parts:
        lines.append("one step in place with all hypotheses awake:")
        for kind, design in (("fixed", fixed), ("adaptive", adaptive)):
            found = results[f"worst_us {kind}"] = _worst(design, options.steps)
            costs = ", ".join(f"{name} {cost:.1f} µs" for name, cost in found.items())
            lines.append(f"  {kind:28s} {costs}")
    if "batch" in parts:
        runs = simulate(SCENARIOS["stiff"], list(range(16)), 20.0)
        rates = results["arm_steps_per_second"] = _batch(
            adaptive, runs, options.arms, options.turns
        )
        lines.append(f"batch of {options.arms} runs of 20 s, supervised and adaptive:")
        lines += [f"  {name:28s} {rate / 1e6:7.2f} million/s" for name, rate in rates.items()]
    if "series" in parts:
        runs = simulate(SCENARIOS["stiff"], [1], 600.0)
        taken = {
            kind: _series(design, runs, options.turns)
            for kind, design in (("fixed", fixed), ("adaptive", adaptive))
        }
        results["ten_minutes_s"] = taken
        lines.append("ts.estimate of ten minutes:")
        lines += [f"  {kind:28s} {1e3 * each:7.1f} ms" for kind, each in taken.items()]
    if "late" in parts:
        waits = results["late_s"] = _late(adaptive, options.late, options.turns)
        lines.append(f"{options.late} samples together:")
        lines += [f"  {name:28s} {1e3 * each:7.1f} ms" for name, each in waits.items()]
    if "outputs" in parts:
        costs = results["sample_us"] = _outputs(adaptive, options.turns)
        lines.append("a sample and its estimate, in a series:")
        lines += [f"  {name:28s} {cost:7.2f} µs" for name, cost in costs.items()]
        one, two = costs.values()
        lines.append(f"  {'ratio':28s} {two / one:7.2f}")
    if "start" in parts:
        start = results["start_s"] = _start(options.turns)
        lines.append("from the import to a tracker's first estimate:")
        lines.append(f"  {'':28s} {start['wall']:7.2f} s, of CPU {start['cpu']:.2f} s")
    return results, lines


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument(
        "--seconds", type=at_least(1.0), default=30.0, help="simulated time of one arm"
    )
    made.add_argument("--arms", type=at_least(1, int), default=250, help="runs in a batch")
    made.add_argument(
        "--late", type=at_least(1, int), default=5000, help="samples that come together"
    )
    made.add_argument(
        "--steps", type=at_least(100, int), default=100_000, help="with all hypotheses awake"
    )
    made.add_argument(
        "--turns", type=at_least(1, int), default=7, help="repetitions of what is not a step"
    )
    choices = ("steps", "worst", "batch", "series", "late", "outputs", "start")
    made.add_argument("--parts", nargs="+", choices=choices, default=choices)
    options = made.parse_args()
    results, lines = _measure(options)
    show(results, "\n".join(lines), options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
