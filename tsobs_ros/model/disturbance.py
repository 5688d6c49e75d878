# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Models of the sensor's disturbance: ω = H w, ẇ = S w + G n, n white noise.

The method's observer allows an arbitrary ω in every channel, and then the output has no
information about the state. An estimator that works needs an exosystem: a bias, a drift, a tone,
a ramp, or a sum of them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, non_negative, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.model.matrices import block_diagonal, product


@dataclass(frozen=True)
class DisturbanceModel:
    """Exosystem of an output disturbance with q states on p channels.

    Attributes:
        label: Its name in reports, such as "bias".
        S: Exosystem matrix, shape (q, q) [1/s].
        H: Output map, shape (p, q).
        G: Square root of the driving noise density, shape (q, g) [unit/√s].
        initial_std: 1σ of each exosystem state before any measurement, shape (q,).
        arbitrary: True for the method's own assumption: any signal, unknown at every instant.
    """

    label: str
    S: Array
    H: Array
    G: Array
    initial_std: Array
    arbitrary: bool = False

    @property
    def state_count(self) -> int:
        """Number of exosystem states q."""
        return int(self.S.shape[0])

    @property
    def channel_count(self) -> int:
        """Number of output channels p."""
        return int(self.H.shape[0])

    @cached_property
    def rate_map(self) -> Array:
        """Exosystem states to the disturbance's modelled rate dω/dt, shape (p, q)."""
        return product(self.H, self.S)

    @cached_property
    def noise_density(self) -> Array:
        """G Gᵀ, density of the noise on the exosystem's derivative, shape (q, q)."""
        return product(self.G, self.G.T)

    def __add__(self, other: "DisturbanceModel") -> "DisturbanceModel":
        """Return the model of the sum of two independent disturbances on the same channels."""
        if self.channel_count != other.channel_count:
            raise ModelError(
                f"disturbance sum: expected the same number of channels, "
                f"got {self.channel_count} and {other.channel_count}"
            )
        labels = [model.label for model in (self, other) if model.state_count or model.arbitrary]
        return _joined("+".join(labels) or "clean", np.hstack([self.H, other.H]), (self, other))

    def through(self, D_s: ArrayLike) -> "DisturbanceModel":
        """Return the model acting on the outputs through D_s, shape (p, channels)."""
        rows = np.shape(D_s)[0] if np.ndim(D_s) == 2 else 0
        mixing = as_matrix("D_s", D_s, (rows, self.channel_count))
        if np.linalg.matrix_rank(mixing) < self.channel_count:
            raise ModelError(f"D_s: expected full column rank, got {mixing.tolist()}")
        return replace(self, H=product(mixing, self.H))


def clean(channels: int = 1) -> DisturbanceModel:
    """Return the model of a sensor known to carry noise only."""
    zero = np.zeros((0, 0))
    return DisturbanceModel("clean", zero, np.zeros((channels, 0)), zero, np.zeros(0))


def arbitrary() -> DisturbanceModel:
    """Return the method's assumption on one channel: any signal, no model at all."""
    return replace(clean(), label="arbitrary", arbitrary=True)


def bias(density: float = 1e-4, initial_std: float = 0.3) -> DisturbanceModel:
    """Return a constant that may wander: a random walk.

    Args:
        density: Growth of its variance [rad²/s].
        initial_std: 1σ before any measurement [rad].
    """
    return _exosystem("bias", [[0.0]], {"density": density}, {"initial_std": initial_std})


def gauss_markov(std: float = 0.1, time_constant: float = 20.0) -> DisturbanceModel:
    """Return a drift with a stationary 1σ `std` [rad]: ẇ = −w/τ + noise, τ [s]."""
    tau = positive("gauss_markov time_constant", time_constant)
    root = positive("gauss_markov std", std) * math.sqrt(2.0 / tau)
    matrices = np.array([[-1.0 / tau]]), np.eye(1), np.array([[root]])
    return DisturbanceModel("gauss_markov", *matrices, np.array([std]))


def sinusoid(frequency: float, density: float = 1e-4, initial_std: float = 0.3) -> DisturbanceModel:
    """Return a tone of a known frequency and slowly wandering amplitude and phase.

    Args:
        frequency: ω₀ [rad/s].
        density: Growth of the variance of each of its two states [rad²/s].
        initial_std: 1σ of each state before any measurement [rad].
    """
    w0, std = positive("sinusoid frequency", frequency), {"initial_std": initial_std}
    return _exosystem("sinusoid", [[0.0, w0], [-w0, 0.0]], {"density": density}, std)


def ramp(
    density: float = 1e-4,
    rate_density: float = 1e-6,
    initial_std: float = 0.3,
    initial_rate_std: float = 0.02,
) -> DisturbanceModel:
    """Return a bias that grows at a slowly wandering rate: a double integrator.

    Args:
        density: Growth of the bias's variance [rad²/s].
        rate_density: Growth of the rate's variance [rad²/s³].
        initial_std: 1σ of the bias before any measurement [rad].
        initial_rate_std: 1σ of the rate before any measurement [rad/s].
    """
    densities = {"density": density, "rate_density": rate_density}
    stds = {"initial_std": initial_std, "initial_rate_std": initial_rate_std}
    return _exosystem("ramp", [[0.0, 1.0], [0.0, 0.0]], densities, stds)


def per_channel(models: Sequence[DisturbanceModel]) -> DisturbanceModel:
    """Return independent one-channel models side by side, one per output channel."""
    if not models:
        raise ModelError("per_channel: expected at least one disturbance model")
    label = ", ".join(model.label for model in models)
    return _joined(label, block_diagonal(*(model.H for model in models)), models)


def _joined(label: str, H: Array, models: Sequence[DisturbanceModel]) -> DisturbanceModel:
    """Return a model with the states of several, which are independent."""
    return DisturbanceModel(
        label,
        block_diagonal(*(model.S for model in models)),
        H,
        block_diagonal(*(model.G for model in models)),
        np.concatenate([model.initial_std for model in models]),
        any(model.arbitrary for model in models),
    )


def _exosystem(
    label: str,
    S: Sequence[Sequence[float]],
    densities: Mapping[str, float],
    stds: Mapping[str, float],
) -> DisturbanceModel:
    """Return a model of one channel, its first state, with a noise per state; one may be of all."""
    density, start = (
        np.resize([non_negative(f"{label} {name}", each[name]) for name in each], len(S))
        for each in (densities, stds)
    )
    return DisturbanceModel(label, np.array(S), np.eye(1, len(S)), np.diag(np.sqrt(density)), start)
