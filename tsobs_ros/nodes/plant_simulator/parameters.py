# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the plant simulator node, and the scenarios they describe.

A joint with a design file is what that says: its arm or T–S system, its outputs and their noise,
its process noise. A joint without is the one arm of the parameters, with an encoder on its link.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from tsobs_ros.checks import finite
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.errors import ModelError, ParameterError, TsobsError
from tsobs_ros.model.arm import SIDES, ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.nodes.parameters import ManagedParameters, design_paths
from tsobs_ros.nodes.plant_simulator.entries import PLAYED, Readers, TorqueFile, by_joint
from tsobs_ros.plants import request_in, scenario_of
from tsobs_ros.settings import live_setting, setting, settings_group
from tsobs_ros.simulation.integrator import Friction, Payload
from tsobs_ros.simulation.plant import Mismatch, Scenario, TorqueDisturbance
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import (
    EXCITATIONS,
    KINDS,
    BiasStep,
    GaussMarkov,
    Pulses,
    Ramp,
    Signal,
    Sinusoid,
    StuckSensor,
    TwoTone,
    numbers_of,
    parse_kinds,
    signal_of,
)
from tsobs_ros.simulation.systems import SystemScenario

_ARM = {
    "link_inertia": (1.0, "Link inertia J1", "kg m^2"),
    "motor_inertia": (2.0, "Motor inertia J2", "kg m^2"),
    "stiffness": (10.0, "Joint stiffness k", "N m/rad"),
    "gravity_torque": (10.0, "Torque mgl that holds the link horizontal", "N m"),
    "link_damping": (0.0, "Link damping b1", "N m s/rad"),
    "motor_damping": (0.0, "Motor damping b2", "N m s/rad"),
}
"""Default, description and unit of each parameter of an arm."""
_TORQUES = {side: f"{side}_torque" for side in SIDES}
"""What entries of `signals` call the torque disturbance of each side."""


def _numbers(
    kind: type[Signal], unit: str = "rad", live: bool = True, **defaults: float
) -> dict[str, Any]:
    """Return a signal's numbers as settings; its values have the unit."""
    units = {"": unit, "1/s": f"{unit}/s"}
    return {
        name: setting(
            defaults.get(name, number.default),
            number.description,
            unit=units.get(number.unit, number.unit),
            # What must be above a bound is checked by the signal.
            minimum=None if number.above else number.minimum,
            live=live,
        )
        for name, number in numbers_of(kind).items()
    }


@dataclass(frozen=True)
class DisturbanceParameters:
    """What the sensor adds to the angle besides white noise."""

    kind: str = live_setting(
        "none",
        f"none, or a sum of {', '.join(KINDS)}, such as bias_step+sinusoid; changing it injects a "
        "fault",
    )
    bias_step: BiasStep = settings_group(BiasStep, **_numbers(BiasStep))
    sinusoid: Sinusoid = settings_group(Sinusoid, **_numbers(Sinusoid))
    ramp: Ramp = settings_group(Ramp, **_numbers(Ramp))
    two_tone: TwoTone = settings_group(TwoTone, **_numbers(TwoTone))
    gauss_markov: GaussMarkov = settings_group(GaussMarkov, **_numbers(GaussMarkov))
    stuck: StuckSensor = settings_group(
        StuckSensor,
        start=live_setting(0.0, "Start, counted from when it was put in", unit="s"),
        duration=live_setting(1.0, "How long; 0 for ever", unit="s", minimum=0.0),
    )
    pulses: Pulses = settings_group(Pulses, **_numbers(Pulses))

    def build(self) -> tuple[Signal, ...]:
        """Return the components of the chosen kinds."""
        ever = replace(self.stuck, duration=self.stuck.duration or math.inf)
        return tuple(
            ever if name == "stuck" else getattr(self, name) for name in parse_kinds(self.kind)
        )


@dataclass(frozen=True)
class ExcitationParameters:
    """The torque in the absence of a command."""

    kind: str = live_setting("sine", "Torque signal", choices=tuple(PLAYED))
    amplitude: float = live_setting(1.0, "Amplitude; of a multisine, of all its tones", unit="N m")
    frequency: float = live_setting(1.0, "Frequency of sine and square", unit="rad/s")
    lowest: float = live_setting(0.5, "Lowest frequency of multisine and chirp", unit="rad/s")
    highest: float = live_setting(6.0, "Highest frequency of multisine and chirp", unit="rad/s")
    tones: int = live_setting(8, "Tones of a multisine", minimum=1, maximum=1000)
    sweep: float = live_setting(20.0, "Length of a chirp's sweep", unit="s")
    file: str = live_setting(
        "",
        "CSV file of the kind file, such as that of tsobs excite: columns time [s] and torque "
        "[N m], held from line to line; 0 after the last one",
    )

    def build(self) -> Signal:
        """Return the excitation; every kind is checked, the chosen one is returned."""
        signals: dict[str, Signal] = {
            name: kind(**{number: getattr(self, number) for number in numbers_of(kind)})
            for name, kind in EXCITATIONS.items()
        }
        return TorqueFile(self.file) if self.kind == TorqueFile.kind else signals[self.kind]


@dataclass(frozen=True)
class OutlierParameters:
    """Samples that are far off."""

    probability: float = live_setting(0.0, "Probability of an outlier", minimum=0.0, maximum=1.0)
    size: float = live_setting(1.0, "What an outlier adds, with either sign", unit="rad")
    uniform: bool = live_setting(False, "Outliers of any size up to this one")


@dataclass(frozen=True)
class NoiseParameters:
    """What makes the measurement noise other than white, normal and as designed."""

    factor: float = live_setting(1.0, "What multiplies its standard deviation", minimum=0.0)
    time_constant: float = live_setting(
        0.0, "Time constant of its correlation; 0: white", unit="s", minimum=0.0
    )
    degrees_of_freedom: int = live_setting(
        0, "Of Student's t, which noise_std multiplies; 0: normal", minimum=0, maximum=1000
    )
    burst_interval: float = live_setting(
        0.0, "Time between the beginnings of bursts; 0 for none", unit="s", minimum=0.0
    )
    burst_duration: float = live_setting(1.5, "Length of a burst", unit="s", minimum=0.0)
    burst_factor: float = live_setting(4.0, "What multiplies the noise in a burst", minimum=0.0)


@dataclass(frozen=True)
class PayloadParameters:
    """What arms carry for a while."""

    joints: tuple[str, ...] = setting((), "Arms that carry it; none: all of them")
    mass: float = setting(0.0, "Mass of the payload", unit="kg", minimum=0.0)
    distance: float = setting(0.0, "Its distance from the axis", unit="m", minimum=0.0)
    start: float = setting(0.0, "When it is put on", unit="s", minimum=0.0)
    duration: float = setting(0.0, "How long it is carried; 0: for ever", unit="s", minimum=0.0)

    def build(self) -> Payload:
        """Return the payload of one arm."""
        return Payload.point(self.mass, self.distance, self.start, self.duration or math.inf)


@dataclass(frozen=True)
class DropoutParameters:
    """Samples that are not published."""

    interval: float = live_setting(
        0.0, "Time between the beginnings of dropouts; 0 for none", unit="s", minimum=0.0
    )
    duration: float = live_setting(0.5, "Length of a dropout", unit="s", minimum=0.0)


@dataclass(frozen=True)
class ProcessNoiseParameters:
    """Random accelerations."""

    link_acceleration_density: float = setting(
        1e-4, "White acceleration of the link", unit="rad^2/s^3", minimum=0.0
    )
    motor_acceleration_density: float = setting(
        1e-5, "White acceleration of the motor", unit="rad^2/s^3", minimum=0.0
    )
    factor: float = setting(
        1.0, "What multiplies these densities, and those of design files", minimum=0.0
    )


@dataclass(frozen=True)
class PlantSimulatorParameters(ManagedParameters):
    """All parameters of the node.

    Raises:
        ParameterError: They do not describe a plant.
    """

    joint: str = setting("elastic_joint", "Name of the joint if `joints` has none")
    joints: tuple[str, ...] = setting((), "Names of the joints, or none for one, `joint`")
    design: str = setting(
        "",
        "Design or request file of the joints; empty for the arm of the parameters `arm.*`, with "
        "an encoder on its link",
    )
    joint_designs: tuple[str, ...] = setting(
        (), "Such a file for each of `joints`, empty for that of `design`; no list: that for all"
    )
    rate: float = setting(
        0.0,
        "Samples a second; 0: the design's, 200 without one",
        unit="Hz",
        minimum=0.0,
        maximum=5000.0,
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
        100.0, "Commands saturate at plus and minus this torque", unit="N m", minimum=0.0
    )
    initial_state: tuple[float, ...] = setting(
        (0.3, 0.0, 0.2, 0.0),
        "Link angle, link velocity, motor angle, motor velocity at t = 0 (rad, rad/s), or the "
        "states of a T-S system; of one joint for all, or of all joints in turn. With the default, "
        "joints with a design file start at 0",
    )
    initial_spread: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0, 0.0), "Standard deviation of each of them (rad, rad/s)", minimum=0.0
    )
    noise_std: float = live_setting(
        0.028,
        "Standard deviation of the measurement noise of joints without a design file",
        unit="rad",
        minimum=0.0,
    )
    latency: float = live_setting(
        0.0,
        "Age of the measured angle at its stamp, in whole samples",
        unit="s",
        minimum=0.0,
        maximum=1.0,
    )
    resolution: float = live_setting(
        0.0, "Step of the measured angle; 0: none", unit="rad", minimum=0.0
    )
    arm: ElasticJointArm = settings_group(
        ElasticJointArm,
        **{name: setting(value, what, unit=unit) for name, (value, what, unit) in _ARM.items()},
    )
    mismatch: Mismatch = settings_group(
        Mismatch,
        **{
            name: setting(0.0, f"{what}: relative change; 0.2 is 20 % more")
            for name, (_, what, _) in _ARM.items()
        },
    )
    joint_mismatch: tuple[str, ...] = setting(
        (),
        "Changes of single joints in place of `mismatch`, such as 'elbow/stiffness: 0.2'; of a T-S "
        "system the true value of an uncertain parameter",
    )
    friction: Friction = settings_group(
        Friction,
        **{
            f"{side}_{kind}": setting(0.0, f"{kind.capitalize()} friction of the {side}", unit=unit)
            for side in ("link", "motor")
            for kind, unit in (("viscous", "N m s/rad"), ("coulomb", "N m"))
        },
    )
    payload: PayloadParameters = settings_group(PayloadParameters)
    process_noise: ProcessNoiseParameters = settings_group(ProcessNoiseParameters)
    excitation: ExcitationParameters = settings_group(ExcitationParameters)
    disturbance: DisturbanceParameters = settings_group(DisturbanceParameters)
    signals: tuple[str, ...] = live_setting(
        (),
        "Signals of single outputs, torques and inputs, such as "
        "'elbow/link_torque: {kind: bias_step, amplitude: 2.0, start: 5.0}'",
    )
    affected: tuple[str, ...] = live_setting(
        (),
        "Outputs, as <joint>/<output>, that latency, resolution, disturbance, noise, outliers and "
        "dropouts act on; none: all of them",
    )
    noise: NoiseParameters = settings_group(NoiseParameters)
    outliers: OutlierParameters = settings_group(OutlierParameters)
    dropouts: DropoutParameters = settings_group(DropoutParameters)
    effort_error: Pulses = settings_group(
        Pulses,
        **_numbers(
            Pulses, "N m", live=False, amplitude=0.0, start=30.0, duration=0.005, interval=0.0
        ),
    )

    def __post_init__(self) -> None:
        if not self.joint:
            raise ParameterError("parameter 'joint' must not be empty")
        for joint in self.payload.joints:
            if not isinstance(self.requests.get(joint), ArmRequest):
                raise ParameterError(f"payload.joints: expected arms of the node, got '{joint}'")
        self.scenarios()

    @property
    def design_of(self) -> dict[str, str]:
        """Path of each joint's design file, empty for the arm of the parameters."""
        return design_paths(self.joints or (self.joint,), self.joint_designs, self.design)

    @cached_property
    def requests(self) -> dict[str, ArmRequest | TSRequest]:
        """What describes each joint; one without a file is the arm of the parameters."""
        noise = self.process_noise
        arm = ArmRequest(
            arm=self.arm,
            process_noise=ProcessNoise(
                link=noise.link_acceleration_density, motor=noise.motor_acceleration_density
            ),
            uncertainty={},
        )
        return {joint: _request(path) if path else arm for joint, path in self.design_of.items()}

    @property
    def sample_rate(self) -> float:
        """Samples a second of all joints [Hz]: `rate`, or the design's; of several the fastest."""
        return self.rate or max(request.rate for request in self.requests.values())

    def _sensor(self, noise_std: float) -> Sensor:
        """Return the sensor of an output with a standard deviation of its noise."""
        noise, outliers, dropouts = self.noise, self.outliers, self.dropouts
        return Sensor(
            noise_std=noise_std * noise.factor,
            outlier_probability=outliers.probability,
            outlier_size=outliers.size,
            outlier_is_uniform=outliers.uniform,
            dropout_interval=dropouts.interval,
            dropout_duration=dropouts.duration,
            noise_time_constant=noise.time_constant,
            noise_degrees=noise.degrees_of_freedom,
            burst_interval=noise.burst_interval,
            burst_duration=noise.burst_duration,
            burst_factor=noise.burst_factor,
            latency=self.latency,
            resolution=self.resolution,
        )

    def scenarios(self) -> dict[str, Scenario | SystemScenario]:
        """Return what the parameters describe, by joint.

        Raises:
            ModelError: They do not describe a plant.
            ParameterError: An entry of a list names no signal of the joints.
        """
        signals: dict[str, Readers] = {}
        changes: dict[str, Readers] = {}
        outputs: dict[str, Readers] = {}
        for joint, request in self.requests.items():
            is_arm = isinstance(request, ArmRequest)
            disturbed = (*request.output_names, *(_TORQUES.values() if is_arm else ()))
            signals[joint] = {
                name: partial(signal_of, KINDS if name in disturbed else PLAYED)
                for name in (*request.output_names, *request.input_names, *disturbed)
            }
            names = _ARM if is_arm else request.uncertainty_model.names
            changes[joint] = {name: partial(finite, "value") for name in names}
            outputs[joint] = dict.fromkeys(request.output_names, bool)
        given = by_joint("signals", self.signals, signals)
        changed = by_joint("joint_mismatch", self.joint_mismatch, changes)
        affected = by_joint("affected", [f"{name}: true" for name in self.affected], outputs)
        starts, spreads = self._states("initial_state"), self._states("initial_spread")
        return {
            joint: self._scenario(
                joint,
                {name: each[-1] for name, each in changed[joint].items()},
                given[joint],
                affected[joint] if self.affected else outputs[joint],
                {"initial_state": starts[joint], "initial_spread": spreads[joint]},
            )
            for joint in self.requests
        }

    def _scenario(
        self,
        joint: str,
        mismatch: dict[str, float],
        signals: Mapping[str, list[Signal]],
        affected: Iterable[str],
        states: dict[str, Any],
    ) -> Scenario | SystemScenario:
        """Return the scenario of one joint: that of its request, with what parameters change."""
        request, factor = self.requests[joint], self.process_noise.factor
        common = asdict(self.mismatch) if isinstance(request, ArmRequest) else {}
        base = scenario_of(request, common | mismatch)
        outputs = []
        for output in base.signals.outputs:
            sensor, disturbance = output.sensor, tuple(signals.get(output.measures, ()))
            if not self.design_of[joint]:
                sensor = replace(sensor, noise_std=self.noise_std)
            if output.measures in affected:
                sensor = self._sensor(sensor.noise_std)
                disturbance = self.disturbance.build() + disturbance
            outputs.append(replace(output, sensor=sensor, disturbance=disturbance))
        own: dict[str, Any] = {
            "rate": self.sample_rate, "duration": self.duration, "outputs": tuple(outputs)
        }  # fmt: skip
        count = base.signals.input_count
        free = (self.excitation.build(),) * count + base.signals.inputs[count:]
        inputs = tuple(
            signals[name][-1] if name in signals and name not in request.output_names else default
            for name, default in zip(request.input_names, free, strict=True)
        )
        if isinstance(base, SystemScenario):
            noise = np.asarray(base.process_noise) * factor
            return replace(base, **own, **states, process_noise=noise, inputs=inputs)
        density, is_loaded = base.process_noise, joint in (self.payload.joints or (joint,))
        torques = {side: tuple(signals.get(name, ())) for side, name in _TORQUES.items()}
        own |= {name: tuple(base.arm.from_physical(each).tolist()) for name, each in states.items()}
        return replace(
            base,
            **own,
            process_noise=ProcessNoise(density.link * factor, density.motor * factor),
            friction=self.friction,
            payload=self.payload.build() if is_loaded else Payload(),
            excitation=inputs[0],
            torque_disturbance=TorqueDisturbance(**torques),
            torque_error=(self.effort_error,) if self.effort_error.amplitude else (),
            sensor=Sensor(),
        )

    def _states(self, name: str) -> dict[str, tuple[float, ...]]:
        """Return the numbers of a parameter that each joint's states get."""
        values: tuple[float, ...] = getattr(self, name)
        sizes = {joint: len(each.state_names) for joint, each in self.requests.items()}
        if values == getattr(type(self), name):
            designed = self.design_of
            return {joint: (0.0,) * n if designed[joint] else values for joint, n in sizes.items()}
        if len(values) == sum(sizes.values()):
            numbers = iter(values)
            return {joint: tuple(islice(numbers, n)) for joint, n in sizes.items()}
        if set(sizes.values()) == {len(values)}:
            return dict.fromkeys(sizes, values)
        expected = " + ".join(map(str, sizes.values()))
        raise ModelError(f"{name}: expected {expected} numbers, got {len(values)}")


def _request(path: str) -> ArmRequest | TSRequest:
    """Return the request in a file; a parameter may be refused for it, but not end a node."""
    file = Path(path)
    try:
        return _read(file, file.stat().st_mtime_ns if file.exists() else 0)
    except TsobsError as error:
        raise ParameterError(str(error)) from error


@lru_cache(maxsize=64)
def _read(path: Path, _modified: int) -> ArmRequest | TSRequest:
    return request_in(path)
