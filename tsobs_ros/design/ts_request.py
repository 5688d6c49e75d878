# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a user asks of a design for any T–S system given by its matrices and memberships.

What a certificate covers depends on the premise. Where it is known (made of scheduled signals),
the error system is a blend of the rules' and their matrices are the vertices. Where it is the
estimate, the weights of truth and estimate differ; then matrices whose hull holds the Jacobian of
f on the domain, `slope_vertices`, cover the error exactly. Without them only the blend of the
rules is proved, and `claim` says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, non_negative, positive
from tsobs_ros.design.request import DisturbanceTerm, require_no_alias
from tsobs_ros.errors import DetectabilityError, ModelError
from tsobs_ros.model.detectability import HiddenMode, format_mode, undetectable_modes
from tsobs_ros.model.disturbance import DisturbanceModel, per_channel
from tsobs_ros.model.ts_flow import PairVertex, TSFlow
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import Uncertainty

_MOST_MATRICES = 16
"""Vertex matrices; l of them make l² inequalities."""


@dataclass(frozen=True, eq=False)
class TSRequest:
    """What a design is for. Units are the model's.

    Attributes:
        model: The T–S system, r rules.
        disturbance: Terms of each channel's disturbance, whose sum acts on it.
        process_noise: Densities of white noise on each state's derivative, shape (n,).
        measurement_std: Noise of one sample of each output, shape (p,).
        rate: Samples a second [Hz].
        initial_std: 1σ of each state before any measurement, shape (n,).
        decay_rate: Required rate ρ at which eᵀPe shrinks without noise, as e^{−2ρt} [1/s].
        slope_vertices: Matrices whose convex hull holds the Jacobian of f on the domain,
            shape (l, n, n), for a premise that is the estimate.
        D_s: Channels to outputs, shape (p, channels); by default one channel an output.
        uncertainty: Uncertain directions of the rules' matrices and their bounds.
        certify_uncertainty: Whether the certificate covers every θ within the bounds.

    Raises:
        ModelError: A value is out of range or of the wrong shape.
    """

    model: TSModel
    disturbance: Sequence[Sequence[DisturbanceTerm]]
    process_noise: ArrayLike
    measurement_std: ArrayLike
    rate: float
    initial_std: ArrayLike
    decay_rate: float = 0.0
    slope_vertices: Sequence[ArrayLike] = ()
    D_s: ArrayLike | None = None
    uncertainty: Uncertainty | None = None
    certify_uncertainty: bool = False
    flow: TSFlow = field(init=False)

    def __post_init__(self) -> None:
        n, p = self.model.state_count, self.model.C.shape[0]
        checked: dict[str, Any] = {
            "measurement_std": as_matrix("measurement_std", self.measurement_std, (p,)),
            "initial_std": as_matrix("initial_std", self.initial_std, (n,)),
            "rate": positive("rate", self.rate),
            "decay_rate": non_negative("decay_rate", self.decay_rate),
            "disturbance": tuple(tuple(terms) for terms in self.disturbance),
            "slope_vertices": tuple(
                as_matrix(f"slope_vertices[{i}]", matrix, (n, n))
                for i, matrix in enumerate(self.slope_vertices)
            ),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        for name in ("measurement_std", "initial_std"):
            # Filters work with squares, which leave the range of numbers earlier.
            for std in checked[name].tolist():
                positive(f"square of {name}", std * std if std > 0.0 else std)
        for term in chain.from_iterable(self.disturbance):
            require_no_alias(term, self.rate)
        flow = TSFlow(self.model, self.disturbance_model, self.process_noise, self.period)
        object.__setattr__(self, "flow", flow)
        if self.slope_vertices and self.model.premise_known:
            raise ModelError(
                "slope_vertices: expected none, the premise is made of scheduled signals only "
                "and the rules' matrices are the vertices"
            )
        self._check_uncertainty()

    def _check_uncertainty(self) -> None:
        if self.certify_uncertainty and self.uncertainty is None:
            raise ModelError("certify_uncertainty: expected at least one uncertain direction")
        if self.certify_uncertainty and self.slope_vertices and not self._directions.common:
            raise ModelError(
                "certify_uncertainty: with slope_vertices every direction must be one matrix for "
                "all rules, got one that differs"
            )
        count = len(self.vertex_matrices()[1])
        if count > _MOST_MATRICES:
            raise ModelError(
                f"vertices: expected at most {_MOST_MATRICES} matrices (rules or slope vertices, "
                f"times 2 a certified direction), got {count}"
            )

    @property
    def _directions(self) -> Uncertainty:
        assert self.uncertainty is not None
        return self.uncertainty

    @cached_property
    def disturbance_model(self) -> DisturbanceModel:
        """The exosystem of all channels, acting on the outputs."""
        for channel, terms in enumerate(self.disturbance):
            if not terms:
                raise ModelError(
                    f"disturbance[{channel}]: expected at least one term, e.g. kind: clean"
                )
        models = [[term.model() for term in terms] for terms in self.disturbance]
        joined = per_channel([sum(terms[1:], start=terms[0]) for terms in models])
        return joined if self.D_s is None else joined.through(self.D_s)

    @property
    def period(self) -> float:
        """Sampling period T [s]."""
        return 1.0 / self.rate

    @cached_property
    def measurement_covariance(self) -> Array:
        """R, shape (p, p)."""
        return np.diag(np.asarray(self.measurement_std) ** 2)

    @cached_property
    def initial_covariance(self) -> Array:
        """Error covariance before any measurement, shape (n, n)."""
        std = np.concatenate([self.initial_std, self.disturbance_model.initial_std])
        return np.diag(std**2)

    @property
    def covers_estimated_premise(self) -> bool:
        """Whether the certificate holds where the premise is the estimate, or none is."""
        return self.model.premise_known or bool(self.slope_vertices)

    @property
    def claim(self) -> str:
        """What a certificate for this request says of the premise, for reports."""
        if self.model.premise_known:
            return "the premise is known; covers every weight of the rules"
        if self.slope_vertices:
            return (
                "the premise is the estimate; covers it wherever the Jacobian of f lies in the "
                "convex hull of the slope vertices"
            )
        return (
            "the premise is the estimate, but no slope_vertices were given: covers every weight "
            "of the rules as if it were known, NOT the difference between the weights of truth "
            "and estimate"
        )

    def vertex_matrices(self, share: float = 1.0) -> tuple[Array, list[str]]:
        """Return the plant matrices whose pairs are the vertices, (l, n, n), and their names."""
        if self.slope_vertices:
            matrices = np.array(self.slope_vertices)
            names = [f"slope vertex {i + 1}" for i in range(len(matrices))]
        else:
            matrices = np.asarray(self.model.A)
            names = [f"rule {i + 1}" for i in range(len(matrices))]
        if self.certify_uncertainty:
            matrices, names = self._with_uncertainty(matrices, names)
        middle = matrices.mean(axis=0)
        return middle + share * (matrices - middle), names

    def vertices(self, share: float = 1.0) -> list[PairVertex]:
        """Return the error systems the certificate is about.

        Args:
            share: How much of the way from the mean matrix to the vertices.
        """
        return self.flow.vertices(*self.vertex_matrices(share))

    def starts(self) -> list[PairVertex]:
        """Return the mean system, and each vertex by itself."""
        matrices, names = self.vertex_matrices()
        singles = [("the mean of the vertices", matrices.mean(axis=0))]
        singles += zip(names, matrices, strict=True)
        return [self.flow.vertices(matrix[np.newaxis], [name])[0] for name, matrix in singles]

    @property
    def domain(self) -> str:
        """What the certificate covers, in words."""
        _, names = self.vertex_matrices()
        return f"the hull of {', '.join(names)}"

    @property
    def remedies(self) -> list[str]:
        """What would help where no common matrix is found."""
        smaller = ["smaller bounds of uncertainty"] if self.certify_uncertainty else []
        return [
            *smaller,
            "a smaller domain, whose rules or slope vertices lie closer together",
            "a smaller decay_rate",
            "a disturbance model that decays",
            "another output",
        ]

    def require_detectable(self) -> None:
        """Refuse a request that no observer can answer.

        Every vertex is tested by itself (Popov–Belevitch–Hautus); that all of them pass is
        necessary, and whether what lies between them passes too only the synthesis tells.

        Raises:
            DetectabilityError: A mode that does not decay is hidden, or a channel is arbitrary;
                the text says at which vertex, its eigenvalue and shape, and what would help.
        """
        if self.disturbance_model.arbitrary:
            raise DetectabilityError(
                "an arbitrary disturbance explains every value of the outputs it acts on, which "
                "then say nothing of the state. What would help: a model of it (bias, "
                "gauss_markov, sinusoid, ramp), or leaving these outputs out of C and reading "
                "their disturbance as y − C x̂ from the others"
            )
        matrices, names = self.vertex_matrices()
        hidden = [
            (name, mode)
            for name, matrix in zip(names, matrices, strict=True)
            for mode in undetectable_modes(self.flow.augmented(matrix), self.flow.output_matrix)
            if mode.eigenvalue.imag >= 0.0
        ]
        if hidden:
            raise DetectabilityError(self._explain(hidden))

    def _explain(self, hidden: Sequence[tuple[str, HiddenMode]]) -> str:
        n, q = self.model.state_count, self.disturbance_model.state_count
        names = [f"x{i + 1}" for i in range(n)] + [f"w{i + 1}" for i in range(q)]
        label = f"[{', '.join(names)}]"
        lines = [
            f"no observer exists for outputs disturbed by {self.disturbance_model.label}:",
            *(
                f"  - {name}: the mode {format_mode(mode, label)} is not seen"
                for name, mode in hidden
            ),
            "what would help:",
        ]
        if any(np.abs(mode.shape[n:]).max(initial=0.0) > 1e-6 for _, mode in hidden):
            lines.append(
                "  - a disturbance that cannot copy the mode: gauss_markov, another frequency, or "
                "kind clean on an output that shows it"
            )
        lines.append("  - an output that shows the mode, or damping that makes it decay")
        return "\n".join(lines)

    def _with_uncertainty(self, matrices: Array, names: list[str]) -> tuple[Array, list[str]]:
        """Return every matrix at every corner of the box of θ."""
        uncertain = self._directions
        changes = uncertain.linear[:, :1] if self.slope_vertices else uncertain.linear
        corners, labels = [], []
        for signs in product((-1.0, 1.0), repeat=uncertain.count):
            theta = signs * uncertain.limits
            corners.append(matrices + np.tensordot(theta, changes, 1))
            at = ", ".join(f"{k} {v:+.4g}" for k, v in zip(uncertain.names, theta, strict=True))
            labels += [f"{name} ({at})" for name in names]
        return np.concatenate(corners), labels
