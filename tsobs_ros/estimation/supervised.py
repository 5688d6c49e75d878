# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer under supervision, as the node runs it, one joint at a time.

The observer's model gives the size of an innovation. A lone one that is far too large is an
outlier and is downweighted. Eight in a row that lean to one side are a jump of the sensor. A long
average that is far too large is an estimate that has lost the arm. Everything is decided on the
normalised innovation r = e/√s and on durations between stamps.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, non_negative, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.adaptive import AdaptiveObserver
from tsobs_ros.estimation.estimator import Correction, Readout
from tsobs_ros.estimation.observer import TSObserver

_WINDOW = 8
_WINDOW_CLIP = 5.0
_SAME_SIGN = 7
_LEAN = 6.0 * math.sqrt(_WINDOW)
_LOST_CLIP = 4.0
_CALM = 2.0


@dataclass(frozen=True)
class SupervisionOptions:
    """When to react, and how strongly; the defaults are for 200 Hz.

    Attributes:
        gate: Innovations beyond so many σ are downweighted to it.
        reject: Innovations beyond so many σ are not used at all.
        jump_std: 1σ by which the disturbance's uncertainty grows after a jump [rad]; 0 switches
            jumps off.
        jump_duration: Riccati gains are used for at least so long after a jump [s].
        jump_quiet: No jump is looked for so soon after a start [s], when innovations are one-sided.
        jump_budget: Largest number of jumps in `jump_budget_window`: under a wrong model every
            innovation leans, and unbudgeted reactions make the error worse.
        jump_budget_window: [s].
        lost: Half-second average of |r| beyond which the estimate is given up.
        stuck_samples: From so many repetitions of the very same value on, samples of the sensor
            are not used; 0 for a sensor whose steps are larger than its noise.
        disturbance_limit: The estimated disturbance is kept within so much [rad]; beyond π the arm
            and its sensor turned together look the same.
        strain: `nis` above 2, or a parameter at its limit, for so long resets the adaptation [s].
        relearn_budget: After so many times the parameters are frozen at their nominal values.
    """

    gate: float = 5.0
    reject: float = 50.0
    jump_std: float = 0.15
    jump_duration: float = 1.5
    jump_quiet: float = 8.0
    jump_budget: int = 3
    jump_budget_window: float = 20.0
    lost: float = 6.0
    stuck_samples: int = 10
    disturbance_limit: float = math.pi
    strain: float = 1.0
    relearn_budget: int = 4

    def __post_init__(self) -> None:
        for name in ("gate", "lost", "disturbance_limit", "strain"):
            positive(name, getattr(self, name))
        jumps = ("jump_std", "jump_duration", "jump_quiet", "jump_budget", "jump_budget_window")
        for name in (*jumps, "stuck_samples", "relearn_budget"):
            non_negative(name, getattr(self, name))
        if not self.reject >= self.gate:
            raise ModelError(
                f"reject: expected at least the gate {self.gate!r}, got {self.reject!r}"
            )


class Watch(NamedTuple):
    """The supervision's memory of the innovations.

    Attributes:
        recent: The last normalised innovations, clipped, oldest first.
        nis: One-second average of min(r², 25); 1 when the model fits.
        calm_nis: `nis` from before the window of recent innovations.
        magnitude: Half-second average of |r|.
        strained: How long `nis` has been above 2 [s].
        age: Time since the start or the last loss [s].
        jumps: Ages at which a jump was found, newest last.
    """

    recent: tuple[float, ...] = ()
    nis: float = 1.0
    calm_nis: tuple[float, ...] = ()
    magnitude: float = 1.0
    strained: float = 0.0
    age: float = 0.0
    jumps: tuple[float, ...] = ()

    def after(self, duration: float) -> "Watch":
        """Return the memory a time `duration` [s] later."""
        return Watch(*self[:5], self.age + duration, self.jumps)


class Verdict(NamedTuple):
    """The judgement of one innovation.

    Attributes:
        weight: Share of the correction to apply, in [0, 1].
        jumped: Whether the sensor has jumped.
        lost: Whether the estimate has lost the arm.
        strained: Whether the innovations have been too large for too long.
    """

    weight: float
    jumped: bool = False
    lost: bool = False
    strained: bool = False


def judge(
    watch: Watch, normalised: float, period: float, options: SupervisionOptions
) -> tuple[Watch, Verdict]:
    """Return the memory with a normalised innovation in it, and the verdict.

    Args:
        watch: Memory so far.
        normalised: r = e/√s.
        period: Sampling period, by which the averages are taken [s].
        options: When to react.
    """
    size = abs(normalised)
    limit = options.gate * math.sqrt(watch.nis) if watch.nis > 1.0 else options.gate
    weight = limit / size if size > limit else 1.0
    if size > options.reject:
        weight = 0.0
    clipped = normalised if size < _WINDOW_CLIP else math.copysign(_WINDOW_CLIP, normalised)
    recent = (*watch.recent, clipped)[-_WINDOW:]
    nis = watch.nis - math.expm1(-period) * (clipped * clipped - watch.nis)
    # A lone value of any size must not give the estimate up.
    bounded = min(size, _LOST_CLIP * options.lost)
    magnitude = watch.magnitude - math.expm1(-2.0 * period) * (bounded - watch.magnitude)
    calm = (*watch.calm_nis, watch.nis)[-_WINDOW:]
    if magnitude > options.lost:
        return Watch(), Verdict(weight, lost=True)
    if _leans(recent) and calm[0] < _CALM and _may_jump(watch, options):
        # The averages start over: they belong to the time before the jump.
        jumps = (*watch.jumps, watch.age)[-max(1, options.jump_budget) :]
        return Watch(age=watch.age, jumps=jumps), Verdict(weight, jumped=True)
    strained = watch.strained + period if nis > _CALM else 0.0
    verdict = Verdict(weight, strained=strained >= options.strain)
    if verdict.strained:
        strained = 0.0
    return Watch(recent, nis, calm, magnitude, strained, watch.age, watch.jumps), verdict


def _leans(recent: tuple[float, ...]) -> bool:
    if len(recent) < _WINDOW or abs(sum(recent)) <= _LEAN:
        return False
    positives = sum(value > 0.0 for value in recent)
    return max(positives, _WINDOW - positives) >= _SAME_SIGN


def _may_jump(watch: Watch, options: SupervisionOptions) -> bool:
    if options.jump_std == 0.0 or options.jump_budget == 0 or watch.age < options.jump_quiet:
        return False
    if watch.jumps and watch.age - watch.jumps[-1] < options.jump_duration:
        return False
    full = len(watch.jumps) >= options.jump_budget
    return not full or watch.age - watch.jumps[0] > options.jump_budget_window


class SupervisedState(NamedTuple):
    """State of the observer and of its supervision.

    Attributes:
        inner: State of the observer underneath.
        watch: The supervision's memory of the innovations.
        pause: Time for which the adaptation still rests [s].
        pinned: How long a parameter has been at its limit [s].
        y: The last sample [rad], None before the first.
        repeats: Number of samples since then with the very same value.
        outliers: Number of measurements that were downweighted.
        jumps: Number of sensor jumps found.
        losses: Number of times the estimate was given up and restarted.
        adaptation_resets: Number of times the adaptation was reset.
    """

    inner: Any
    watch: Watch
    pause: float = 0.0
    pinned: float = 0.0
    y: float | None = None
    repeats: int = 0
    outliers: int = 0
    jumps: int = 0
    losses: int = 0
    adaptation_resets: int = 0


class SupervisedObserver:
    """Downweights outliers, reacts to jumps, restarts a lost estimate, guards the adaptation.

    It has no batch axis: arms in a batch would react at different times.

    Attributes:
        observer: The observer underneath.
    """

    def __init__(
        self,
        observer: TSObserver | AdaptiveObserver,
        options: SupervisionOptions | None = None,
    ) -> None:
        # Any: the two kinds of state never mix, which the type system cannot see from here.
        self.observer: Any = observer
        self._adaptive = observer if isinstance(observer, AdaptiveObserver) else None
        self._certified = observer.observer if isinstance(observer, AdaptiveObserver) else observer
        self._period = float(observer.period)
        self.options = options or SupervisionOptions()

    @property
    def options(self) -> SupervisionOptions:
        """When to react; may be exchanged between two steps."""
        return self._options

    @options.setter
    def options(self, options: SupervisionOptions) -> None:
        self._options = options
        # A jump of the sensor concerns the states that the disturbance is read from.
        flow = self._certified.flow
        read = np.zeros(flow.state_count)
        read[flow.state_count - flow.disturbance.state_count :] = flow.disturbance.H[0] != 0.0
        self._jump_variance = np.diag(read * options.jump_std**2)
        self._lost_variance = np.diag(read * options.disturbance_limit**2)

    @property
    def period(self) -> float:
        """Nominal sampling period [s]."""
        return self._period

    def initial(self) -> SupervisedState:
        """Return the state before any measurement."""
        return SupervisedState(self.observer.initial(), Watch())

    def correct(self, state: SupervisedState, y: Array) -> tuple[SupervisedState, Correction]:
        """Use one measurement y [rad], shape (1,), by the weight that it gets."""
        correction: Correction = self.observer.expect(state.inner, y)
        sample = float(y[0])
        repeats = state.repeats + 1 if sample == state.y else 0
        if 0 < self._options.stuck_samples <= repeats:
            inner = self.observer.end_gap(state.inner)
            state = state._replace(inner=inner, y=sample, repeats=repeats)
            return state, correction._replace(weight=0.0)
        innovation = float(correction.innovation[0])
        normalised = innovation / float(correction.innovation_covariance[0, 0]) ** 0.5
        watch, verdict = judge(state.watch, normalised, self._period, self._options)
        # Made whole: replacing single fields of so many takes several times as long.
        state = SupervisedState(
            state.inner, watch, state.pause, state.pinned, sample, repeats, *state[6:]
        )
        if verdict.lost:
            # This sample is not used: it may be the worst of those that gave the estimate up. The
            # disturbance is wide open, as the sensor is lost more often than the arm.
            initial = self.observer.initial()
            inner = self.observer.inflate_covariance(initial, self._lost_variance, 0.0)
            state = state._replace(inner=inner, losses=state.losses + 1)
            return state, correction._replace(weight=0.0)
        if verdict.weight < 1.0:
            state = state._replace(outliers=state.outliers + 1)
            correction = correction._replace(weight=verdict.weight)
        if verdict.weight <= 0.0:
            return state._replace(inner=self.observer.end_gap(state.inner)), correction
        adapt = state.pause <= 0.0 and not self.frozen(state)
        inner = self.observer.apply(state.inner, correction, verdict.weight, adapt)
        if verdict.jumped and self._jump_variance.any():
            duration = self._options.jump_duration
            inner = self.observer.inflate_covariance(inner, self._jump_variance, duration)
            state = state._replace(jumps=state.jumps + 1, pause=duration)
        inner = self.observer.limit_disturbance(inner, self._options.disturbance_limit)
        return self._guard(state, inner, verdict), correction

    def predict(self, state: SupervisedState, u: Array, duration: float) -> SupervisedState:
        """Predict over `duration` [s] with the torque u [N m], shape (1,), held."""
        inner = self.observer.predict(state.inner, u, duration)
        pause = max(0.0, state.pause - duration)
        return SupervisedState(inner, state.watch.after(duration), pause, *state[3:])

    def extrapolate(self, state: SupervisedState, u: Array, duration: float) -> SupervisedState:
        """Predict to a time between samples; the result is read and not stepped on."""
        return SupervisedState(self.observer.extrapolate(state.inner, u, duration), *state[1:])

    def readout(self, state: SupervisedState) -> Readout:
        """Return the estimate and its bounds in physical units."""
        readout: Readout = self.observer.readout(state.inner)
        return readout._replace(parameters_valid=False) if self.frozen(state) else readout

    def events(self, state: SupervisedState) -> dict[str, int]:
        """Return the numbers of outliers, jumps, losses and restarts of the adaptation so far."""
        return {
            "outliers downweighted": state.outliers,
            "sensor jumps": state.jumps,
            "losses of track": state.losses,
            "learning restarts": state.adaptation_resets,
        }

    def frozen(self, state: SupervisedState) -> bool:
        """Return whether learning was given up: the model differs in other ways than θ."""
        return self._adaptive is not None and state.adaptation_resets > self.options.relearn_budget

    def _guard(self, state: SupervisedState, inner: Any, verdict: Verdict) -> SupervisedState:
        """Return the state after a correction, with the adaptation reset if it goes astray."""
        adaptive = self._adaptive
        if adaptive is None or self.frozen(state):
            return SupervisedState(inner, *state[1:])
        pinned = state.pinned + self._period if adaptive.at_limit(inner) else 0.0
        if not verdict.strained and pinned < self._options.strain:
            return SupervisedState(inner, state.watch, state.pause, pinned, *state[4:])
        state = state._replace(pinned=0.0, adaptation_resets=state.adaptation_resets + 1)
        return state._replace(inner=adaptive.reset_adaptation(inner, nominal=self.frozen(state)))
