# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the plant simulator node, and the scenarios that they describe.

The design or request file of a joint describes its arm or T–S system, its outputs with their noise,
and its process noise.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, make_dataclass
from functools import cached_property, partial
from itertools import islice
from typing import Any, TypeVar

import numpy as np

from tsobs_ros.checks import Array, finite, shown
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.errors import ModelError, ParameterError
from tsobs_ros.nodes.parameters import JointParameters
from tsobs_ros.plants import EFFORT_ERROR, TORQUES, request_in, scenario_of
from tsobs_ros.replay.csv_file import read_torques
from tsobs_ros.settings import live_setting, setting, values_of
from tsobs_ros.simulation.plant import Friction, Mismatch, Payload, Scenario, SystemScenario
from tsobs_ros.simulation.sensor import Sensor, sensor_numbers
from tsobs_ros.simulation.signals import EXCITATIONS, KINDS, Signal, parse_kinds, signal_of
from tsobs_ros.yaml_files import load_yaml

T = TypeVar("T")

Readers = Mapping[str, Callable[[Any], Any]]
"""Names that entries may use for one joint, each with the function that reads the value."""

_SHIPPED_STATE = (0.3, 0.0, 0.2, 0.0)
# A sample at a line's time gets this line's torque despite rounding errors up to this size [s].
_LATE = 1e-6


@dataclass(frozen=True)
class TorqueFile(Signal, kind="file"):
    """The torque of a CSV file with columns `time` and `torque`, held from line to line.

    The first line belongs to t = 0; after the time of the last line, the torque is 0.

    Raises:
        ModelError: There is no path.
        LogError: The file cannot be used.
    """

    file: str = ""
    _lines: tuple[Array, Array] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.file:
            raise ModelError("file: expected a CSV file of time and torque")
        object.__setattr__(self, "_lines", read_torques(self.file))

    def values(self, times: Array) -> Array:
        starts, torques = self._lines
        places = np.searchsorted(starts, times + _LATE, side="right") - 1
        is_on = (places >= 0) & (times <= starts[-1] + _LATE)
        return np.where(is_on, torques[places], 0.0)


PLAYED: Mapping[str, type[Signal]] = {**EXCITATIONS, TorqueFile.kind: TorqueFile}
"""All kinds of input signals that the node can play, by name."""


def _kinds(name: str, kind: str, kinds: Mapping[str, type[Signal]], **others: str) -> type:
    """Return a dataclass of settings: a kind, the numbers of each kind, and others."""
    groups = [
        (each.kind, each, field(default_factory=each)) for each in kinds.values() if fields(each)
    ]
    more = [(other, str, value) for other, value in others.items()]
    return make_dataclass(name, [("kind", str, kind), *groups, *more], frozen=True)


_DISTURBANCE = _kinds(
    "Disturbance",
    live_setting(
        "none",
        f"none, or a sum of {', '.join(KINDS)}, such as bias_step+sinusoid; changing it injects a "
        "fault",
    ),
    KINDS,
)
_EXCITATION = _kinds(
    "Excitation",
    live_setting("sine", "Torque signal", choices=tuple(PLAYED)),
    EXCITATIONS,
    file=live_setting(
        "",
        "CSV file for the kind file, such as one of tsobs excite: columns time [s] and torque "
        "[N m], held from line to line; 0 after the last one",
    ),
)


@dataclass(frozen=True)
class PlantSimulatorParameters(JointParameters):
    """All parameters of the node; `design` and `joint_designs` may name requests, too.

    Attributes:
        files: What was read of the files that parameters name; others may change without reading.

    Raises:
        TsobsError: They do not describe a plant, or a file cannot be used.
    """

    rate: float = setting(
        0.0, "Samples per second; 0: the design's", unit="Hz", minimum=0.0, maximum=5000.0
    )
    seed: int = live_setting(0, "Seed of everything random, used from the next reset on", minimum=0)
    duration: float = setting(
        0.0,
        "Simulated time after which the process ends; 0: never",
        unit="s",
        minimum=0.0,
        maximum=1e9,
    )
    wait_for_subscribers: int = setting(
        0, "Subscriptions of joint_measurements to wait for before t = 0", minimum=0
    )
    wait_timeout: float = setting(
        10.0, "Longest wait for subscribers, then start anyway; 0: no limit", unit="s", minimum=0.0
    )
    publish_clock: bool = setting(False, "Drive /clock with the simulated time")
    real_time_factor: float = setting(
        1.0, "Pace of the simulated time when publish_clock is set", minimum=0.001, maximum=1000.0
    )
    command_timeout: float = live_setting(
        0.5,
        "How long a torque command holds; 0: until the next one",
        unit="s",
        minimum=0.0,
        maximum=1e9,
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
        "Changes of single joints in place of `mismatch`, such as 'elbow/stiffness: 0.2'; for a "
        "T-S system the true value of an uncertain parameter",
    )
    friction: Friction = field(default_factory=Friction)
    payload: Payload = field(default_factory=Payload)
    process_noise_factor: float = setting(
        1.0, "Factor on the designed densities of the process noise", minimum=0.0
    )
    excitation: Any = field(default_factory=_EXCITATION)
    disturbance: Any = field(default_factory=_DISTURBANCE)
    signals: tuple[str, ...] = live_setting(
        (),
        "Signals of single outputs, torques, inputs and efforts, such as "
        "'elbow/link_torque: {kind: bias_step, amplitude: 2.0, start: 5.0}', and numbers of single "
        "sensors, such as 'elbow/motor_angle: {dropout_interval: 10.0}'",
    )
    noise_factor: float = live_setting(
        1.0, "Factor on the designed standard deviation of the noise", minimum=0.0
    )
    sensor: Sensor = field(default_factory=Sensor)
    files: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "files", dict(self.files))
        _ = self.scenarios

    def _kept(self, what: str, named: Any, read: Callable[[], T]) -> T:
        """Return what was read before if it was named by equal parameters, else read it."""
        if what not in self.files or self.files[what][0] != named:
            self.files[what] = named, read()
        found: T = self.files[what][1]
        return found

    @cached_property
    def requests(self) -> dict[str, ArmRequest | TSRequest]:
        """The request of each joint."""
        return self._kept("requests", self.design_of, partial(self.read, request_in))

    @property
    def sample_rate(self) -> float:
        """Sample rate of all joints [Hz]: `rate`, or else the fastest rate of their designs."""
        return self.rate or max(request.rate for request in self.requests.values())

    @cached_property
    def scenarios(self) -> dict[str, Scenario | SystemScenario]:
        """The scenarios that the parameters describe, by joint.

        Raises:
            ModelError: They do not describe a plant.
            ParameterError: An entry of a list names no signal of the joints.
        """
        named = self.signals, self.design_of
        signals = self._kept("signals", named, partial(self._by_joint, "signals", _signals))
        excitation = self._kept("excitation", self.excitation, self._excitation)
        changes = self._by_joint("joint_mismatch", _changes)
        states = self._initial_states()
        return {
            joint: self._scenario(
                request, excitation, changes[joint], signals[joint], states[joint]
            )
            for joint, request in self.requests.items()
        }

    def _scenario(
        self,
        request: ArmRequest | TSRequest,
        excitation: Signal,
        changes: Mapping[str, list[float]],
        signals: Mapping[str, list[Any]],
        state: tuple[float, ...],
    ) -> Scenario | SystemScenario:
        """Return the scenario of one joint: its request's, with the changes by parameters."""
        mismatch = {name: each[-1] for name, each in changes.items()}
        others: dict[str, Any] = {"rate": self.sample_rate, "duration": self.duration}
        if isinstance(request, ArmRequest):
            mismatch = asdict(self.mismatch) | mismatch
            others |= {"friction": self.friction, "payload": self.payload}
        kinds = parse_kinds(self.disturbance.kind)
        faults = [values_of(self.sensor), *(getattr(self.disturbance, kind) for kind in kinds)]
        of_outputs = {name: [*faults, *signals.get(name, ())] for name in request.output_names}
        return scenario_of(
            request,
            mismatch,
            initial_state=state,
            excitation=excitation,
            signals={**signals, **of_outputs},
            noise_factor=self.noise_factor,
            process_noise_factor=self.process_noise_factor,
            **others,
        )

    def _excitation(self) -> Signal:
        found: Signal | str = getattr(self.excitation, self.excitation.kind, Signal())
        return TorqueFile(found) if isinstance(found, str) else found

    def _initial_states(self) -> dict[str, tuple[float, ...]]:
        sizes = {joint: len(each.state_names) for joint, each in self.requests.items()}
        values = self.initial_state
        if not values:
            paths = self.design_of
            return {j: (0.0,) * n if paths[j] else _SHIPPED_STATE for j, n in sizes.items()}
        if len(values) != sum(sizes.values()):
            expected = " + ".join(map(str, sizes.values()))
            raise ModelError(f"initial_state: expected {expected} numbers, got {len(values)}")
        numbers = iter(values)
        return {joint: tuple(islice(numbers, size)) for joint, size in sizes.items()}

    def _by_joint(
        self, parameter: str, known: Callable[[ArmRequest | TSRequest], Readers]
    ) -> dict[str, dict[str, list[Any]]]:
        """Return the values of a list parameter, by joint and by the name in the entry.

        A list in ROS parameters holds plain values only, so each entry is a line of YAML, such as
        "elbow/motor_angle: {kind: ramp}"; without "elbow/" it is for all joints with this name.

        Raises:
            ParameterError: An entry is malformed, or no joint has its name.
        """
        readers = {joint: known(request) for joint, request in self.requests.items()}
        found: dict[str, dict[str, list[Any]]] = {joint: {} for joint in readers}
        for place, line in enumerate(getattr(self, parameter)):
            where = f"parameter '{parameter}[{place}]'"
            try:
                entry: Any = load_yaml(line)
                ((target, value),) = entry.items()
            except (AttributeError, ValueError) as error:
                raise ParameterError(
                    f"{where}: expected 'name: value', got {shown(line)}"
                ) from error
            joint, _, name = str(target).rpartition("/")
            joints = [each for each in found if name in readers[each] and joint in ("", each)]
            if not joints:
                names = ", ".join(f"{each}/{one}" for each in found for one in readers[each])
                raise ParameterError(f"{where}: expected one of {names}, got {str(target)!r}")
            try:
                for each in joints:
                    found[each].setdefault(name, []).append(readers[each][name](value))
            except (ModelError, ValueError) as error:
                raise ParameterError(f"{where}: {target}: {error}") from error
        return found


def _signals(request: ArmRequest | TSRequest) -> Readers:
    """Return the names that entries of `signals` may use for a joint."""
    known: dict[str, Callable[[Any], Any]] = {}
    known |= dict.fromkeys(request.input_names, partial(signal_of, PLAYED))
    if isinstance(request, ArmRequest):
        known |= dict.fromkeys([*TORQUES, EFFORT_ERROR], partial(signal_of, KINDS))
    # If an output is an input too, an entry disturbs its measured value.
    return known | dict.fromkeys(request.output_names, _fault)


def _fault(entry: Any) -> Any:
    """Return the signal of an output or, from an entry without a kind, its sensor's numbers."""
    is_sensor = isinstance(entry, dict) and "kind" not in entry
    return sensor_numbers(entry) if is_sensor else signal_of(KINDS, entry)


def _changes(request: ArmRequest | TSRequest) -> Readers:
    """Return the names that entries of `joint_mismatch` may use for a joint."""
    is_arm = isinstance(request, ArmRequest)
    names = [e.name for e in fields(Mismatch)] if is_arm else request.uncertainty_model.names
    return dict.fromkeys(names, partial(finite, "value"))
