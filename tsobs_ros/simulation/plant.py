# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulated plant: a pure, deterministic machine that is stepped by sample index.

Sample k is at the time k/rate. A step measures at that time, then moves the plant on to the next
sample with its inputs held. No clock is read: the same scenario, seed and inputs give the same
numbers, to the bit, for one plant or a batch, sample by sample or many samples at a time.

The true motion, against which observers are judged, is integrated by the classical fourth-order
Runge–Kutta method in steps of at most 1 ms, or 0.2 over the rate of the plant's fastest mode, with
inputs held between samples. The method keeps the undriven arm's energy to 1e-10 over a minute, so
its error is far below any noise.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, finite, non_negative
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import DIRECT, QUANTITIES, SIDES, ElasticJointArm, TorquePath
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.settings import MIN_RATE, setting
from tsobs_ros.simulation.sensor import Disturbance, Output, SimulatedOutput
from tsobs_ros.simulation.signals import Numbers, Signal, Sine, StuckSensor, recurs
from tsobs_ros.simulation.streams import AngleDelay, RandomStream, Source, TorqueDelay

_LONGEST_SUBSTEP, _LARGEST_TURN, _FASTEST = 1e-3, 0.2, 1e6
"""Longest step of the integration [s], the most that the fastest mode turns, or decays, in a step
[rad], and the fastest mode that can be simulated [1/s]."""

_STANDARD_GRAVITY = 9.80665
_BLOCK = 2**16
"""Number of samples of five steps, over all runs, that are moved at a time, so that memory stays
bounded."""


def _change(what: str) -> float:
    return setting(0.0, f"Relative change of the {what}; 0.2 is 20 % more", minimum=-1.0)


@dataclass(frozen=True)
class Mismatch(Numbers, kind="mismatch"):
    """Relative changes that turn the nominal arm into the true one."""

    link_inertia: float = _change("link's inertia")
    motor_inertia: float = _change("motor's inertia")
    stiffness: float = _change("stiffness")
    gravity_torque: float = _change("torque that holds the link horizontal")
    link_damping: float = _change("link's damping")
    motor_damping: float = _change("motor's damping")
    torque_gain: float = _change("torque at the motor")


def _amount(description: str, unit: str) -> float:
    return setting(0.0, description, unit=unit, minimum=0.0)


@dataclass(frozen=True)
class Friction(Numbers, kind="friction"):
    """Friction of the true arm that the nominal one lacks.

    Coulomb friction is c·sign(q̇), and below 0.01 rad/s it grows linearly from zero.
    """

    link_viscous: float = _amount("The link's viscous friction", "N m s/rad")
    link_coulomb: float = _amount("The link's Coulomb friction", "N m")
    motor_viscous: float = _amount("The motor's viscous friction", "N m s/rad")
    motor_coulomb: float = _amount("The motor's Coulomb friction", "N m")


@dataclass(frozen=True)
class Payload(Numbers, kind="payload"):
    """A payload on the link for a time; the link's speed does not jump when it is put on."""

    link_inertia: float = _amount("Inertia that it adds to the link's", "kg m^2")
    gravity_torque: float = _amount("Torque that it adds to what holds the link horizontal", "N m")
    start: float = _amount("When it is put on", "s")
    duration: float = _amount("How long it is carried; 0: for ever", "s")
    mass: float = _amount("Mass at the distance, added to the above", "kg")
    distance: float = _amount("Its distance from the axis", "m")

    @property
    def total(self) -> tuple[float, float]:
        """All inertia [kg m²] and torque [N m] that it adds.

        >>> Payload(mass=2.0, distance=0.5).total[0]
        0.5
        """
        moment = self.mass * _STANDARD_GRAVITY * self.distance
        inertia = self.mass * self.distance * self.distance
        return inertia + self.link_inertia, moment + self.gravity_torque


class TorqueDisturbance(NamedTuple):
    """Torques on motor and link in addition to the drive's [N m], such as those of a contact.

    Each is the sum of its components, held from one sample to the next.
    """

    motor: tuple[Signal, ...] = ()
    link: tuple[Signal, ...] = ()


class Motion:
    """The plants of a batch at a rate [Hz], which differ in their states and random numbers.

    The derivatives of the states have white noise of the given densities. `sizes`, without n, and
    `numbers` are those of the plant's record in core/simulate.h. `states` are the present ones,
    shape (runs, n), `steps` those of the integration per sample.

    Raises:
        ModelError: The plant's fastest mode [1/s] is too fast.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        rate: float,
        states: Array,
        densities: Array,
        sizes: Sequence[int],
        fastest: float,
        **numbers: ArrayLike,
    ) -> None:
        if not fastest <= _FASTEST:
            raise ModelError(
                f"simulation: expected a plant with modes up to {_FASTEST:g} 1/s, got {fastest:.4g}"
            )
        longest = min(_LONGEST_SUBSTEP, _LARGEST_TURN / max(fastest, 1.0))
        # A period of exactly five steps must not become six because .005/.001 rounds upwards.
        self.steps = steps = max(1, math.ceil(1.0 / rate / longest - 1e-9))
        step = 1.0 / rate / steps
        self.states, self._rate = states, rate
        self._sizes = np.array([states.shape[1], *sizes], np.int64)
        self._record = np.zeros(1, record_type("simulated_plant", self._sizes))
        own = {"substeps": steps, "substep": step, "noise": np.sqrt(densities * step)}
        for name, value in (own | numbers).items():
            self._record[name] = value
        self._kicks = steps * len(densities) if densities.any() else 0
        self._noise = RandomStream(seeds, Source.PROCESS)

    def move(self, start: int, inputs: Array, torques: Array) -> tuple[Array, Array]:
        """Move on over samples from an index on; return states and true values of the outputs.

        Inputs, including scheduled signals, have the shape (runs, samples, m). The disturbing
        torques, shape (runs, samples, 2), are overwritten with those that an undisturbed arm would
        need for the same motion.
        """
        shape = inputs.shape[:2]
        states = np.empty((*shape, self._sizes[0]))
        outputs = np.empty((*shape, self._sizes[3]))
        kicks = self._noise.take(shape[1], self._kicks)
        numbers = self._record.view(np.float64)
        native.simulate(self._sizes, numbers, inputs, kicks, self.states, states, outputs)
        return states, outputs

    def present(self, number: int) -> Array:
        """Return the true values of an output that has the same C in all rules, shape (runs, 1)."""
        # Term by term, since the last bits of a matrix product depend on the number of runs.
        row = self._record["outputs"][0, number]
        return np.add.accumulate(row * self.states, axis=1)[:, -1:]


class ArmMotion(Motion):
    """Arms, in physical coordinates, which do not depend on the uncertain stiffness."""

    def __init__(self, scenario: "Scenario", seeds: Sequence[int]) -> None:
        self._payload, noise = scenario.payload, scenario.process_noise
        delays = {QUANTITIES.index(output.measures): output.delay for output in scenario.outputs}
        self._sensed = AngleDelay(delays, scenario.rate)
        spread = RandomStream(seeds, Source.INITIAL_STATE).take(4)
        start = np.array(scenario.initial_state) + spread * np.array(scenario.initial_spread)
        states, densities = scenario.arm.to_physical(start), np.array([noise.link, noise.motor])
        arms = [_arm_numbers(scenario, *more) for more in ((0.0, 0.0), self._payload.total)]
        fastest = max(map(_fastest, arms))
        super().__init__(
            seeds, scenario.rate, states, densities, (4, 0, 2, 0, 0), fastest, arms=arms
        )

    def move(self, start: int, inputs: Array, torques: Array) -> tuple[Array, Array]:
        since = np.arange(start, start + inputs.shape[1]) / self._rate - self._payload.start
        is_loaded = np.zeros(inputs.shape)
        is_loaded[..., 0] = recurs(since, self._payload.duration or math.inf, 0.0)
        held = np.concatenate([inputs, torques, is_loaded], axis=2)
        states, torques[:] = super().move(start, held, torques)
        return states, self._sensed.measured(states)


def _arm_numbers(scenario: "Scenario", more_inertia: float, more_torque: float) -> list[float]:
    """Return the numbers of the true arm with a payload, in the form of the compiled core."""
    true, friction = scenario.true_arm, scenario.friction
    j1, j2 = true.link_inertia + more_inertia, true.motor_inertia
    return [
        (true.gravity_torque + more_torque) / j1,
        j2,
        true.stiffness / j1,
        (true.link_damping + friction.link_viscous) / j1,
        true.stiffness / j2,
        (true.motor_damping + friction.motor_viscous) / j2,
        friction.link_coulomb / j1,
        friction.motor_coulomb / j2,
        j1,
        *astuple(friction),
        more_inertia,
        more_torque,
        0.5 * scenario.backlash,
    ]


def _fastest(arm: Sequence[float]) -> float:
    """Return a bound on an arm's modes, whose numbers are in the core's form [1/s]."""
    gravity, _, link, link_damping, motor, motor_damping, *_ = arm
    return max(link_damping, motor_damping) + math.sqrt(gravity + link + motor)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlantScenario:
    """A plant with its inputs and its measured outputs.

    Attributes:
        rate: Samples per second [Hz].
        duration: Length of a run [s].
        outputs: The p measured outputs.
        inputs: Signals of the inputs, then of the scheduled signals, in the absence of a command.
        fed_back: For each scheduled signal, the number of the output whose last finite measurement
            it is; None for an independent signal.
        torque_disturbance: Signals of the disturbance of each torque.
        torque_error: Signals whose sum is the error of the first input as reported [N m].
        torque: How the commanded first input, which is the reported one, reaches the plant by the
            design.
    """

    rate: float = 200.0
    duration: float = 60.0
    outputs: tuple[SimulatedOutput, ...] = (SimulatedOutput(),)
    inputs: tuple[Signal, ...] = (Sine(),)
    fed_back: tuple[int | None, ...] = ()
    torque_disturbance: tuple[tuple[Signal, ...], ...] = ()
    torque_error: tuple[Signal, ...] = ()
    torque: TorquePath = DIRECT

    def __post_init__(self) -> None:
        rate = finite("rate", self.rate, MIN_RATE, f" of at least {MIN_RATE} Hz")
        object.__setattr__(self, "rate", rate)
        object.__setattr__(self, "duration", non_negative("duration", self.duration))

    def motion(self, seeds: Sequence[int]) -> Motion:
        """Return the plants at the first sample, ready to move."""
        raise NotImplementedError

    def to_design(self, physical: Array) -> Array:
        """Return states in design coordinates, for an arm those of the nominal one, (..., n)."""
        return physical

    @property
    def true_torque(self) -> TorquePath:
        """How the commanded first input really reaches the plant."""
        return self.torque

    @property
    def input_count(self) -> int:
        """Number of inputs that can be commanded."""
        return len(self.inputs) - len(self.fed_back)

    @property
    def sample_count(self) -> int:
        """Samples in `duration`: those at 0, 1/rate, … up to and including the end."""
        return math.floor(self.duration * self.rate + 1e-9) + 1


@dataclass(frozen=True, kw_only=True)
class Scenario(PlantScenario):
    """An arm: its input is the motor's torque [N m], its outputs are some of `QUANTITIES`.

    Attributes:
        arm: The nominal arm, which an estimator knows.
        mismatch: Relative differences of the true arm.
        friction: Friction that only the true arm has.
        payload: A payload that the link carries for a time.
        backlash: Play of the true arm's gear [rad], half of it to either side.
        initial_state: Mean of x(0) in the nominal arm's design coordinates.
        initial_spread: 1σ of x(0) in the same coordinates.
        process_noise: Densities of white noise on both accelerations.

    Raises:
        ModelError: A number is not finite or has the wrong sign, a state does not have four
            entries, or an output is unknown or listed twice.
    """

    arm: ElasticJointArm = field(default_factory=ElasticJointArm)
    mismatch: Mismatch = field(default_factory=Mismatch)
    friction: Friction = field(default_factory=Friction)
    payload: Payload = field(default_factory=Payload)
    backlash: float = 0.0
    initial_state: tuple[float, ...] = (0.3, 0.0, 2.0, 0.0)
    initial_spread: tuple[float, ...] = (0.05, 0.1, 0.5, 0.5)
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    torque_disturbance: TorqueDisturbance = field(default_factory=TorqueDisturbance)

    def __post_init__(self) -> None:
        super().__post_init__()
        non_negative("backlash", self.backlash)
        for name in ("initial_state", "initial_spread"):
            as_matrix(name, getattr(self, name), (4,))
        _ = self.true_arm
        names = (*(f"torque_disturbance {side}" for side in SIDES), "torque_error")
        torques = (*self.torque_disturbance, self.torque_error)
        for name, torque in zip(names, torques, strict=True):
            if any(isinstance(each, StuckSensor) for each in torque):
                raise ModelError(f"{name}: expected torques, got a stuck sensor")
        self.arm.measured(
            [output.measures for output in self.outputs], [output.delay for output in self.outputs]
        )

    @property
    def true_arm(self) -> ElasticJointArm:
        """The arm that really moves."""
        changes = asdict(self.mismatch)
        own = {name: by * (1.0 + changes[name]) for name, by in asdict(self.arm).items()}
        return ElasticJointArm(**own)

    @property
    def true_torque(self) -> TorquePath:
        return replace(self.torque, gain=self.torque.gain * (1.0 + self.mismatch.torque_gain))

    def motion(self, seeds: Sequence[int]) -> Motion:
        return ArmMotion(self, seeds)

    def to_design(self, physical: Array) -> Array:
        return self.arm.from_physical(physical)


@dataclass(frozen=True, kw_only=True, eq=False)
class SystemScenario(PlantScenario):
    """A T–S system, ẋ = Σ hᵢ(z)((Aᵢ + ΔAᵢ)x + (Bᵢ + ΔBᵢ)u), y = Σ hᵢ(z) Cᵢx, in the model's units.

    Attributes:
        model: The nominal system, which an estimator knows.
        true_rates: [Aᵢ Bᵢ] of the true system's rules, shape (r, n, n + m).
        process_noise: Densities of white noise on each state's derivative, shape (n,).
        initial_state: x(0), shape (n,); zero if None.

    Raises:
        ModelError: A number is not finite, of the wrong sign or shape, or an output that is fed
            back would depend on itself.
    """

    model: TSModel
    true_rates: Array
    process_noise: Array
    initial_state: ArrayLike | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        n = self.model.state_count
        start = np.zeros(n) if self.initial_state is None else self.initial_state
        object.__setattr__(self, "initial_state", as_matrix("initial_state", start, (n,)))
        for number in self.fed_back:
            if number is not None and np.ptp(self.model.rule_outputs[:, number], axis=0).any():
                raise ModelError(
                    f"{self.outputs[number].measures}: expected the same C in all rules, as its "
                    "measurement is a scheduled signal"
                )

    def motion(self, seeds: Sequence[int]) -> Motion:
        model, start = self.model, np.asarray(self.initial_state)
        shapes, parameters = model.rule_base.coded
        n, m, outputs = model.state_count, model.input_count, model.rule_outputs
        return Motion(
            seeds,
            self.rate,
            np.repeat([start], len(seeds), axis=0),
            self.process_noise,
            (m, model.schedule.shape[1], outputs.shape[1], *shapes.shape),
            float(np.abs(np.linalg.eigvals(self.true_rates[..., :n])).max()),
            rates=self.true_rates.reshape(-1, n + m),
            outputs=outputs.reshape(-1, n),
            shapes=shapes.ravel(),
            parameters=parameters.reshape(-1, 4),
            premise=np.hstack([model.premise, np.zeros((len(model.premise), m)), model.schedule]),
        )


class Trajectories(NamedTuple):
    """A batch of runs; without the first axis a single run, without the second a single sample.

    Shapes are those of an arm. A T–S system has n states, m inputs and then s scheduled signals,
    but no torque disturbances, and its `physical` is `states`.

    Attributes:
        times: k/rate, since the start [s], shape (samples,).
        states: True states in the nominal arm's design coordinates, shape (runs, samples, 4).
        disturbances: Measurement minus truth, without the effects of delay, latency, noise and
            outliers, shape (runs, samples, p). For a stuck sensor, the frozen value minus the true
            one or, if the output has a delay, minus the true one that delay earlier.
        measurements: y, NaN if lost, shape (runs, samples, p).
        torques: Torque reported from each sample to the next [N m]: the commanded one plus its
            error, shape (runs, samples, 1).
        physical: True [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (runs, samples, 4).
        torque_disturbances: Torques on motor and link that the true arm, with its mismatch but
            without friction, payload and backlash, would need in addition to the reported one to
            accelerate alike, except for random accelerations, shape (runs, samples, 2) [N m].
    """

    times: Array
    states: Array
    disturbances: Array
    measurements: Array
    torques: Array
    physical: Array
    torque_disturbances: Array


class Plant:
    """A plant with its inputs, its sensors and everything random about them.

    A sequence of seeds gives a batch of runs, each equal to a single plant with the same seed.

    Attributes:
        scenario: The scenario as given, or as exchanged.
        index: Index of the sample that the next step returns.

    Raises:
        ModelError: A seed is not an integer of at least zero.
    """

    def __init__(self, scenario: PlantScenario, seeds: int | Sequence[int] = 0) -> None:
        self._is_batch = not isinstance(seeds, int | np.integer)
        self._seeds = runs = np.atleast_1d(np.asarray(seeds, np.object_)).tolist()
        if not runs or not all(isinstance(one, int | np.integer) and one >= 0 for one in runs):
            raise ModelError(f"seeds: expected integers of at least 0, at least one, got {seeds!r}")
        self.index = 0
        self._motion, rate = scenario.motion(runs), scenario.rate
        self._outputs = [Output(runs, rate, number) for number in range(len(scenario.outputs))]
        numbers = range(len(scenario.torque_disturbance) + 1)
        *self._torques, self._error = (Disturbance(runs, rate, Source.TORQUE, n) for n in numbers)
        self.exchange(scenario)
        fed_back = enumerate(scenario.fed_back, scenario.input_count)
        self._fed_back = [(place, number) for place, number in fed_back if number is not None]
        self._held = np.zeros((len(runs), len(self._outputs)))
        self._path = TorqueDelay(scenario.true_torque, rate)
        # In estimators the error of a reported torque takes the same path.
        self._error_path = TorqueDelay(replace(scenario.torque, offset=0.0), rate)

    def exchange(self, scenario: PlantScenario) -> None:
        """Go on with the signals and sensors of another scenario of the same plant.

        The time of a changed disturbance, including its start, counts from the next sample; the
        time of inputs goes on.
        """
        self.scenario = scenario
        for output, each in zip(self._outputs, scenario.outputs, strict=True):
            output.exchange(each, self.index)
        for torque, signals in zip(self._torques, scenario.torque_disturbance, strict=True):
            torque.exchange(signals, self.index)
        self._error.exchange(scenario.torque_error, self.index)

    def step(self, torque: ArrayLike | None = None) -> Trajectories:
        """Measure at the present sample, move on to the next one, and return the present one.

        A torque, as in `run` but without the axis of the samples, replaces the excitations.
        """
        given = torque if torque is None or np.ndim(torque) == 0 else np.expand_dims(torque, -2)
        times, *arrays = self.run(1, given)
        return Trajectories(times[0], *(each[..., 0, :] for each in arrays))

    @np.errstate(all="ignore")  # a number may be too large for a sine
    def run(self, samples: int, torque: ArrayLike | None = None) -> Trajectories:
        """Step many times and return all samples; other Python threads can run meanwhile.

        Everything is kept: 104 bytes per run and sample of an arm with one output. A torque [N m],
        or the inputs of a T–S system, replace the excitations: a number, shape (samples, m) or
        (runs, samples, m).

        Raises:
            ModelError: The torque is not finite, or of another shape.
        """
        runs, scenario = len(self._seeds), self.scenario
        times = np.arange(self.index, self.index + samples) / scenario.rate
        inputs = np.empty((runs, samples, len(scenario.inputs)))
        for place, signal in enumerate(scenario.inputs):
            inputs[..., place] = signal.values(times)
        if torque is not None:
            commanded, given = inputs[..., : scenario.input_count], np.asarray(torque, np.float64)
            shapes = [commanded.shape[1:]] + [commanded.shape] * self._is_batch
            if given.shape not in ((), *shapes):
                expected = " or ".join(map(str, shapes))
                raise ModelError(f"torque: expected shape {expected}, got {given.shape}")
            commanded[:] = given
            wrong = ~np.isfinite(commanded).all(axis=(0, 2))
            if wrong.any():
                place = self.index + int(wrong.argmax())
                raise ModelError(f"torque of sample {place}: expected finite numbers")
        n, p, t = self._motion.states.shape[1], len(self._outputs), len(self._torques)
        kept = [np.empty((runs, samples, width)) for width in (n, p, p, inputs.shape[2], t)]
        block = 1 if self._fed_back else max(1, 5 * _BLOCK // (runs * self._motion.steps))
        for done in range(0, samples, block):
            now = np.s_[:, done : done + block]
            for whole, part in zip(kept, self._advance(inputs[now].copy()), strict=True):
                whole[now] = part
            self.index += whole[now].shape[1]
        one = [each if self._is_batch else each[0] for each in kept]
        design = scenario.to_design(one[0])
        return Trajectories(times, design, one[1], one[2], one[3], one[0], one[4])

    def _advance(self, inputs: Array) -> tuple[Array, ...]:
        """Move on over samples; return states, disturbances, measurements, inputs and torques."""
        motion, start, shape = self._motion, self.index, inputs.shape[:2]
        torques = np.empty((*shape, len(self._torques)))
        for side, disturbance in enumerate(self._torques):
            torques[..., side] = disturbance.values(start, shape[1])
        measured = {}
        for place, number in self._fed_back:
            measured[number] = self._outputs[number].measure(start, motion.present(number))
            value = measured[number][1][:, 0]
            self._held[:, number] = np.where(np.isfinite(value), value, self._held[:, number])
            inputs[:, 0, place] = self._held[:, number]
        applied = inputs.copy()
        if self._torques:
            applied[..., 0] = self._path.through(inputs[..., 0])
        states, truths = motion.move(start, applied, torques)
        for number, each in enumerate(self._outputs):
            if number not in measured:
                measured[number] = each.measure(start, np.ascontiguousarray(truths[..., number]))
        pairs = [measured[number] for number in range(len(self._outputs))]
        disturbances, measurements = (np.stack(each, axis=-1) for each in zip(*pairs, strict=True))
        if self._torques:
            error = self._error.values(start, shape[1])
            inputs[..., 0] += error
            torques[..., 0] -= self._error_path.through(error)
        return states, disturbances, measurements, inputs, torques
