# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the plant simulator node, and the scenario they describe."""

import math
from dataclasses import dataclass
from typing import Any

from tsobs_ros.errors import ModelError, ParameterError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.nodes.managed import ManagedParameters
from tsobs_ros.nodes.parameters import fixed_parameter, parameter, parameter_group
from tsobs_ros.simulation.integrator import Friction
from tsobs_ros.simulation.plant import Mismatch, Scenario
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import (
    BiasStep,
    Chirp,
    Component,
    Constant,
    Excitation,
    GaussMarkov,
    Multisine,
    NoTorque,
    Pulses,
    Ramp,
    Sine,
    Sinusoid,
    Square,
    StuckSensor,
    TwoTone,
    parse_kinds,
)


def _start() -> Any:
    return parameter(0.0, "Start, counted from when the disturbance was put in", unit="s")


@dataclass(frozen=True)
class StuckParameters:
    """A measured value that freezes."""

    start: float = _start()
    duration: float = parameter(1.0, "How long; 0 for ever", unit="s", minimum=0.0)


@dataclass(frozen=True)
class DisturbanceParameters:
    """What the sensor adds to the angle besides white noise."""

    kind: str = parameter(
        "none",
        "none, or a sum of bias_step, sinusoid, ramp, two_tone, gauss_markov, stuck and pulses, "
        "such as bias_step+sinusoid; changing it injects a fault",
    )
    bias_step: BiasStep = parameter_group(
        BiasStep, amplitude=parameter(0.1, "Bias", unit="rad"), start=_start()
    )
    sinusoid: Sinusoid = parameter_group(
        Sinusoid,
        amplitude=parameter(0.2, "Amplitude", unit="rad"),
        frequency=parameter(3.0, "Frequency", unit="rad/s"),
        start=_start(),
    )
    ramp: Ramp = parameter_group(
        Ramp, rate=parameter(0.004, "Growth", unit="rad/s"), start=_start()
    )
    two_tone: TwoTone = parameter_group(
        TwoTone,
        amplitude=parameter(0.4, "Amplitude of a (sin 2t + cos 3t)", unit="rad"),
        start=_start(),
    )
    gauss_markov: GaussMarkov = parameter_group(
        GaussMarkov,
        std=parameter(0.1, "Stationary standard deviation", unit="rad", minimum=0.0),
        time_constant=parameter(20.0, "Time constant", unit="s"),
        start=_start(),
    )
    stuck: StuckParameters = parameter_group(StuckParameters)
    pulses: Pulses = parameter_group(
        Pulses,
        amplitude=parameter(0.5, "Height of a pulse", unit="rad"),
        start=_start(),
        duration=parameter(1.5, "Length of a pulse", unit="s", minimum=0.0),
        interval=parameter(
            8.0, "Time between the beginnings of pulses; 0 for one", unit="s", minimum=0.0
        ),
    )

    def build(self) -> tuple[Component, ...]:
        """Return the components of the chosen kinds; the numbers of all kinds are checked."""
        components: tuple[Component, ...] = (
            self.bias_step,
            self.sinusoid,
            self.ramp,
            self.two_tone,
            self.gauss_markov,
            StuckSensor(self.stuck.start, self.stuck.duration or math.inf),
            self.pulses,
        )
        kinds = {component.kind: component for component in components}
        return tuple(kinds[name] for name in parse_kinds(self.kind))


@dataclass(frozen=True)
class ExcitationParameters:
    """The torque in the absence of a command."""

    kind: str = parameter(
        "sine",
        "Torque signal",
        choices=("none", "constant", "sine", "multisine", "square", "chirp"),
    )
    amplitude: float = parameter(1.0, "Amplitude; of a multisine, of all its tones", unit="N m")
    frequency: float = parameter(1.0, "Frequency of sine and square", unit="rad/s")
    lowest: float = parameter(0.5, "Lowest frequency of multisine and chirp", unit="rad/s")
    highest: float = parameter(6.0, "Highest frequency of multisine and chirp", unit="rad/s")
    tones: int = parameter(8, "Tones of a multisine", minimum=1, maximum=1000)
    sweep: float = parameter(20.0, "Length of a chirp's sweep", unit="s")

    def build(self) -> Excitation:
        """Return the excitation; every kind is checked, the chosen one is returned."""
        kinds: dict[str, Excitation] = {
            "none": NoTorque(),
            "constant": Constant(self.amplitude),
            "sine": Sine(self.amplitude, self.frequency),
            "square": Square(self.amplitude, self.frequency),
            "multisine": Multisine(self.amplitude, self.lowest, self.highest, self.tones),
            "chirp": Chirp(self.amplitude, self.lowest, self.highest, self.sweep),
        }
        return kinds[self.kind]


@dataclass(frozen=True)
class OutlierParameters:
    """Samples that are far off."""

    probability: float = parameter(0.0, "Probability of an outlier", minimum=0.0, maximum=1.0)
    size: float = parameter(1.0, "What an outlier adds, with either sign", unit="rad")
    uniform: bool = parameter(False, "Outliers of any size up to this one")


@dataclass(frozen=True)
class NoiseParameters:
    """What makes the measurement noise other than white and normal."""

    time_constant: float = parameter(
        0.0, "Time constant of its correlation; 0: white", unit="s", minimum=0.0
    )
    degrees_of_freedom: int = parameter(
        0, "Of Student's t, which noise_std multiplies; 0: normal", minimum=0, maximum=1000
    )
    burst_interval: float = parameter(
        0.0, "Time between the beginnings of bursts; 0 for none", unit="s", minimum=0.0
    )
    burst_duration: float = parameter(1.5, "Length of a burst", unit="s", minimum=0.0)
    burst_factor: float = parameter(4.0, "What multiplies the noise in a burst", minimum=0.0)


@dataclass(frozen=True)
class DropoutParameters:
    """Samples that are not published."""

    interval: float = parameter(
        0.0, "Time between the beginnings of dropouts; 0 for none", unit="s", minimum=0.0
    )
    duration: float = parameter(0.5, "Length of a dropout", unit="s", minimum=0.0)


@dataclass(frozen=True)
class ProcessNoiseParameters:
    """Random accelerations."""

    link_acceleration_density: float = fixed_parameter(
        1e-4, "White acceleration of the link", unit="rad^2/s^3", minimum=0.0
    )
    motor_acceleration_density: float = fixed_parameter(
        1e-5, "White acceleration of the motor", unit="rad^2/s^3", minimum=0.0
    )


@dataclass(frozen=True)
class PlantSimulatorParameters(ManagedParameters):
    """All parameters of the node.

    Raises:
        ParameterError: They do not describe a plant.
    """

    joint: str = fixed_parameter("elastic_joint", "Name of the joint")
    rate: float = fixed_parameter(200.0, "Samples a second", unit="Hz", minimum=1.0, maximum=5000.0)
    seed: int = parameter(0, "Seed of everything random, used from the next reset on", minimum=0)
    duration: float = fixed_parameter(
        0.0, "Simulated time after which the process ends; 0: never", unit="s", minimum=0.0
    )
    wait_for_subscribers: int = fixed_parameter(
        0, "Subscriptions of joint_measurements to wait for before t = 0", minimum=0
    )
    wait_timeout: float = fixed_parameter(
        10.0, "Longest wait for them, then start anyway; 0: no limit", unit="s", minimum=0.0
    )
    publish_clock: bool = fixed_parameter(False, "Drive /clock with the simulated time")
    real_time_factor: float = fixed_parameter(
        1.0,
        "Pace of the simulated time when publish_clock is set",
        minimum=0.001,
        maximum=1000.0,
    )
    command_timeout: float = parameter(
        0.5, "How long a torque command holds; 0: until the next one", unit="s", minimum=0.0
    )
    torque_limit: float = parameter(
        100.0, "Commands saturate at plus and minus this torque", unit="N m", minimum=0.0
    )
    initial_state: tuple[float, ...] = fixed_parameter(
        (0.3, 0.0, 0.2, 0.0),
        "Link angle, link velocity, motor angle, motor velocity at t = 0 (rad, rad/s)",
    )
    initial_spread: tuple[float, ...] = fixed_parameter(
        (0.0, 0.0, 0.0, 0.0), "Standard deviation of each of them (rad, rad/s)", minimum=0.0
    )
    noise_std: float = parameter(
        0.028, "Standard deviation of the measurement noise", unit="rad", minimum=0.0
    )
    latency: float = parameter(
        0.0,
        "Age of the measured angle at its stamp, in whole samples",
        unit="s",
        minimum=0.0,
        maximum=1.0,
    )
    resolution: float = parameter(
        0.0, "Step of the measured angle; 0: none", unit="rad", minimum=0.0
    )
    arm: ElasticJointArm = parameter_group(
        ElasticJointArm,
        link_inertia=fixed_parameter(1.0, "Link inertia J1", unit="kg m^2"),
        motor_inertia=fixed_parameter(2.0, "Motor inertia J2", unit="kg m^2"),
        stiffness=fixed_parameter(10.0, "Joint stiffness k", unit="N m/rad"),
        gravity_torque=fixed_parameter(
            10.0, "Torque mgl that holds the link horizontal", unit="N m"
        ),
        link_damping=fixed_parameter(0.0, "Link damping b1", unit="N m s/rad"),
        motor_damping=fixed_parameter(0.0, "Motor damping b2", unit="N m s/rad"),
    )
    mismatch: Mismatch = parameter_group(
        Mismatch,
        link_inertia=fixed_parameter(0.0, "Relative change of J1; 0.2 is 20 % more"),
        motor_inertia=fixed_parameter(0.0, "Relative change of J2"),
        stiffness=fixed_parameter(0.0, "Relative change of k"),
        gravity_torque=fixed_parameter(0.0, "Relative change of mgl"),
        link_damping=fixed_parameter(0.0, "Relative change of b1"),
        motor_damping=fixed_parameter(0.0, "Relative change of b2"),
    )
    friction: Friction = parameter_group(
        Friction,
        link_viscous=fixed_parameter(0.0, "Viscous friction of the link", unit="N m s/rad"),
        link_coulomb=fixed_parameter(0.0, "Coulomb friction of the link", unit="N m"),
        motor_viscous=fixed_parameter(0.0, "Viscous friction of the motor", unit="N m s/rad"),
        motor_coulomb=fixed_parameter(0.0, "Coulomb friction of the motor", unit="N m"),
    )
    process_noise: ProcessNoiseParameters = parameter_group(ProcessNoiseParameters)
    excitation: ExcitationParameters = parameter_group(ExcitationParameters)
    disturbance: DisturbanceParameters = parameter_group(DisturbanceParameters)
    noise: NoiseParameters = parameter_group(NoiseParameters)
    outliers: OutlierParameters = parameter_group(OutlierParameters)
    dropouts: DropoutParameters = parameter_group(DropoutParameters)
    effort_error: Pulses = parameter_group(
        Pulses,
        amplitude=fixed_parameter(0.0, "Error of the published effort; 0 for none", unit="N m"),
        start=fixed_parameter(30.0, "Start of the first error", unit="s"),
        duration=fixed_parameter(0.005, "Length of an error", unit="s", minimum=0.0),
        interval=fixed_parameter(
            0.0, "Time between the beginnings of errors; 0 for one", unit="s", minimum=0.0
        ),
    )

    def __post_init__(self) -> None:
        if not self.joint:
            raise ParameterError("parameter 'joint' must not be empty")
        for name in ("initial_state", "initial_spread"):
            if len(getattr(self, name)) != 4:
                raise ModelError(f"{name}: expected four numbers, got {getattr(self, name)}")
        self.scenario()

    def scenario(self) -> Scenario:
        """Return what the parameters describe.

        Raises:
            ModelError: They do not describe a plant.
        """
        start, spread = (
            tuple(self.arm.from_physical(q).tolist())
            for q in (self.initial_state, self.initial_spread)
        )
        densities = self.process_noise
        return Scenario(
            arm=self.arm,
            mismatch=self.mismatch,
            friction=self.friction,
            rate=self.rate,
            duration=self.duration,
            initial_state=start,
            initial_spread=spread,
            process_noise=ProcessNoise(
                link=densities.link_acceleration_density,
                motor=densities.motor_acceleration_density,
            ),
            excitation=self.excitation.build(),
            disturbance=self.disturbance.build(),
            sensor=Sensor(
                self.noise_std,
                self.outliers.probability,
                self.outliers.size,
                self.dropouts.interval,
                self.dropouts.duration,
                self.outliers.uniform,
                self.noise.time_constant,
                self.noise.degrees_of_freedom,
                self.noise.burst_interval,
                self.noise.burst_duration,
                self.noise.burst_factor,
                self.latency,
                self.resolution,
            ),
            torque_error=(self.effort_error,) if self.effort_error.amplitude else (),
        )
