# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Demands on encoders on either side and on unknown torques, on simulated runs.

The arm is the default one. `ours` is the node's observer; `gated EKF` has the same states, a gate
and a reset, and `EKF` has no gate. All have the arm's parameters, none has friction or contact.
The demands on contacts are on the node's tracker and fault monitors at 200 ticks per second.
"""

import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from multiprocessing import Pool
from typing import NamedTuple

import numpy as np
from acceptance_demands import INSIDE_BAR, Demand
from acceptance_runs import SCALE, WINDOWS, is_inside
from common import parser, use_one_thread
from pages import end, head, options_of, row, verdicts

from tsobs_ros.campaign.batches import observe
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TorqueDisturbance
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.faults import FaultKind, FaultMonitor
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.series import stamps_of
from tsobs_ros.simulation import plant
from tsobs_ros.simulation.plant import Friction, Scenario, SimulatedOutput, Trajectories
from tsobs_ros.simulation.scenarios import simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep

_ENCODER = 0.001
"""1σ of an encoder [rad]."""

_START, _CONTACT, _TICK = 5.0, 10.0, 0.005
"""Times from which contacts are judged and at which they begin, and time between ticks [s]."""

_PLAIN, _PLAIN_NODE = "no torque disturbance, gain alone", "no torque disturbance, hypotheses"
"""Observers of the design without torque disturbance: its gain alone, and the node's observer."""

_WANDER = DisturbanceTerm("bias", {"density": 1e-6})
_MOTOR, _LINK = Output("motor_angle", _ENCODER), Output("link_angle", _ENCODER, (_WANDER,))
_OLD_LINK = Output("link_angle", 0.028, (_WANDER,))
_FRICTION = (DisturbanceTerm("gauss_markov", {"std": 0.1, "time_constant": 1.0}),)
_PUSH = (DisturbanceTerm("gauss_markov", {"std": 2.0, "time_constant": 2.0}),)
_FREE = TorqueDisturbance()


class Case(NamedTuple):
    """A request, and the scenario for its observer."""

    request: ArmRequest
    scenario: Scenario


def _case(
    outputs: Sequence[Output],
    torque: TorqueDisturbance = _FREE,
    *,
    rate: float = 200.0,
    x_max: float = 0.75,
    bias: float = 0.0,
    contact: float = 0.0,
    friction: Friction | None = None,
    loudness: float = 1.0,
) -> Case:
    request = ArmRequest(
        outputs=outputs, torque_disturbance=torque, rate=rate, x_max=x_max, uncertainty={}
    )
    fault = (BiasStep(bias, _CONTACT),) if bias else ()
    sensors = [
        SimulatedOutput(
            each.measures,
            Sensor(loudness * each.measurement_std),
            fault if each.measures == "link_angle" else (),
        )
        for each in outputs
    ]
    push = (BiasStep(contact, _CONTACT),) if contact else ()
    scenario = Scenario(
        rate=rate,
        duration=20.0 if contact else 60.0,
        outputs=tuple(sensors),
        friction=friction or Friction(),
        torque_disturbance=plant.TorqueDisturbance(link=push),
    )
    return Case(request, scenario)


_SLIGHT = Friction(motor_viscous=0.1, motor_coulomb=0.05)
_AT_MOTOR = TorqueDisturbance(motor=_FRICTION)
_AT_LINK = TorqueDisturbance(link=_PUSH)

ACCURACY = {
    "motor_encoder": _case([_MOTOR]),
    "friction": _case([_MOTOR, _LINK], _AT_MOTOR, friction=_SLIGHT),
    "friction_motor_encoder": _case([_MOTOR], _AT_MOTOR, friction=_SLIGHT),
    "friction_link_sensor": _case([_OLD_LINK], _AT_MOTOR, friction=_SLIGHT),
}
"""One minute each at 200 Hz, u = sin t; friction of the motor of 0.1 N m s/rad and 0.05 N m, with
encoders on both sides, on the motor, and with the default design's sensor of the link."""

CONTACTS = {
    "contact": _case([_MOTOR, _LINK], _AT_LINK, rate=1000.0, x_max=0.9, contact=2.0),
    "contact_loud": _case(
        [_MOTOR, _LINK], _AT_LINK, rate=1000.0, x_max=0.9, contact=2.0, loudness=2.0
    ),
    "contact_and_bias": _case(
        [_MOTOR, _LINK], _AT_LINK, rate=1000.0, x_max=0.9, contact=2.0, bias=0.1
    ),
}
"""A torque of 2 N m on the link, 20 % of the gravity torque, from 10 s to the end at 20 s; "loud"
is with twice the encoders' noise."""


class Accuracy(NamedTuple):
    """Errors of observers on the same runs, each run by itself.

    Attributes:
        errors: N of the settled window by observer, shape (runs,).
        link_errors: The same of the link's angle and velocity alone.
        inside: Share of our errors within three bounds over the full window, of the four states,
            shape (runs, 4).
    """

    errors: dict[str, Array]
    link_errors: dict[str, Array]
    inside: Array


class Contact(NamedTuple):
    """The findings on contacts, each run by itself.

    Attributes:
        noticed: Time from the contact until its torque is beyond three bounds [s], (runs,).
        early: Share of the time before the contact with a torque beyond three bounds, (runs,).
        inside: Share of the errors within three bounds: torque, disturbances of the outputs in
            the order of the request, the four states; shape (runs, 1 + p + 4).
        reports: Shares of the time after the contact by output and kind of fault.
        quiet: The same shares of the time before the contact.
    """

    noticed: Array
    early: Array
    inside: Array
    reports: dict[str, dict[str, float]]
    quiet: dict[str, dict[str, float]]


def accuracy(case: Case, design: Design, plain: Design, seeds: Sequence[int]) -> Accuracy:
    """Return the errors of the observers; `plain` is the design without torque disturbance."""
    runs = simulate(case.scenario, seeds)
    ours = observe(design, runs)
    states = {"ours": ours.rows["state"], "EKF": _ekf(design, runs, "ekf_plain")}
    states["gated EKF"] = _ekf(design, runs, "ekf")
    if plain is not design:
        states[_PLAIN] = observe(plain, runs, estimator=plain.observer()).rows["state"]
        states[_PLAIN_NODE] = observe(plain, runs).rows["state"]
    full = is_inside(runs.times, WINDOWS["full"])
    kept = (
        np.abs(ours.rows["state"] - runs.physical)[:, full]
        <= SIGMAS * ours.rows["state_bound"][:, full]
    )
    squares = {who: _squares(design, each, runs) for who, each in states.items()}
    return Accuracy(
        {who: np.sqrt(each.mean(axis=(1, 2))) for who, each in squares.items()},
        {who: np.sqrt(each[..., :2].mean(axis=(1, 2))) for who, each in squares.items()},
        kept.mean(axis=1),
    )


def _ekf(design: Design, runs: Trajectories, method: str) -> Array:
    return observe(design, runs, ObserverSettings(method=method)).rows["state"]


def _squares(design: Design, states: Array, runs: Trajectories) -> Array:
    """Return squared errors in design coordinates over the settled window, in units of `SCALE`."""
    settled = is_inside(runs.times, WINDOWS["settled"])
    away = design.arm_request.arm.from_physical(states[:, settled]) - runs.states[:, settled]
    return np.asarray((away / SCALE) ** 2)


def contact(case: Case, design: Design, seeds: Sequence[int]) -> Contact:
    """Return the findings of the observer and its fault monitors on contacts."""
    runs, request = simulate(case.scenario, seeds), design.arm_request
    stamps, every = stamps_of(runs.times), round(_TICK * request.rate)
    noticed, early, inside = [], [], []
    names = request.output_names
    counts = {when: {name: Counter[str]() for name in names} for when in ("before", "after")}
    side = request.torque_sides.index("link")
    for place in range(len(seeds)):
        tracker = make_tracker(design, ObserverSettings())
        monitor = FaultMonitor(tracker.estimator)
        beyond, kept, times = [], [], []
        for begin in range(0, len(stamps), every):
            part = slice(begin, begin + every)
            y, u = runs.measurements[place, part], runs.torques[place, part]
            tracker.offer_many(stamps[part], y, u, int(stamps[-1]))
            last = min(begin + every, len(stamps)) - 1
            estimate = tracker.estimate(int(stamps[last]))
            if estimate is None:
                continue
            when = "before" if runs.times[last] < _CONTACT else "after"
            monitor.update(estimate, tracker.state)
            if runs.times[last] >= _START:
                for name, fault in zip(names, monitor.faults, strict=True):
                    counts[when][name][fault.kind.value] += 1
            truth = [
                runs.torque_disturbances[place, last, 1:],
                runs.disturbances[place, last],
                runs.physical[place, last],
            ]
            guess = [estimate.torque_disturbance[side : side + 1], estimate.disturbance]
            bound = [estimate.torque_disturbance_bound[side : side + 1], estimate.disturbance_bound]
            away = np.concatenate([*guess, estimate.state]) - np.concatenate(truth)
            limits = SIGMAS * np.concatenate([*bound, estimate.state_bound])
            times.append(runs.times[last])
            kept.append(np.abs(away) <= limits)
            beyond.append(abs(guess[0][0]) > limits[0])
        time, out = np.array(times), np.array(beyond)
        after = time[out & (time >= _CONTACT)]
        noticed.append(after[0] - _CONTACT if len(after) else np.inf)
        early.append(out[is_inside(time, (_START, _CONTACT))].mean())
        inside.append(np.array(kept)[time >= _START].mean(axis=0))
    before, later = (
        {name: {kind: n / each.total() for kind, n in each.items()} for name, each in part.items()}
        for part in counts.values()
    )
    return Contact(np.array(noticed), np.array(early), np.array(inside), later, before)


Found = Accuracy | Contact


def demands(results: Mapping[str, Found]) -> Iterator[Demand]:
    """Yield the demands on the cases that were run."""
    for name, found in results.items():
        if isinstance(found, Accuracy):
            yield from _of_accuracy(name, found)
        else:
            yield from _of_contact(name, found)


def _of_accuracy(name: str, found: Accuracy) -> Iterator[Demand]:
    def ratio(text: str, mine: Array, theirs: Array, bar: float) -> Demand:
        median = float(np.median(mine / theirs))
        return Demand(name, text, text, float(mine.mean() / theirs.mean()), bar, median=median)

    ours = found.errors["ours"]
    if name == "motor_encoder":
        mine, theirs = found.link_errors["ours"], found.link_errors["EKF"]
        yield ratio("N of the link / EKF that knows the arm", mine, theirs, 1.05)
    else:
        yield ratio("N / gated EKF with the same states", ours, found.errors["gated EKF"], 1.1)
    if name == "friction":
        theirs = found.errors[_PLAIN]
        yield ratio("N / the gain of the design without torque disturbance", ours, theirs, 0.5)
    worst = float(found.inside.mean(axis=0).min())
    yield Demand(name, "inside", "within three bounds", worst, INSIDE_BAR, at_least=True)


def _of_contact(name: str, found: Contact) -> Iterator[Demand]:
    yield Demand(name, "noticed", "contact noticed [s], slowest", float(found.noticed.max()), 0.1)
    yield Demand(name, "early", "time with a contact before it", float(found.early.mean()), 0.01)
    shares, p = found.inside.mean(axis=0), len(found.reports)
    for text, share in (
        ("torque", shares[0]),
        ("disturbances of the encoders", shares[1 : 1 + p].min()),
        ("states", shares[1 + p :].min()),
    ):
        text = f"{text} within three bounds"
        yield Demand(name, text, text, float(share), INSIDE_BAR, at_least=True)
    there = FaultKind.NOISE if name == "contact_loud" else FaultKind.NONE
    for output, kinds in found.reports.items():
        faulty = name == "contact_and_bias" and output == "link_angle"
        right = FaultKind.BIAS if faulty else there
        text = f"{output}: {right.value} reported"
        bar = 1.0 if right is FaultKind.NONE else 0.9
        yield Demand(name, text, text, kinds.get(right.value, 0.0), bar, at_least=True)


def _work(job: tuple[str, Design, Design, tuple[int, ...]]) -> tuple[str, Found]:
    name, design, plain, seeds = job
    if name in ACCURACY:
        return name, accuracy(ACCURACY[name], design, plain, seeds)
    return name, contact(CONTACTS[name], design, seeds)


def measure(names: Sequence[str], seeds: Sequence[int], processes: int) -> dict[str, Found]:
    """Return the results by case."""
    jobs = []
    for name in names:
        request = (ACCURACY | CONTACTS)[name].request
        design = plain = synthesise(request)
        if name in ACCURACY and request.torque_sides:
            plain = synthesise(replace(request, torque_disturbance=_FREE))
        jobs.append((name, design, plain, tuple(seeds)))
    results = {}
    with Pool(processes) as pool:
        for done, (name, found) in enumerate(pool.imap(_work, jobs), 1):
            print(f"{done}/{len(jobs)} {name}", file=sys.stderr, flush=True)
            results[name] = found
    return results


def _accuracy_table(results: Mapping[str, Found]) -> Iterator[str]:
    who = ("ours", "gated EKF", "EKF", _PLAIN, _PLAIN_NODE)
    yield from head("scenario", *who, "within three bounds")
    for name, found in results.items():
        if isinstance(found, Accuracy):
            cells = [
                f"{found.errors[each].mean():.4f}" if each in found.errors else "–" for each in who
            ]
            yield row(name, *cells, f"{found.inside.mean(axis=0).min():.3f}")


def _contact_table(results: Mapping[str, Found]) -> Iterator[str]:
    yield from head(
        "scenario", "noticed after [s]: median, slowest", "torque within three bounds",
        "encoders' disturbances", "states",
    )  # fmt: skip
    for name, found in results.items():
        if isinstance(found, Contact):
            inside, p = found.inside.mean(axis=0), len(found.reports)
            shares = (inside[0], inside[1 : 1 + p].min(), inside[1 + p :].min())
            yield row(
                name, f"{np.median(found.noticed):.3f}, {found.noticed.max():.3f}",
                *(f"{share:.3f}" for share in shares),
            )  # fmt: skip


def _page(results: Mapping[str, Found], found: Sequence[Demand], seeds: range) -> Iterator[str]:
    failed = sum(not one.passed for one in found)
    yield f"{len(seeds)} runs of each scenario, seeds {seeds[0]} to {seeds[-1]}. "
    yield f"{failed} of {len(found)} demands are missed.\n"
    yield from _accuracy_table(results)
    yield ""
    yield from _contact_table(results)
    if failed:
        yield ""
        yield from verdicts([one for one in found if not one.passed])


def main() -> None:
    """Measure and print."""
    options = options_of(parser(__doc__, design=False), ACCURACY | CONTACTS)
    results = measure(options.scenarios, options.seeds, options.processes)
    found = list(demands(results))
    end(options, __file__, "\n".join(_page(results, found, options.seeds)), {}, found)


if __name__ == "__main__":
    use_one_thread()
    main()
