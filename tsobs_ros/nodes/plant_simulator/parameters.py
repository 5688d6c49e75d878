# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the plant simulator node, and the scenarios they describe.

A joint is what its design or request file says: its arm or T–S system, its outputs and their noise,
its process noise.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tsobs_ros.checks import Array, finite, shown
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.errors import ModelError, ParameterError, TsobsError
from tsobs_ros.model.arm import SIDES
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.nodes.parameters import JointParameters
from tsobs_ros.plants import request_in, scenario_of
from tsobs_ros.replay.csv_file import TorqueSeries, read_torques
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.schema import decode
from tsobs_ros.settings import live_setting, setting
from tsobs_ros.simulation.integrator import Friction, Payload
from tsobs_ros.simulation.plant import Mismatch, Scenario, TorqueDisturbance
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import (
    EXCITATIONS,
    KINDS,
    BiasStep,
    Chirp,
    Constant,
    GaussMarkov,
    Multisine,
    NoTorque,
    Pulses,
    Ramp,
    Signal,
    Sine,
    Sinusoid,
    Square,
    StuckSensor,
    parse_kinds,
    signal_of,
)
from tsobs_ros.simulation.systems import SystemScenario
from tsobs_ros.yaml_files import load_yaml

T = TypeVar("T")

Readers = Mapping[str, Callable[[Any], Any]]
"""What an entry may name of one joint, each with the function that reads the entry's value."""

_TORQUES = {side: f"{side}_torque" for side in SIDES}
"""What entries of `signals` call the torque disturbance of each side."""
_EFFORT_ERROR = "effort_error"
_SHIPPED_STATE = (0.3, 0.0, 0.2, 0.0)
# A sample at a line's time gets this line's torque, whatever their last bits are [s].
_LATE = 1e-6


def read_once(reader: Callable[[Path], T], path: str) -> T:
    """Return what a file has; it is read again after it has changed, and not for each parameter.

    Raises:
        ParameterError: It cannot be used: a parameter may be refused for it, but not end a node.
    """
    file = Path(path)
    try:
        found: T = _read(reader, file, file.stat().st_mtime_ns if file.exists() else 0)
    except TsobsError as error:
        raise ParameterError(str(error)) from error
    return found


@lru_cache(maxsize=64)
def _read(reader: Callable[[Path], Any], path: Path, _modified: int) -> Any:
    return reader(path)


@dataclass(frozen=True)
class TorqueFile(Signal, kind="file"):
    """The torque of a CSV file with columns `time` and `torque`, held from line to line.

    The first line belongs to t = 0; after the last one's time the torque is 0.

    Raises:
        ModelError: There is no path.
        ParameterError: The file cannot be used.
    """

    file: str = ""
    _series: TorqueSeries = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.file:
            raise ModelError("file: expected a CSV file of time and torque")
        object.__setattr__(self, "_series", read_once(read_torques, self.file))

    def _at(self, times: Array) -> Array:
        series = self._series
        places = np.searchsorted(series.time, times + _LATE, side="right") - 1
        is_on = (places >= 0) & (times <= series.time[-1] + _LATE)
        return np.where(is_on, series.torque[places], 0.0)


PLAYED: Mapping[str, type[Signal]] = {**EXCITATIONS, TorqueFile.kind: TorqueFile}
"""Every kind of signal of an input that the node can play, under its name."""


@dataclass(frozen=True)
class DisturbanceParameters:
    """What sensors add to the true values, noise excepted."""

    kind: str = live_setting(
        "none",
        f"none, or a sum of {', '.join(KINDS)}, such as bias_step+sinusoid; changing it injects a "
        "fault",
    )
    bias_step: BiasStep = field(default_factory=BiasStep)
    sinusoid: Sinusoid = field(default_factory=Sinusoid)
    ramp: Ramp = field(default_factory=Ramp)
    gauss_markov: GaussMarkov = field(default_factory=GaussMarkov)
    stuck: StuckSensor = field(default_factory=StuckSensor)
    pulses: Pulses = field(default_factory=Pulses)

    def build(self) -> tuple[Signal, ...]:
        """Return the components of the chosen kinds."""
        return tuple(getattr(self, name) for name in parse_kinds(self.kind))


@dataclass(frozen=True)
class ExcitationParameters:
    """The torque in the absence of a command."""

    kind: str = live_setting("sine", "Torque signal", choices=tuple(PLAYED))
    constant: Constant = field(default_factory=Constant)
    sine: Sine = field(default_factory=Sine)
    multisine: Multisine = field(default_factory=Multisine)
    square: Square = field(default_factory=Square)
    chirp: Chirp = field(default_factory=Chirp)
    file: str = live_setting(
        "",
        "CSV file of the kind file, such as that of tsobs excite: columns time [s] and torque "
        "[N m], held from line to line; 0 after the last one",
    )

    def build(self) -> Signal:
        """Return the signal of the chosen kind."""
        if self.kind == TorqueFile.kind:
            return TorqueFile(self.file)
        chosen: Signal = getattr(self, self.kind, NoTorque())
        return chosen


@dataclass(frozen=True)
class PlantSimulatorParameters(JointParameters):
    """All parameters of the node; `design` and `joint_designs` may name requests, too.

    Raises:
        ParameterError: They do not describe a plant.
    """

    rate: float = setting(
        0.0, "Samples a second; 0: the design's", unit="Hz", minimum=0.0, maximum=5000.0
    )
    seed: int = live_setting(0, "Seed of everything random, used from the next reset on", minimum=0)
    duration: float = setting(
        0.0, "Simulated time after which the process ends; 0: never", unit="s", minimum=0.0
    )
    wait_for_subscribers: int = setting(
        0, "Subscriptions of joint_measurements to wait for before t = 0", minimum=0
    )
    wait_timeout: float = setting(
        10.0, "Longest wait for them, then start anyway; 0: no limit", unit="s", minimum=0.0
    )
    publish_clock: bool = setting(False, "Drive /clock with the simulated time")
    real_time_factor: float = setting(
        1.0,
        "Pace of the simulated time when publish_clock is set",
        minimum=0.001,
        maximum=1000.0,
    )
    command_timeout: float = live_setting(
        0.5, "How long a torque command holds; 0: until the next one", unit="s", minimum=0.0
    )
    torque_limit: float = live_setting(
        100.0, "Commands of arms saturate at plus and minus this torque", unit="N m", minimum=0.0
    )
    initial_state: tuple[float, ...] = setting(
        (),
        "Link angle, link velocity, motor angle, motor velocity at t = 0 (rad, rad/s), or the "
        "states of a T-S system, of all joints in turn; none: 0, and 0.3, 0, 0.2, 0 of the shipped "
        "arm",
        element=float,
    )
    mismatch: Mismatch = field(default_factory=Mismatch)
    joint_mismatch: tuple[str, ...] = setting(
        (),
        "Changes of single joints in place of `mismatch`, such as 'elbow/stiffness: 0.2'; of a T-S "
        "system the true value of an uncertain parameter",
    )
    friction: Friction = field(default_factory=Friction)
    payload: Payload = field(default_factory=Payload)
    process_noise_factor: float = setting(
        1.0, "What multiplies the designed densities of the process noise", minimum=0.0
    )
    excitation: ExcitationParameters = field(default_factory=ExcitationParameters)
    disturbance: DisturbanceParameters = field(default_factory=DisturbanceParameters)
    signals: tuple[str, ...] = live_setting(
        (),
        "Signals of single outputs, torques, inputs and efforts, such as "
        "'elbow/link_torque: {kind: bias_step, amplitude: 2.0, start: 5.0}', and numbers of single "
        "sensors, such as 'elbow/motor_angle: {dropout_interval: 10.0}'",
    )
    noise_factor: float = live_setting(
        1.0, "What multiplies the designed standard deviation of the noise", minimum=0.0
    )
    sensor: Sensor = field(default_factory=Sensor)

    def __post_init__(self) -> None:
        self.scenarios()

    @cached_property
    def requests(self) -> dict[str, ArmRequest | TSRequest]:
        """What describes each joint."""
        shipped = str(config_path(SHIPPED_DESIGN))
        return {
            joint: read_once(request_in, path or shipped) for joint, path in self.design_of.items()
        }

    @property
    def sample_rate(self) -> float:
        """Samples a second of all joints [Hz]: `rate`, or the design's; of several the fastest."""
        return self.rate or max(request.rate for request in self.requests.values())

    def scenarios(self) -> dict[str, Scenario | SystemScenario]:
        """Return what the parameters describe, by joint.

        Raises:
            ModelError: They do not describe a plant.
            ParameterError: An entry of a list names no signal of the joints.
        """
        requests = self.requests
        given, changes = (
            by_joint(name, getattr(self, name), {j: known(each) for j, each in requests.items()})
            for name, known in (("signals", _signals), ("joint_mismatch", _changes))
        )
        states = self._initial_states()
        return {
            joint: self._scenario(
                request,
                {name: each[-1] for name, each in changes[joint].items()},
                given[joint],
                states[joint],
            )
            for joint, request in requests.items()
        }

    def _scenario(
        self,
        request: ArmRequest | TSRequest,
        changes: dict[str, float],
        signals: Mapping[str, list[Any]],
        state: tuple[float, ...],
    ) -> Scenario | SystemScenario:
        """Return the scenario of one joint: that of its request, with what parameters change."""
        if isinstance(request, ArmRequest):
            changes = asdict(self.mismatch) | changes
        base, factor, outputs = scenario_of(request, changes), self.process_noise_factor, []
        for output in base.measured:
            numbers = asdict(self.sensor)
            numbers["noise_std"] = output.sensor.noise_std * self.noise_factor
            disturbance = self.disturbance.build()
            for each in signals.get(output.measures, ()):
                if isinstance(each, Signal):
                    disturbance += (each,)
                else:
                    numbers |= each
            outputs.append(replace(output, sensor=Sensor(**numbers), disturbance=disturbance))
        count = base.input_count
        free = (self.excitation.build(),) * count + base.moved_by[count:]
        inputs = tuple(
            signals[name][-1] if name in signals and name not in request.output_names else default
            for name, default in zip(request.input_names, free, strict=True)
        )
        own: dict[str, Any] = {
            "rate": self.sample_rate, "duration": self.duration, "outputs": tuple(outputs)
        }  # fmt: skip
        if isinstance(base, SystemScenario):
            noise = np.asarray(base.process_noise) * factor
            return replace(base, **own, initial_state=state, process_noise=noise, inputs=inputs)
        density = base.process_noise
        return replace(
            base,
            **own,
            initial_state=tuple(base.arm.from_physical(state).tolist()),
            initial_spread=(0.0,) * 4,
            process_noise=ProcessNoise(density.link * factor, density.motor * factor),
            friction=self.friction,
            payload=self.payload,
            excitation=inputs[0],
            torque_disturbance=TorqueDisturbance(
                **{side: tuple(signals.get(name, ())) for side, name in _TORQUES.items()}
            ),
            torque_error=tuple(signals.get(_EFFORT_ERROR, ())),
        )

    def _initial_states(self) -> dict[str, tuple[float, ...]]:
        values, sizes = self.initial_state, [len(e.state_names) for e in self.requests.values()]
        if not values:
            return {
                joint: (0.0,) * size if path else _SHIPPED_STATE
                for (joint, path), size in zip(self.design_of.items(), sizes, strict=True)
            }
        if len(values) != sum(sizes):
            expected = " + ".join(map(str, sizes))
            raise ModelError(f"initial_state: expected {expected} numbers, got {len(values)}")
        numbers = iter(values)
        return {j: tuple(islice(numbers, n)) for j, n in zip(self.requests, sizes, strict=True)}


def _signals(request: ArmRequest | TSRequest) -> Readers:
    """Return what entries of `signals` may name of a joint."""
    known: dict[str, Callable[[Any], Any]] = {}
    known |= dict.fromkeys(request.input_names, partial(signal_of, PLAYED))
    if isinstance(request, ArmRequest):
        known |= dict.fromkeys([*_TORQUES.values(), _EFFORT_ERROR], partial(signal_of, KINDS))
    # The measured value of an output that is an input, too, is disturbed.
    return known | dict.fromkeys(request.output_names, _fault)


def _fault(entry: Any) -> Signal | dict[str, Any]:
    """Return a signal of an output, or numbers of its sensor, of an entry without a kind."""
    if isinstance(entry, dict) and "kind" not in entry:
        sensor = decode(entry, Sensor)
        return {name: getattr(sensor, name) for name in entry}
    signal: Signal = signal_of(KINDS, entry)
    return signal


def _changes(request: ArmRequest | TSRequest) -> Readers:
    """Return what entries of `joint_mismatch` may name of a joint."""
    names: Collection[str] = [each.name for each in fields(Mismatch)]
    if isinstance(request, TSRequest):
        names = request.uncertainty_model.names
    return dict.fromkeys(names, partial(finite, "value"))


def by_joint(
    parameter: str, lines: Iterable[str], readers: Mapping[str, Readers]
) -> dict[str, dict[str, list[Any]]]:
    """Return the values of a list parameter by joint and by what they are about.

    ROS parameters hold lists of texts only, so an entry is a line of YAML:
    "elbow/motor_angle: {kind: ramp}"; without "elbow/" it is for all joints that have one.

    Raises:
        ParameterError: An entry is malformed, or names none of them.
    """
    found: dict[str, dict[str, list[Any]]] = {joint: {} for joint in readers}
    for place, line in enumerate(lines):
        where = f"parameter '{parameter}[{place}]'"
        try:
            data: Any = load_yaml(line)
            ((target, value),) = data.items()
        except (AttributeError, ValueError) as error:
            raise ParameterError(f"{where}: expected 'name: value', got {shown(line)}") from error
        joint, _, name = str(target).rpartition("/")
        joints = [each for each in found if name in readers[each] and joint in ("", each)]
        if not joints:
            known = ", ".join(f"{each}/{one}" for each in found for one in readers[each])
            raise ParameterError(f"{where}: expected one of {known}, got {str(target)!r}")
        try:
            for each in joints:
                found[each].setdefault(name, []).append(readers[each][name](value))
        except (ModelError, ValueError) as error:
            raise ParameterError(f"{where}: {target}: {error}") from error
    return found
