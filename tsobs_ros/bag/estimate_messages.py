# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates as the JointStates that an observer publishes, each on its topic."""

from collections.abc import Callable, Mapping, Sequence

from tsobs_ros.bag.joint_states import JointStateEncoder
from tsobs_ros.estimation.records import Estimate, Innovation

STATES, STATE_BOUNDS = "joint_states", "error_bound"
DISTURBANCE, DISTURBANCE_BOUND = "disturbance", "disturbance_bound"
INNOVATION = "innovation"
PARAMETERS, PARAMETER_BOUNDS = "parameters_estimate", "parameters_bound"

TOPICS = (STATES, STATE_BOUNDS, DISTURBANCE, DISTURBANCE_BOUND, INNOVATION)
"""What every observer publishes, under its own name."""

PARAMETER_TOPICS = (PARAMETERS, PARAMETER_BOUNDS)
"""What it publishes besides where it learns parameters."""

PARAMETER_PERIOD = 100_000_000
"""Parameters change slowly: published ten times a second [ns]."""

_Known = list[tuple[int, Estimate]]


def sides(joint: str) -> tuple[str, str]:
    """Return the names of a joint's link and motor in estimates."""
    return f"{joint}_link", f"{joint}_motor"


class EstimateMessages:
    """Hands the estimates of some joints to whoever sends or writes messages.

    Args:
        send: Takes a topic, one of the names above, and the bytes of a JointState.
        learnt: By the names of the joints, those of their parameters that are learnt.
    """

    def __init__(
        self, send: Callable[[str, bytes], None], learnt: Mapping[str, Sequence[str]]
    ) -> None:
        own = [[joint] for joint in learnt]
        arms = [sides(joint) for joint in learnt]
        self._learns = any(learnt.values())
        # With several joints a parameter's name alone would not tell whose it is.
        parameters = [
            [f"{joint}/{name}" if len(learnt) > 1 else name for name in names]
            for joint, names in learnt.items()
        ]
        self._send = send
        self._names: dict[str, Sequence[Sequence[str]]] = {
            **dict.fromkeys((STATES, STATE_BOUNDS), arms),
            **dict.fromkeys((DISTURBANCE, DISTURBANCE_BOUND, INNOVATION), own),
            **dict.fromkeys(PARAMETER_TOPICS, parameters),
        }
        self._encoders: dict[tuple[str, tuple[int, ...]], JointStateEncoder] = {}
        self._parameters_due = 0

    @property
    def topics(self) -> tuple[str, ...]:
        """What may be sent on."""
        return TOPICS + PARAMETER_TOPICS if self._learns else TOPICS

    def estimates(self, stamp: int, estimates: Sequence[Estimate | None]) -> None:
        """Send the joints' estimates at a stamp [ns]; what they lack is left out.

        Args:
            stamp: Of the messages [ns].
            estimates: One entry a joint, None where there is nothing to say.
        """
        known = [(joint, one) for joint, one in enumerate(estimates) if one is not None]
        if not known:
            return
        self._motion(STATES, stamp, known, [one.state.tolist() for _, one in known])
        bounded = [item for item in known if item[1].state_bound.size]
        if bounded:
            bounds = [one.state_bound.tolist() for _, one in bounded]
            self._motion(STATE_BOUNDS, stamp, bounded, bounds)
        disturbed = [item for item in known if item[1].disturbance.size]
        if disturbed:
            values = [value for _, one in disturbed for value in one.disturbance.tolist()]
            rates = [rate for _, one in disturbed for rate in one.disturbance_rate.tolist()]
            self._message(DISTURBANCE, stamp, disturbed, values, rates)
            self._disturbance_bounds(stamp, disturbed)
        if self._learns and stamp >= self._parameters_due:
            self._parameters(stamp, [item for item in known if item[1].parameters_valid])

    def innovations(self, stamp: int, outcomes: Sequence[object]) -> None:
        """Send y − ŷ of the joints whose outcome is an innovation, stamped as measured."""
        used = [(joint, one) for joint, one in enumerate(outcomes) if isinstance(one, Innovation)]
        if used:
            values = [float(one.value[0]) for _, one in used]
            self._encoded(INNOVATION, stamp, tuple(joint for joint, _ in used), values)

    def restart(self) -> None:
        """Forget when parameters were last sent, as stamps may have gone back."""
        self._parameters_due = 0

    def _motion(self, topic: str, stamp: int, known: _Known, rows: list[list[float]]) -> None:
        positions = [value for q1, _, q2, _ in rows for value in (q1, q2)]
        velocities = [value for _, v1, _, v2 in rows for value in (v1, v2)]
        self._message(topic, stamp, known, positions, velocities)

    def _disturbance_bounds(self, stamp: int, disturbed: _Known) -> None:
        bounded = [item for item in disturbed if item[1].disturbance_bound.size]
        if bounded:
            bounds = [value for _, one in bounded for value in one.disturbance_bound.tolist()]
            self._message(DISTURBANCE_BOUND, stamp, bounded, bounds)

    def _parameters(self, stamp: int, valid: _Known) -> None:
        if valid:
            values = [value for _, one in valid for value in one.parameters.tolist()]
            bounds = [bound for _, one in valid for bound in one.parameter_bound.tolist()]
            self._message(PARAMETERS, stamp, valid, values)
            self._message(PARAMETER_BOUNDS, stamp, valid, bounds)
            self._parameters_due = stamp + PARAMETER_PERIOD

    def _message(
        self,
        topic: str,
        stamp: int,
        known: _Known,
        position: list[float],
        velocity: Sequence[float] = (),
    ) -> None:
        self._encoded(topic, stamp, tuple(joint for joint, _ in known), position, velocity)

    def _encoded(
        self,
        topic: str,
        stamp: int,
        joints: tuple[int, ...],
        position: list[float],
        velocity: Sequence[float] = (),
    ) -> None:
        encode = self._encoders.get((topic, joints))
        if encode is None:
            names = [name for joint in joints for name in self._names[topic][joint]]
            encode = self._encoders[topic, joints] = JointStateEncoder(names)
        self._send(topic, encode(stamp, position, velocity))
