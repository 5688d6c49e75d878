# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the plant simulator node, and the scenario they describe."""

from dataclasses import asdict, dataclass

from tsobs_ros.errors import ModelError, ParameterError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.nodes.managed import ManagedParameters
from tsobs_ros.nodes.parameters import parameter, parameter_group
from tsobs_ros.nodes.plant_simulator.disturbance import DisturbanceParameters
from tsobs_ros.simulation.excitation import Chirp, Excitation, Multisine, NoTorque, Sine, Square
from tsobs_ros.simulation.scenario import Mismatch, Scenario
from tsobs_ros.simulation.sensor import Sensor


@dataclass(frozen=True)
class ArmParameters:
    """The nominal arm."""

    link_inertia: float = parameter(1.0, "Link inertia J1", unit="kg m^2", read_only=True)
    motor_inertia: float = parameter(2.0, "Motor inertia J2", unit="kg m^2", read_only=True)
    stiffness: float = parameter(10.0, "Joint stiffness k", unit="N m/rad", read_only=True)
    gravity_torque: float = parameter(
        10.0, "Torque mgl that holds the link horizontal", unit="N m", read_only=True
    )
    link_damping: float = parameter(0.0, "Link damping b1", unit="N m s/rad", read_only=True)
    motor_damping: float = parameter(0.0, "Motor damping b2", unit="N m s/rad", read_only=True)


@dataclass(frozen=True)
class MismatchParameters:
    """Relative changes that make the true arm of the nominal one."""

    link_inertia: float = parameter(0.0, "Relative change of J1; 0.2 is 20 % more", read_only=True)
    motor_inertia: float = parameter(0.0, "Relative change of J2", read_only=True)
    stiffness: float = parameter(0.0, "Relative change of k", read_only=True)
    gravity_torque: float = parameter(0.0, "Relative change of mgl", read_only=True)
    link_damping: float = parameter(0.0, "Relative change of b1", read_only=True)
    motor_damping: float = parameter(0.0, "Relative change of b2", read_only=True)


@dataclass(frozen=True)
class ProcessNoiseParameters:
    """Random accelerations."""

    link_acceleration_density: float = parameter(
        1e-4, "White acceleration of the link", unit="rad^2/s^3", minimum=0.0, read_only=True
    )
    motor_acceleration_density: float = parameter(
        1e-5, "White acceleration of the motor", unit="rad^2/s^3", minimum=0.0, read_only=True
    )


@dataclass(frozen=True)
class ExcitationParameters:
    """The torque in the absence of a command."""

    kind: str = parameter(
        "sine", "Torque signal", choices=("none", "sine", "multisine", "square", "chirp")
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


@dataclass(frozen=True)
class DropoutParameters:
    """Samples that are not published."""

    interval: float = parameter(
        0.0, "Time between the beginnings of dropouts; 0 for none", unit="s", minimum=0.0
    )
    duration: float = parameter(0.5, "Length of a dropout", unit="s", minimum=0.0)


@dataclass(frozen=True)
class PlantSimulatorParameters(ManagedParameters):
    """All parameters of the node.

    Raises:
        ParameterError: They do not describe a plant.
    """

    joint: str = parameter("elastic_joint", "Name of the joint", read_only=True)
    rate: float = parameter(
        200.0, "Samples a second", unit="Hz", minimum=1.0, maximum=5000.0, read_only=True
    )
    seed: int = parameter(0, "Seed of everything random, used from the next reset on", minimum=0)
    duration: float = parameter(
        0.0,
        "Simulated time after which the process ends; 0: never",
        unit="s",
        minimum=0.0,
        read_only=True,
    )
    wait_for_subscribers: int = parameter(
        0,
        "Subscriptions of joint_measurements to wait for before t = 0",
        minimum=0,
        read_only=True,
    )
    wait_timeout: float = parameter(
        10.0,
        "Longest wait for them, then start anyway; 0: no limit",
        unit="s",
        minimum=0.0,
        read_only=True,
    )
    publish_clock: bool = parameter(False, "Drive /clock with the simulated time", read_only=True)
    real_time_factor: float = parameter(
        1.0,
        "Pace of the simulated time when publish_clock is set",
        minimum=0.001,
        maximum=1000.0,
        read_only=True,
    )
    command_timeout: float = parameter(
        0.5, "How long a torque command holds; 0: until the next one", unit="s", minimum=0.0
    )
    torque_limit: float = parameter(
        100.0, "Commands saturate at plus and minus this torque", unit="N m", minimum=0.0
    )
    initial_state: tuple[float, ...] = parameter(
        (0.3, 0.0, 0.2, 0.0),
        "Link angle, link velocity, motor angle, motor velocity at t = 0 (rad, rad/s)",
        read_only=True,
    )
    initial_spread: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0, 0.0),
        "Standard deviation of each of them (rad, rad/s)",
        minimum=0.0,
        read_only=True,
    )
    noise_std: float = parameter(
        0.028, "Standard deviation of the measurement noise", unit="rad", minimum=0.0
    )
    arm: ArmParameters = parameter_group(ArmParameters)
    mismatch: MismatchParameters = parameter_group(MismatchParameters)
    process_noise: ProcessNoiseParameters = parameter_group(ProcessNoiseParameters)
    excitation: ExcitationParameters = parameter_group(ExcitationParameters)
    disturbance: DisturbanceParameters = parameter_group(DisturbanceParameters)
    outliers: OutlierParameters = parameter_group(OutlierParameters)
    dropouts: DropoutParameters = parameter_group(DropoutParameters)

    def __post_init__(self) -> None:
        if not self.joint:
            raise ParameterError("parameter 'joint' must not be empty")
        try:
            self.scenario()
        except ModelError as error:
            raise ParameterError(str(error)) from error

    def scenario(self) -> Scenario:
        """Return what the parameters describe.

        Raises:
            ModelError: They do not describe a plant.
        """
        for name in ("initial_state", "initial_spread"):
            if len(getattr(self, name)) != 4:
                raise ModelError(f"{name}: expected four numbers, got {getattr(self, name)}")
        arm = ElasticJointArm(**asdict(self.arm))
        start, spread = (
            tuple(arm.from_physical(q).tolist()) for q in (self.initial_state, self.initial_spread)
        )
        return Scenario(
            arm=arm,
            mismatch=Mismatch(**asdict(self.mismatch)),
            rate=self.rate,
            duration=self.duration,
            initial_state=start,
            initial_spread=spread,
            process_noise=ProcessNoise(
                link=self.process_noise.link_acceleration_density,
                motor=self.process_noise.motor_acceleration_density,
            ),
            excitation=self.excitation.build(),
            disturbance=self.disturbance.build(),
            sensor=Sensor(
                self.noise_std,
                self.outliers.probability,
                self.outliers.size,
                self.dropouts.interval,
                self.dropouts.duration,
            ),
        )
