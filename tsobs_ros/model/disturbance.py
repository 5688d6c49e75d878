# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Models of the sensor's disturbance: ω = H w, ẇ = S w + G n, n white noise.

The observer of the published method allows an arbitrary ω in every channel, and then the output
has no information about the state. A useful estimator needs an exosystem: a bias, a drift, a tone,
a ramp, or a sum of them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, Fixed, as_matrix, check_names, non_negative, positive, shown
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
        arbitrary: True for the published method's assumption: any signal, unknown at every instant.
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

    def through(self, D_s: ArrayLike) -> "DisturbanceModel":
        """Return the model acting on the outputs through D_s, shape (p, channels)."""
        rows, channels = np.shape(D_s)[0] if np.ndim(D_s) == 2 else 0, len(self.H)
        mixing = as_matrix("D_s", D_s, (rows, channels))
        if np.linalg.matrix_rank(mixing) < channels:
            raise ModelError(f"D_s: expected full column rank, got {mixing.tolist()}")
        return replace(self, H=product(mixing, self.H))


KINDS: Mapping[str, Mapping[str, float | None]] = {
    "clean": {},
    "arbitrary": {},
    "bias": {"density": 1e-4, "initial_std": 0.3},
    "gauss_markov": {"std": 0.1, "time_constant": 20.0},
    "sinusoid": {"frequency": None, "density": 1e-4, "initial_std": 0.3},
    "ramp": {
        "density": 1e-4, "rate_density": 1e-6, "initial_std": 0.3, "initial_rate_std": 0.02,
    },
}  # fmt: skip
"""Parameters of each kind of term with their defaults; None if a parameter must be given."""


class DisturbanceTerm(Fixed[Any]):
    """One term of a disturbance: its kind and its parameters; omitted ones get their defaults.

    - `clean`: nothing but the sensor's white noise.
    - `arbitrary`: the published method's assumption, any signal; nothing can be proved for it.
    - `bias`: a constant that may wander. `density`: growth of its variance [rad²/s].
    - `gauss_markov`: a drift ẇ = −w/τ + noise. `std`: its stationary 1σ [rad], `time_constant`: τ
      [s].
    - `sinusoid`: a tone of a known `frequency` [rad/s], whose amplitude and phase wander.
      `density`: growth of the variance of each of its two states [rad²/s].
    - `ramp`: a bias that grows at a wandering rate. `density`: as for a bias, `rate_density`:
      growth of the rate's variance [rad²/s³], `initial_rate_std`: 1σ of the rate before any
      measurement [rad/s].

    `initial_std` is the 1σ of each state before any measurement [rad].

    Raises:
        ModelError: The kind is unknown, or a parameter does not belong to it or is out of range.

    >>> DisturbanceTerm("bias", {"density": 1e-4})
    {'kind': 'bias', 'density': 0.0001, 'initial_std': 0.3}
    """

    def __init__(self, kind: str, parameters: Mapping[str, float] | None = None) -> None:
        if not isinstance(kind, str) or kind not in KINDS:
            raise ModelError(f"kind: expected one of {', '.join(KINDS)}, got {shown(kind)}")
        known, given = KINDS[kind], parameters or {}
        check_names(f"parameters of {kind}", given, known)
        entries: dict[str, Any] = {"kind": kind}
        for name, default in known.items():
            value = given.get(name, default)
            if value is None:
                raise ModelError(f"{name}: missing, {kind} has no default for it")
            check = positive if name in ("std", "time_constant", "frequency") else non_negative
            entries[name] = check(f"{kind} {name}", value)
        super().__init__(entries)

    @classmethod
    def from_mapping(cls, entries: Mapping[str, Any]) -> "DisturbanceTerm":
        """Return the term with the kind and the parameters that a file gives."""
        parameters = dict(entries)
        return cls(parameters.pop("kind", None), parameters)

    @property
    def kind(self) -> str:
        """The name of the exosystem, one of `KINDS`."""
        return str(self["kind"])

    @cached_property
    def model(self) -> DisturbanceModel:
        """The exosystem, whose first state is the disturbance."""
        S: list[list[float]] = []
        roots, std = [], [self.get("initial_std", 0.0)]
        if self.kind == "bias":
            S, roots = [[0.0]], [math.sqrt(self["density"])]
        elif self.kind == "gauss_markov":
            tau, std = self["time_constant"], [self["std"]]
            S, roots = [[-1.0 / tau]], [std[0] * math.sqrt(2.0 / tau)]
        elif self.kind == "sinusoid":
            w0, std = self["frequency"], 2 * std
            S, roots = [[0.0, w0], [-w0, 0.0]], 2 * [math.sqrt(self["density"])]
        elif self.kind == "ramp":
            S, std = [[0.0, 1.0], [0.0, 0.0]], [*std, self["initial_rate_std"]]
            roots = [math.sqrt(self[name]) for name in ("density", "rate_density")]
        q = len(S)
        matrices = np.reshape(S, (q, q)), np.eye(1, q), np.diag(roots) if q else np.zeros((0, 0))
        return DisturbanceModel(self.kind, *matrices, np.array(std[:q]), self.kind == "arbitrary")


CLEAN = (DisturbanceTerm("clean"),)
"""The terms of an undisturbed signal."""


def sum_of(terms: Sequence[DisturbanceTerm]) -> DisturbanceModel:
    """Return the model of the sum of independent terms on one channel; none count as `CLEAN`."""
    models = [term.model for term in terms or CLEAN]
    labels = [each.label for each in models if each.state_count or each.arbitrary]
    return _joined("+".join(labels) or "clean", np.hstack([each.H for each in models]), models)


def per_channel(models: Sequence[DisturbanceModel]) -> DisturbanceModel:
    """Return independent one-channel models side by side, one per output channel."""
    label = ", ".join(model.label for model in models)
    return _joined(label, block_diagonal(*(model.H for model in models)), models)


def _joined(label: str, H: Array, models: Sequence[DisturbanceModel]) -> DisturbanceModel:
    """Return a model that joins the states of several independent models."""
    return DisturbanceModel(
        label,
        block_diagonal(*(model.S for model in models)),
        H,
        block_diagonal(*(model.G for model in models)),
        np.concatenate([model.initial_std for model in models]),
        any(model.arbitrary for model in models),
    )
