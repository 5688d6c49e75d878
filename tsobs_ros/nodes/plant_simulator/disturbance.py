# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the plant simulator that describe the disturbance of its sensor."""

import math
from dataclasses import asdict, dataclass

from tsobs_ros.nodes.parameters import parameter, parameter_group
from tsobs_ros.simulation.signals import (
    BiasStep,
    Component,
    GaussMarkov,
    Ramp,
    Sinusoid,
    StuckSensor,
    TwoTone,
    parse_kinds,
)

_SINCE = "Start, counted from when the disturbance was put in"


@dataclass(frozen=True)
class BiasStepParameters:
    """A constant from its start on."""

    amplitude: float = parameter(0.1, "Bias", unit="rad")
    start: float = parameter(0.0, _SINCE, unit="s")


@dataclass(frozen=True)
class SinusoidParameters:
    """A tone from its start on."""

    amplitude: float = parameter(0.2, "Amplitude", unit="rad")
    frequency: float = parameter(3.0, "Frequency", unit="rad/s")
    start: float = parameter(0.0, _SINCE, unit="s")


@dataclass(frozen=True)
class RampParameters:
    """A steady growth from its start on."""

    rate: float = parameter(0.004, "Growth", unit="rad/s")
    start: float = parameter(0.0, _SINCE, unit="s")


@dataclass(frozen=True)
class TwoToneParameters:
    """a (sin 2t + cos 3t) from its start on."""

    amplitude: float = parameter(0.4, "Amplitude of a (sin 2t + cos 3t)", unit="rad")
    start: float = parameter(0.0, _SINCE, unit="s")


@dataclass(frozen=True)
class GaussMarkovParameters:
    """A random drift of bounded variance."""

    std: float = parameter(0.1, "Stationary standard deviation", unit="rad", minimum=0.0)
    time_constant: float = parameter(20.0, "Time constant", unit="s")
    start: float = parameter(0.0, _SINCE, unit="s")


@dataclass(frozen=True)
class StuckParameters:
    """The measured value freezes."""

    start: float = parameter(0.0, _SINCE, unit="s")
    duration: float = parameter(1.0, "How long; 0 for ever", unit="s", minimum=0.0)


@dataclass(frozen=True)
class DisturbanceParameters:
    """What the sensor adds to the angle besides white noise."""

    kind: str = parameter(
        "none",
        "none, or a sum of bias_step, sinusoid, ramp, two_tone, gauss_markov and stuck, "
        "such as bias_step+sinusoid; changing it injects a fault",
    )
    bias_step: BiasStepParameters = parameter_group(BiasStepParameters)
    sinusoid: SinusoidParameters = parameter_group(SinusoidParameters)
    ramp: RampParameters = parameter_group(RampParameters)
    two_tone: TwoToneParameters = parameter_group(TwoToneParameters)
    gauss_markov: GaussMarkovParameters = parameter_group(GaussMarkovParameters)
    stuck: StuckParameters = parameter_group(StuckParameters)

    def build(self) -> tuple[Component, ...]:
        """Return the components of the chosen kinds; the numbers of all kinds are checked."""
        kinds: dict[str, Component] = {
            BiasStep.kind: BiasStep(**asdict(self.bias_step)),
            Sinusoid.kind: Sinusoid(**asdict(self.sinusoid)),
            Ramp.kind: Ramp(**asdict(self.ramp)),
            TwoTone.kind: TwoTone(**asdict(self.two_tone)),
            GaussMarkov.kind: GaussMarkov(**asdict(self.gauss_markov)),
            StuckSensor.kind: StuckSensor(self.stuck.start, self.stuck.duration or math.inf),
        }
        return tuple(kinds[name] for name in parse_kinds(self.kind))
