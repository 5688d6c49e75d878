# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certified T–S observer as pure functions of state, measurement and time step.

    correct:  x̂ ← x̂ + K (y − C̄ x̂)        predict:  x̂ ← flow(x̂, u, T)

The premise variable is the estimate x̂₁ itself; the flow's closed form of the T–S blend is exact
on the domain. One rule chooses the gain: the constant certified gain while the certificate's
bound X covers the error covariance, the Riccati (Kalman) gain along the estimate while it does
not: after a start, a reset or a missed sample. The hand-over rests on that covariance, which
trusts the initial one and is linearised along the estimate. A batch hands over as one, as soon as
the bound covers every arm in it.
"""

import enum
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array, as_matrix, non_negative
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Correction, Readout
from tsobs_ros.model.flow import ArmFlow, GapFlow
from tsobs_ros.model.linear_flow import matvec, transposed
from tsobs_ros.model.prediction import PredictionModel

PERIOD_TOLERANCE = 0.1
"""Steps within this fraction of the design's period count as regular samples.

For jitter, whose mean is the period. A sensor that is steadily 10 % slow makes the bound 2 % small.
"""

TORQUE_RATE = 1.0
"""Default 1σ of an arm's torque rate in a gap [N m/s]."""


class GainMode(enum.Enum):
    """Which gain corrects the estimate once it has settled."""

    CERTIFIED = "certified"
    RICCATI = "riccati"


class CertifiedGain(NamedTuple):
    """The constant gain and the bound that is proved for it.

    Attributes:
        K: Filter gain, shape (n, p).
        X: Bound on the error covariance before each sample, shape (n, n).
    """

    K: Array
    X: Array


class OutputModel(NamedTuple):
    """y = C̄ x̄ + v, cov(v) = R, and the disturbance ω = H w in it.

    Attributes:
        C: Augmented state to measurement C̄, shape (p, n).
        R: Covariance of the measurement noise, shape (p, p).
        H: States of the disturbance, the last ones of x̄, to ω, shape (p, q).
        rate_map: The same to dω/dt, shape (p, q).
        identity: Shape (n, n).
    """

    C: Array
    R: Array
    H: Array
    rate_map: Array
    identity: Array

    @classmethod
    def of(cls, flow: PredictionModel, R: Array) -> "OutputModel":
        """Return the model of a flow's outputs with noise of covariance R."""
        disturbance, identity = flow.disturbance, np.eye(flow.state_count)
        return cls(flow.output_matrix, R, disturbance.H, disturbance.rate_map, identity)

    def gain(self, covariance: Array) -> tuple[Array, Array]:
        """Return the innovation covariance S = C̄ΣC̄ᵀ + R and the Kalman gain ΣC̄ᵀS⁻¹."""
        cross = covariance @ self.C.T
        innovation_covariance = self.C @ cross + self.R
        if innovation_covariance.shape[-1] == 1:
            return innovation_covariance, cross / innovation_covariance
        gain = np.linalg.solve(innovation_covariance, transposed(cross))
        return innovation_covariance, transposed(gain)

    def joseph(self, covariance: Array, gain: Array) -> Array:
        """Return (I − KC̄) Σ (I − KC̄)ᵀ + K R Kᵀ, symmetric and positive for any gain."""
        closed = self.identity - gain @ self.C
        result = closed @ covariance @ transposed(closed) + gain @ self.R @ transposed(gain)
        return np.asarray(0.5 * (result + transposed(result)))

    def disturbance(self, x: Array) -> Array:
        """Return ω = H w, shape (..., p)."""
        return matvec(self.H, self.exosystem(x))

    def disturbance_rate(self, x: Array) -> Array:
        """Return dω/dt as modelled, shape (..., p)."""
        return matvec(self.rate_map, self.exosystem(x))

    def exosystem(self, x: Array) -> Array:
        """Return the disturbance's states w of augmented states, shape (..., q)."""
        return x[..., x.shape[-1] - self.H.shape[-1] :]


class ObserverState(NamedTuple):
    """All that the observer carries from one step to the next.

    Attributes:
        x: Augmented estimate in design coordinates, shape (..., n).
        covariance: Error covariance, or its certified bound, shape (..., n, n) or (n, n).
        settling: Least time for which Riccati gains are still used [s]; a batch shares one
            measurement schedule.
        certified: Whether the certificate's bound covers the covariance and its gain is in use.
        corrected: Whether a measurement was used since the last prediction.
        gap: In a gap, the covariance with that of the unknown torque, shape (..., n + 2, n + 2);
            see `GapFlow`. None in regular steps.
    """

    x: Array
    covariance: Array
    settling: float
    certified: bool
    corrected: bool
    gap: Array | None = None


class TSObserver:
    """The certified observer of one system, or of a batch of equal ones in step.

    Args:
        flow: Prediction model.
        measurement_covariance: R of one sample, shape (p, p).
        initial_covariance: Error covariance of the zero estimate before any sample, shape (n, n).
        certified: The constant gain and its bound.
        settle_time: Least duration of the Riccati phase [s].
        gain_mode: Whether the certified gain ever takes over.
        torque_rate: 1σ of the rate at which the torque may move in a gap, which is a step longer
            than a regular one [N m/s]; 0: it is held.

    Attributes:
        output: The measurement model.
        gap_flow: Prediction model of a gap, None if the torque is held there.

    Raises:
        ModelError: A matrix has the wrong shape, a number is negative, or there is a torque rate
            for a system that is no arm.
    """

    def __init__(
        self,
        flow: PredictionModel,
        measurement_covariance: Array,
        initial_covariance: Array,
        certified: CertifiedGain,
        settle_time: float = 5.0,
        gain_mode: GainMode = GainMode.CERTIFIED,
        torque_rate: float = 0.0,
    ) -> None:
        n, p = flow.state_count, flow.output_matrix.shape[0]
        self.flow = flow
        self.settle_time = non_negative("settle_time", settle_time)
        self.gain_mode = gain_mode
        self.gap_flow: GapFlow | None = None
        if non_negative("torque_rate", torque_rate):
            if not isinstance(flow, ArmFlow):
                raise ModelError(
                    f"torque_rate: expected 0 for any system but an arm, got {torque_rate!r}"
                )
            self.gap_flow = GapFlow(flow, torque_rate)
        self._longest = (1.0 + PERIOD_TOLERANCE) * flow.period
        self._shortest = (1.0 - PERIOD_TOLERANCE) * flow.period
        self.certified = CertifiedGain(
            as_matrix("K", certified.K, (n, p)), as_matrix("X", certified.X, (n, n))
        )
        self._initial_covariance = as_matrix("initial covariance", initial_covariance, (n, n))
        self.output = OutputModel.of(flow, as_matrix("R", measurement_covariance, (p, p)))
        X, C = self.certified.X, self.output.C
        self._posterior = self.output.joseph(X, self.certified.K)
        self._P = np.linalg.inv(X)
        self._root = np.linalg.cholesky(self._P)
        self._certified_innovation_covariance = C @ X @ C.T + self.output.R
        self._certified_std = np.sqrt(np.diag(X))
        self._certified_disturbance_std = self._disturbance_std(X)
        self._certified_physical_std = flow.to_physical(self._certified_std)

    @property
    def period(self) -> float:
        """Nominal sampling period [s]."""
        return self.flow.period

    def initial(self, batch: tuple[int, ...] = ()) -> ObserverState:
        """Return the state before any measurement: zero estimate, wide covariance."""
        n = self.flow.state_count
        covariance = np.broadcast_to(self._initial_covariance, (*batch, n, n)).copy()
        return ObserverState(np.zeros((*batch, n)), covariance, self.settle_time, False, False)

    def correct(self, state: ObserverState, y: Array) -> tuple[ObserverState, Correction]:
        """Use one measurement.

        Args:
            state: The state predicted to the measurement's stamp.
            y: Measurement, shape (..., p).

        Returns:
            The corrected state, and the innovation with its gain.
        """
        correction = self.expect(state, y)
        return self.apply(state, correction), correction

    def expect(self, state: ObserverState, y: Array) -> Correction:
        """Return the innovation of a measurement, its covariance and the gain for it."""
        innovation = y - matvec(self.output.C, state.x)
        if state.certified:
            return Correction(innovation, self._certified_innovation_covariance, self.certified.K)
        return Correction(innovation, *self.output.gain(state.covariance))

    def apply(
        self, state: ObserverState, correction: Correction, weight: float = 1.0, adapt: bool = True
    ) -> ObserverState:
        """Return the state corrected by an innovation.

        Args:
            state: The state the correction was computed from.
            correction: From `expect`.
            weight: Share of the correction to apply; the covariance shrinks as for all of it,
                since only outliers are downweighted.
            adapt: For adaptive observers; this one has no parameters.
        """
        innovation = correction.innovation if weight == 1.0 else weight * correction.innovation
        x = state.x + matvec(correction.gain, innovation)
        if state.certified:
            return ObserverState(x, self._posterior, 0.0, True, True)
        covariance = self.output.joseph(state.covariance, correction.gain)
        return ObserverState(x, covariance, state.settling, False, True)

    def predict(self, state: ObserverState, u: Array, duration: float) -> ObserverState:
        """Predict to the next stamp.

        Args:
            state: Corrected, or not if the measurement is missing.
            u: Inputs held over the step, shape (..., m).
            duration: Time to the next stamp [s], at least 0.
        """
        return self._flow(state, u, duration, between_samples=False)

    def extrapolate(self, state: ObserverState, u: Array, duration: float) -> ObserverState:
        """Predict to a time between samples; the result is read and not stepped on.

        As `predict`, except that the certified bound serves the whole interval to the next
        regular sample.
        """
        return self._flow(state, u, duration, between_samples=True)

    def _flow(
        self, state: ObserverState, u: Array, duration: float, *, between_samples: bool
    ) -> ObserverState:
        if self.stays_certified(state, duration, between_samples=between_samples):
            return self.certified_state(self.flow.predict(state.x, u, duration))
        gap = self.gap_before(state, duration)
        if gap is None or self.gap_flow is None:
            x, covariance = self.flow.predict_with_covariance(
                state.x, state.covariance, u, duration
            )
        else:
            wide, gap = self.gap_flow.predict_with_covariance(
                GapFlow.widen(state.x), gap, u, duration
            )
            x, covariance = wide[..., : self.flow.state_count], GapFlow.narrow(gap)
        return self.uncertified_state(
            state, x, covariance, duration, gap, hand_over=not between_samples
        )

    def stays_certified(
        self, state: ObserverState, duration: float, *, between_samples: bool = False
    ) -> bool:
        """Return whether the certified bound covers a step of `duration` [s] from the state.

        Args:
            state: Before the step.
            duration: [s].
            between_samples: Whether the step ends before the next sample and is only read.
        """
        if not (state.certified and state.corrected):
            return False
        return (0.0 if between_samples else self._shortest) <= duration <= self._longest

    def gap_before(self, state: ObserverState, duration: float) -> Array | None:
        """Return the covariance with the torque's before a step of `duration` [s] in a gap.

        A step is in a gap if it is longer than a regular one, or if it goes on from such a step
        without a sample. None for any other step.
        """
        if self.gap_flow is None or (state.gap is None and duration <= self._longest):
            return None
        return self.gap_flow.begin(state.covariance) if state.gap is None else state.gap

    def certified_state(self, x: Array) -> ObserverState:
        """Return the state at an estimate that was predicted under the certified bound."""
        return ObserverState(x, self.certified.X, 0.0, True, False)

    def uncertified_state(
        self,
        state: ObserverState,
        x: Array,
        covariance: Array,
        duration: float,
        gap: Array | None = None,
        *,
        hand_over: bool = True,
    ) -> ObserverState:
        """Return the state after a step that the certified bound does not cover.

        Args:
            state: Before the step.
            x: Estimate after it, shape (..., n).
            covariance: Error covariance after it, shape (..., n, n).
            duration: Length of the step [s].
            gap: In a gap, the covariance with that of the torque.
            hand_over: Whether the certified gain may take over here.
        """
        settling = max(0.0, state.settling - duration)
        if hand_over and self._covers(covariance, settling):
            return ObserverState(x, self.certified.X, 0.0, True, False, gap)
        return ObserverState(x, covariance, settling, False, False, gap)

    def end_gap(self, state: ObserverState) -> ObserverState:
        """Return the state after a sample of which only the torque is used."""
        return state if state.gap is None else state._replace(gap=None)

    def inflate_covariance(
        self, state: ObserverState, variance: Array, duration: float
    ) -> ObserverState:
        """Return the state with more uncertainty, for a change that the model does not foresee.

        Args:
            state: After a correction.
            variance: Addition to the error covariance, shape (n, n).
            duration: Least time with Riccati gains [s].
        """
        settling = max(duration, state.settling)
        return ObserverState(state.x, state.covariance + variance, settling, False, True)

    def limit_disturbance(self, state: ObserverState, limit: float) -> ObserverState:
        """Return the state with the disturbance ω = H w kept within ±limit [rad]."""
        omega = self.output.disturbance(state.x)
        inside = abs(omega[0]) <= limit if omega.shape == (1,) else (np.abs(omega) <= limit).all()
        if inside:
            return state
        excess = omega - np.clip(omega, -limit, limit)
        x = state.x.copy()
        # The smallest change of w that does it.
        self.output.exosystem(x)[...] -= excess @ np.linalg.pinv(self.output.H).T
        return state._replace(x=x)

    def readout(self, state: ObserverState) -> Readout:
        """Return the estimate and its bounds in physical units."""
        if state.certified:
            state_bound, disturbance_bound = (
                self._certified_physical_std,
                self._certified_disturbance_std,
            )
        else:
            state_bound = self.flow.to_physical(self.error_bound(state))
            disturbance_bound = self.disturbance_bound(state)
        return Readout(
            self.flow.to_physical(state.x),
            state_bound,
            self.output.disturbance(state.x),
            self.output.disturbance_rate(state.x),
            disturbance_bound,
            state.certified,
        )

    def events(self, state: ObserverState) -> dict[str, int]:
        """Return no counts: this observer is not supervised."""
        return {}

    def error_bound(self, state: ObserverState) -> Array:
        """Return the 1σ bound of each augmented state in design coordinates.

        Its shape is (..., n), or (n,) while the certified bound serves a whole batch. It is
        certified while `state.certified`; before that it is the larger of the covariance along
        the estimate and the certified bound.
        """
        if state.certified:
            return self._certified_std
        variance = np.diagonal(state.covariance, axis1=-2, axis2=-1)
        return np.maximum(np.sqrt(variance), self._certified_std)

    def disturbance_bound(self, state: ObserverState) -> Array:
        """Return the 1σ bound of the disturbance ω = H w [rad], shape (..., p)."""
        if state.certified:
            return self._certified_disturbance_std
        std = self._disturbance_std(state.covariance)
        return np.maximum(std, self._certified_disturbance_std)

    def covariance_ratio(self, state: ObserverState) -> float:
        """Return the mean of the error covariance relative to the certified bound, tr(PΣ)/n."""
        if state.certified:
            return 1.0
        return float(np.einsum("ij,...ji->...", self._P, state.covariance).mean()) / len(self._P)

    def _disturbance_std(self, covariance: Array) -> Array:
        H, first = self.output.H, self.flow.state_count - self.flow.disturbance.state_count
        own = covariance[..., first:, first:]
        return np.asarray(np.sqrt(np.einsum("pi,...ij,pj->...p", H, own, H)))

    def _covers(self, covariance: Array, settling: float) -> bool:
        """Return whether the certified gain may take over: settled, and Σ ⪯ X."""
        if self.gain_mode is not GainMode.CERTIFIED or settling > 0.0:
            return False
        ratio = np.linalg.eigvalsh(self._root.T @ covariance @ self._root)
        return bool(ratio.max() <= 1.0)
