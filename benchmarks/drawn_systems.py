# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Randomly drawn T–S systems, each with twelve kinds of trouble: ours next to EKFs of its model.

A system is a pendulum, two masses with a hardening spring between them, or random matrices. Each
gets its own design and half a minute of every trouble; seeds without a design are counted. The
errors of the states are divided by the standard deviations of their motion. The rivals are a plain
EKF, a gated one and, if a parameter is learnt, a gated one with the parameter as a state.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from math import cos, exp, inf, log, sin, sqrt
from multiprocessing import Pool
from typing import NamedTuple

import numpy as np
from common import parser, use_one_thread
from drawn_arms import DURATION, Judged, compared, table
from pages import end, options_of

from tsobs_ros.checks import Array
from tsobs_ros.design.request import DisturbanceTerm, TSRequest
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.errors import DesignError
from tsobs_ros.estimation.baselines import GATE, extended_kalman
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.model.fuzzy import Membership, RuleBase, membership
from tsobs_ros.model.ts_model import Direction, TSModel
from tsobs_ros.series import stamps_of
from tsobs_ros.simulation.plant import Plant, SystemScenario
from tsobs_ros.simulation.sensor import Sensor, SimulatedOutput
from tsobs_ros.simulation.signals import BiasStep, Constant, GaussMarkov, Multisine, Sine, Sinusoid

_JUDGED = 5.0
"""Time at which judging begins [s]."""

_UNKNOWN = ("an unknown input", "an offset of the input")
"""Troubles that are an input, unknown to the observers, after the first one."""

_FAR = 1e4
"""A run that goes further than this is not judged."""

_TROUBLES = (
    "none", "other noise", "outliers", "a sensor steps", "lost samples", "another parameter",
    "an unknown input", "an offset of the input", "another gain of the input", "coloured noise",
    "a sensor drifts", "another matrix A",
)  # fmt: skip

_HARDENING = {2: (1.0, 1.4), 3: (1.6, 1.0, 1.6)}
"""Stiffness of the spring in each rule, by the number of rules."""


class Drawn(NamedTuple):
    """Matrices of a system, with one per rule if the rules differ, and its other numbers.

    Attributes:
        A, B, C: State, input and output matrices.
        premise: Row of the single premise; zero if the premise is a scheduled signal.
        E: Direction of the uncertain parameter.
        memberships: Shape of the memberships.
        modes: Frequencies of its modes [rad/s].
        amplitude: Of the input.
        pushed: States whose derivatives have noise.
        width: Half width of the premise; None for the width of the motion.
        slopes: Vertices of the certificate; the rules' matrices if there are none.
    """

    A: Array
    B: Array
    C: Array
    premise: Array
    E: Array
    memberships: str
    modes: Sequence[float]
    amplitude: float = 1.0
    pushed: slice = slice(1, None, 2)
    width: float | None = None
    slopes: Sequence[Array] = ()


class Case(NamedTuple):
    """The request, the scenario without trouble, and typical rates of the states."""

    request: TSRequest
    scenario: SystemScenario
    pace: Array


def _between(random: np.random.Generator, least: float, most: float) -> float:
    return exp(random.uniform(log(least), log(most)))


def _pendulum(random: np.random.Generator) -> Drawn:
    gravity, damping = _between(random, 4.0, 40.0), _between(random, 0.05, 1.0)
    width = random.uniform(0.8, 1.3)
    slopes = np.array([gravity, gravity * sin(width) / width, gravity * cos(width)])
    A = np.array([[[0.0, 1.0], [-slope, -damping]] for slope in slopes])
    amplitude = random.uniform(0.1, 0.35) * gravity
    C = np.eye(2)[: 1 if random.random() < 0.5 else 2]
    E = A[:2] * ([[0.0, 0.0], [1.0, 0.0]] if random.random() < 0.6 else np.diag([0.0, 1.0]))
    return Drawn(
        A[:2], np.array([[0.0], [1.0]]), C, np.eye(1, 2), E, "sector", [sqrt(gravity)], amplitude,
        width=width, slopes=A[::2],
    )  # fmt: skip


def _masses(random: np.random.Generator) -> Drawn:
    rules, memberships = int(random.integers(2, 4)), random.choice(["gaussian", "trapezoid"])
    first, second = _between(random, 1.0, 4.0), _between(random, 3.0, 8.0)
    damping, square = _between(random, 0.02, 0.2), second**2
    A = np.array([
        [[0.0, 1.0, 0.0, 0.0], [-(first**2) - k, -2.0 * damping * first, k, damping],
         [0.0, 0.0, 0.0, 1.0], [k, damping, -k, -2.0 * damping * second]]
        for k in (square * share for share in _HARDENING[rules])
    ])  # fmt: skip
    C = np.eye(4)[[0] if random.random() < 0.5 else [0, 2]]
    premise = np.array([[1.0, 0.0, -1.0, 0.0]])
    E = square * np.outer([0.0, -1.0, 0.0, 1.0], premise)
    return Drawn(A, np.eye(4)[:, 3:], C, premise, E, memberships, [first, second])


def _matrices(random: np.random.Generator) -> Drawn:
    n, rules = (int(random.integers(2, 5)) for _ in range(2))
    memberships = random.choice(["gaussian", "trapezoid"])
    kind = random.choice(["scheduled", "any state", "first output"])
    base, modes = _modes(random, n, bool(random.random() < 0.5))
    largest = 0.5 * np.abs(base).max()
    A = np.array([
        base + random.uniform(0.05, 0.35) * largest * random.normal(size=(n, n))
        * (random.random((n, n)) < 0.35)
        for _ in range(rules)
    ])  # fmt: skip
    slowest = np.linalg.eigvals(A).real.max()
    if slowest > -0.03:
        A -= (slowest + random.uniform(0.05, 0.4)) * np.eye(n)
    B, premise = random.normal(size=(n, 1)), np.zeros((1, n))
    if kind != "scheduled":
        premise[0, 0 if kind == "first output" else random.integers(n)] = 1.0
    outputs = random.integers(1, 3)
    measured = random.permutation(n)[:outputs]
    if kind == "first output":
        measured[0] = 0
        measured = np.unique(measured)
    is_largest = np.arange(n * n).reshape(n, n) == np.abs(base).argmax()
    return Drawn(
        A,
        B,
        np.eye(n)[measured],
        premise,
        base * is_largest,
        memberships,
        modes,
        pushed=slice(None),
    )


def _modes(random: np.random.Generator, n: int, is_chain: bool) -> tuple[Array, list[float]]:
    """Return a matrix with coupled modes from 0.5 to 8 rad/s, and the frequencies of the modes."""
    A, modes, at = np.zeros((n, n)), list[float](), 0
    while at < n:
        w = _between(random, 0.5, 8.0)
        modes.append(w)
        if at < n - 1 and random.random() < 0.7:
            damping, both = w * _between(random, 0.02, 0.7), slice(at, at + 2)
            A[both, both] = [[-damping, w], [-w, -damping]]
            if is_chain:
                A[both, both] = [[0.0, 1.0], [-w * w, -2.0 * damping]]
            at += 2
        else:
            A[at, at] = -w
            at += 1
    for i, j in np.argwhere(A == 0.0):
        if random.random() < 0.7:
            A[i, j] = 0.3 * random.normal() * min(modes)
    return A, modes


_FAMILIES = (_pendulum, _matrices, _matrices, _masses)


def _memberships(kind: str, rules: int, width: float) -> list[Membership]:
    """Return the memberships of a premise of about ±width."""
    if kind == "sector":
        return [membership(f"sine_{end}", {"half_width": width}) for end in ("upper", "lower")]
    centres, gap = np.linspace(-width, width, rules), 2.0 * width / (rules - 1)
    if kind == "gaussian":
        return [membership(kind, {"centre": c, "width": 0.6 * gap}) for c in centres.tolist()]
    corners = np.add.outer(centres, gap * np.array([-0.8, -0.2, 0.2, 0.8]))
    corners[0, :2] -= 99.0 * gap  # outside of the range the outer memberships are constant
    corners[-1, 2:] += 99.0 * gap
    names = ("left", "top_left", "top_right", "right")
    return [membership(kind, dict(zip(names, one, strict=True))) for one in corners.tolist()]


def _disturbance(
    random: np.random.Generator, sigma: float, clean: float
) -> tuple[DisturbanceTerm, tuple[BiasStep | GaussMarkov | Sinusoid, ...]]:
    """Return a sensor's disturbance as modelled and as simulated; none with probability `clean`."""
    what = random.random()
    if what < clean:
        return DisturbanceTerm("clean"), ()
    if what < 0.8:
        density = sigma**2 * _between(random, 1e-3, 0.3)
        numbers = {"density": density, "initial_std": 10.0 * sigma}
        bias = BiasStep(5.0 * sigma * random.normal(), 0.0)
        return DisturbanceTerm("bias", numbers), (bias, GaussMarkov(sqrt(500.0 * density), 1000.0))
    numbers = {"frequency": (w := _between(random, 0.7, 12.0))}
    numbers["density"] = sigma**2 * _between(random, 1e-3, 0.1)
    numbers["initial_std"] = 6.0 * sigma
    tone = Sinusoid(4.0 * sigma * random.uniform(0.5, 2.0), w, 0.0)
    return DisturbanceTerm("sinusoid", numbers), (tone,)


def drawn(seed: int) -> Case | None:
    """Draw a system with its sensors; None if it goes too far, or a state hardly moves."""
    random = np.random.default_rng(seed)
    family, rate = _FAMILIES[random.integers(4)], float(round(_between(random, 20.0, 500.0)))
    system = family(random)
    (rules, n, _), p = system.A.shape, len(system.C)
    is_scheduled, slowest = not system.premise.any(), min(system.modes)
    frequency, size = random.uniform(0.3, 1.3) * min(slowest, 3.0), system.amplitude
    drive: Sine | Multisine = Sine(size, frequency)
    if random.random() >= 0.6:
        drive = Multisine(size, 0.4 * frequency, 2.0 * frequency, 5)
    schedule = [Sine(1.0, _between(random, 0.1, 2.0))] if is_scheduled else []
    width, start, luck = system.width or 1.0, np.zeros(n), random.normal(size=n)
    for _ in range(5):  # start and premise width depend on the motion, and the motion on them
        base = RuleBase(tuple((one,) for one in _memberships(system.memberships, rules, width)))
        scheduled = np.ones((1, int(is_scheduled)))
        model = TSModel(system.A, system.B, system.C, base, system.premise, scheduled)
        motion = SystemScenario(
            model=model, true_rates=model.rates, process_noise=np.zeros(n), rate=max(rate, 100.0),
            duration=20.0, inputs=(drive, *schedule), fed_back=(None,) * is_scheduled,
            outputs=tuple(SimulatedOutput(f"y{i + 1}", Sensor(0.0)) for i in range(p)),
            initial_state=start,
        )  # fmt: skip
        states = Plant(motion).run(motion.sample_count).states
        if not (np.abs(states) <= _FAR).all():
            return None
        reach = np.abs(states @ system.premise[0]).max()
        if system.width is not None:
            drive = replace(drive, amplitude=drive.amplitude * min(1.0, 0.8 * width / reach))
        elif not is_scheduled:
            width = max(1e-3, reach)
        std = states[len(states) // 4 :].std(axis=0)
        start = 0.5 * std * luck
    if std.min() < 1e-3 * std.max():
        return None
    sigmas = (states @ system.C.T).std(axis=0) * [_between(random, 0.003, 0.15) for _ in range(p)]
    noise, pushed = np.zeros(n), system.pushed
    noise[pushed] = (std[pushed] * _between(random, 0.003, 0.1)) ** 2 * slowest
    cleans = (0.7, 0.4) if p == 2 else (0.4,)
    pairs = [_disturbance(random, *each) for each in zip(sigmas.tolist(), cleans, strict=True)]
    request = TSRequest(
        model, noise, sigmas, rate, 2.0 * std, disturbance=[(term,) for term, _ in pairs],
        slope_vertices=system.slopes,
        uncertainty={"theta": Direction(system.E, 0.3)} if random.random() < 0.6 else {},
    )  # fmt: skip
    outputs = (
        replace(output, sensor=Sensor(sigma), disturbance=signals)
        for output, sigma, (_, signals) in zip(motion.outputs, sigmas.tolist(), pairs, strict=True)
    )
    scenario = replace(
        motion, process_noise=noise, rate=rate, duration=DURATION, outputs=tuple(outputs),
        inputs=(drive, *schedule), initial_state=start,
    )  # fmt: skip
    return Case(request, scenario, std * slowest)


def troubled(case: Case, trouble: str, seed: int) -> SystemScenario:
    """Return the scenario with a trouble; an unknown input comes after the known one."""
    random = np.random.default_rng([seed, _TROUBLES.index(trouble), 7])
    request, scenario = case.request, case.scenario
    model, sensors = request.model, [output.sensor for output in scenario.outputs]
    hurt = int(random.integers(len(sensors)))
    if trouble == "other noise":
        factor = _between(random, 0.5, 3.0)
        sensors = [replace(one, noise_std=factor * one.noise_std) for one in sensors]
    elif trouble == "outliers":
        share, factor = random.uniform(0.01, 0.05), _between(random, 8.0, 60.0)
        outliers = {"outlier_probability": share, "outlier_is_uniform": random.random() < 0.5}
        sensors = [replace(s, outlier_size=factor * s.noise_std, **outliers) for s in sensors]
    elif trouble == "lost samples" and random.random() < 0.5:
        share = random.uniform(0.05, 0.4)
        sensors = [replace(one, loss_probability=share) for one in sensors]
    elif trouble == "lost samples":
        every, gap = random.uniform(4.0, 9.0), random.uniform(0.3, 2.0)
        sensors[hurt] = replace(sensors[hurt], dropout_interval=every, dropout_duration=gap)
    elif trouble == "coloured noise":
        time = _between(random, 0.01, 0.3)
        sensors = [replace(one, noise_time_constant=time) for one in sensors]
    pairs = zip(scenario.outputs, sensors, strict=True)
    outputs = [replace(output, sensor=sensor) for output, sensor in pairs]
    if trouble == "a sensor steps":
        size = _between(random, 3.0, 40.0) * np.sign(0.5 - random.random())
        step = BiasStep(size * sensors[hurt].noise_std, random.uniform(8.0, 20.0))
        outputs[hurt] = replace(outputs[hurt], disturbance=(*outputs[hurt].disturbance, step))
    elif trouble == "a sensor drifts":
        size, time = _between(random, 3.0, 20.0), _between(random, 5.0, 40.0)
        drift = GaussMarkov(size * sensors[hurt].noise_std, time)
        outputs[hurt] = replace(outputs[hurt], disturbance=(*outputs[hurt].disturbance, drift))
    elif trouble == "another parameter":
        theta = random.uniform(0.1, 0.3) * np.sign(0.5 - random.random())
        rates = model.rates + theta * request.uncertainty_model.directions[0]
        scenario = replace(scenario, true_rates=rates)
    elif trouble == "another matrix A":
        model = replace(model, A=model.A * (1.0 + 0.1 * random.standard_normal(model.A.shape[1:])))
        scenario = replace(scenario, model=model, true_rates=model.rates)
    elif trouble == "another gain of the input":
        B = model.B.copy()
        B[..., 0] *= random.choice([0.7, 0.8, 1.2, 1.3])
        model = replace(model, B=B)
        scenario = replace(scenario, model=model, true_rates=model.rates)
    elif trouble in _UNKNOWN:
        place, (drive, *_) = random.choice(np.flatnonzero(request.process_noise)), scenario.inputs
        size = _between(random, 0.05, 0.5) * case.pace[place]
        unknown = Constant(size) if random.random() < 0.5 else Sine(size, random.uniform(0.05, 0.4))
        column = np.repeat([np.eye(len(case.pace))[:, [place]]], len(model.B), 0)
        if trouble == "an offset of the input" and isinstance(drive, Sine | Multisine):
            column = model.B[..., :1]
            unknown = Constant(_between(random, 0.1, 1.0) * drive.amplitude)
        model, known = replace(model, B=np.dstack([model.B, column])), scenario.inputs
        scenario = replace(
            scenario, model=model, true_rates=model.rates, inputs=(known[0], unknown, *known[1:])
        )
    return replace(scenario, outputs=tuple(outputs))


def judged(seed: int) -> list[Judged]:
    """Design, simulate and judge a system with each trouble; none if there is no design."""
    case, found = drawn(seed), list[Judged]()
    if case is None:
        return []
    request, theta = case.request, case.request.uncertainty_model
    try:
        design = synthesise(request)
    except DesignError:
        return []
    rivals = [(inf, None), (GATE, None)] + [(GATE, theta)] * bool(theta.count)
    noise = request.measurement_covariance, request.initial_covariance
    estimators = [make_estimator(design, ObserverSettings())]
    estimators += [extended_kalman(request.flow, *noise, own, gate=gate) for gate, own in rivals]
    for trouble in _TROUBLES:
        if trouble == "another parameter" and not theta.count:
            continue
        scenario = troubled(case, trouble, seed)
        run = Plant(scenario, seed).run(scenario.sample_count)
        if not (np.abs(run.states) <= _FAR).all():
            continue
        late, known = run.times >= _JUDGED, run.torques
        if trouble in _UNKNOWN:
            known = np.delete(known, 1, axis=1)
        series = stamps_of(run.times), run.measurements, known
        trackers = [Tracker(each, history=0.0, max_steps=1) for each in estimators]
        mine, *others = (each.follow(*series)[late] for each in trackers)
        states = [each["state"] for each in others]
        found.append(compared(trouble, run.states[late], mine, mine["claimed"], states))
    return found


def main() -> None:
    """Measure and print."""
    options, systems = options_of(parser(__doc__, design=False), ()), list[list[Judged]]()
    with Pool(options.processes) as pool:
        for found in pool.imap(judged, options.seeds):
            systems.append(found)
            ratios = " ".join(f"{one.ratio:.2f}" for one in found) or "no design"
            print(f"{len(systems)}/{options.runs} {ratios}", file=sys.stderr, flush=True)
    first, last = options.seeds[0], options.seeds[-1]
    head = f"{sum(map(bool, systems))} systems of {options.runs} seeds, {first} to {last}.\n"
    results = [one for found in systems for one in found]
    groups = [each for each in _TROUBLES if any(one.group == each for one in results)]
    listed = [[one._asdict() for one in found] for found in systems]
    text = "\n".join([head, *table(results, groups, "trouble", "runs")])
    end(options, __file__, text, {"first_seed": first, "systems": listed}, [])


if __name__ == "__main__":
    use_one_thread()
    main()
