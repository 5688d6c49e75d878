# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""JointState messages in, estimates out: the observer node's only knowledge of messages.

Messages are read and written as the bytes on the wire. Building, converting and taking rclpy's
message objects would cost more than all that is estimated.
"""

import reprlib
from collections.abc import Mapping, Sequence

import numpy as np
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from tsobs_ros.bag.messages import estimate_topics as topics
from tsobs_ros.bag.messages.joint_states import JointStateDecoder, JointStateEncoder
from tsobs_ros.checks import Array
from tsobs_ros.errors import MessageError
from tsobs_ros.estimation.records import (
    Estimate,
    Innovation,
    Measurement,
    RejectReason,
    Sample,
)

MEASUREMENT_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Sensor data, with room for a second of samples: the queue is only emptied once a tick."""

_RELIABLE = 10

_KNOWN_LAYOUTS = 64
_KNOWN_SUBSETS = 256


class MeasurementReader:
    """Finds the samples of the node's joints in messages of any joints, in any order.

    Args:
        joints: Names of the joints.
        assume_zero_torque: Whether a message without effort means torque 0.
    """

    def __init__(self, joints: Sequence[str], assume_zero_torque: bool) -> None:
        self._joints = tuple(joints)
        self._assume_zero_torque = assume_zero_torque
        self._decode = JointStateDecoder()
        # Where the joints are, by the names in a message, which hardly ever change.
        self._places: dict[tuple[str, ...], list[int | None]] = {}

    def read(self, data: bytes) -> list[Sample]:
        """Return for each joint its sample, why that is none, or None if it is not in there.

        Bytes that are no JointState, and messages with none of the joints, are wrong for all.
        """
        try:
            stamp, names, position, _, effort, _ = self._decode(data)
        except MessageError:
            return [RejectReason.WRONG_JOINT] * len(self._joints)
        places = self._places.get(names) or self._find(names)
        if not any(place is not None for place in places):
            return [RejectReason.WRONG_JOINT] * len(self._joints)
        if self._assume_zero_torque and not effort:
            effort = (0.0,) * len(position)
        count = min(len(position), len(effort))
        return [
            None
            if place is None
            else Measurement(stamp, np.array([position[place]]), np.array([effort[place]]))
            if place < count
            else RejectReason.WRONG_JOINT
            for place in places
        ]

    def describe(self, data: bytes, joint: str) -> str:
        """Return what a message has to say of a joint, for people who wonder why it is refused."""
        try:
            message = self._decode(data)
        except MessageError as error:
            return f"not a JointState: {error}"
        if joint not in message.names:
            # Whoever sends it decides how many names there are, and how long.
            names = reprlib.repr(list(message.names))
            return f"expected {', '.join(self._joints)}; got names {names}"
        place, said = message.names.index(joint), f"stamp {message.stamp * 1e-9:.3f}"
        for field in ("position", "effort"):
            numbers = getattr(message, field)
            value = numbers[place] if place < len(numbers) else f"missing ({len(numbers)} in all)"
            said += f", {field} {value}"
        return said

    def _find(self, names: tuple[str, ...]) -> list[int | None]:
        if len(self._places) >= _KNOWN_LAYOUTS:
            self._places.clear()
        # Of a name that comes twice, the first.
        found = {name: place for place, name in reversed(list(enumerate(names)))}
        self._places[names] = places = [found.get(joint) for joint in self._joints]
        return places


class _Output:
    """A publisher of JointStates of any of some names."""

    def __init__(self, node: Node, topic: str, names: Sequence[Sequence[str]]) -> None:
        # Every QoS event is one more thing the executor gathers for each of its waits.
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        self._publisher = node.create_publisher(JointState, topic, _RELIABLE, event_callbacks=quiet)
        self._names = names
        self._encoders: dict[tuple[int, ...], JointStateEncoder] = {}

    def publish(
        self,
        stamp: int,
        joints: tuple[int, ...],
        position: Sequence[float],
        velocity: Sequence[float] = (),
    ) -> None:
        """Send the positions, and the velocities where there are any, of joints by their index."""
        handle = self._publisher.handle
        if not handle.get_subscription_count():
            return  # nobody would ever get it, and to ask costs a tenth of sending it
        encode = self._encoders.get(joints)
        if encode is None:
            if len(self._encoders) >= _KNOWN_SUBSETS:
                self._encoders.clear()
            names = [name for joint in joints for name in self._names[joint]]
            encode = self._encoders[joints] = JointStateEncoder(names)
        handle.publish_raw(encode(stamp, position, velocity))


class EstimatePublisher:
    """Publishes estimates, innovations and parameters under the node's private names.

    Args:
        node: The node.
        learnt: By the names of the joints, those of their parameters that are learnt; there are
            topics of them only if there are any.
    """

    def __init__(self, node: Node, learnt: Mapping[str, tuple[str, ...]]) -> None:
        def output(topic: str, names: Sequence[Sequence[str]]) -> _Output:
            return _Output(node, f"~/{topic}", names)

        joints = [[joint] for joint in learnt]
        sides = [topics.sides(joint) for joint in learnt]
        self._states = output(topics.STATES, sides)
        self._state_bounds = output(topics.STATE_BOUNDS, sides)
        self._disturbance = output(topics.DISTURBANCE, joints)
        self._disturbance_bound = output(topics.DISTURBANCE_BOUND, joints)
        self._innovation = output(topics.INNOVATION, joints)
        self._parameters: _Output | None = None
        if any(learnt.values()):
            names = [
                topics.parameter_names(joint, own, alone=len(learnt) == 1)
                for joint, own in learnt.items()
            ]
            self._parameters = output(topics.PARAMETERS, names)
            self._parameter_bounds = output(topics.PARAMETER_BOUNDS, names)
        self._parameters_due = 0

    def publish(self, stamp: int, estimates: Sequence[Estimate | None]) -> bool:
        """Publish the joints' estimates at a stamp [ns]; what they lack is left out.

        Args:
            stamp: Of the messages [ns].
            estimates: One entry a joint, None where there is nothing to say.

        Returns:
            Whether there was anything to say.
        """
        known = [(joint, each) for joint, each in enumerate(estimates) if each is not None]
        if not known:
            return False
        self._states.publish(stamp, _indices(known), *_motion([each.state for _, each in known]))
        bounded = [item for item in known if item[1].state_bound.size]
        if bounded:
            bounds = _motion([each.state_bound for _, each in bounded])
            self._state_bounds.publish(stamp, _indices(bounded), *bounds)
        self._publish_disturbances(stamp, [item for item in known if item[1].disturbance.size])
        if self._parameters is not None and stamp >= self._parameters_due:
            self._publish_parameters(stamp, [item for item in known if item[1].parameters_valid])
        return True

    def publish_innovations(self, stamp: int, outcomes: Sequence[object]) -> None:
        """Publish y − ŷ of the joints whose outcome is an innovation, stamped as measured."""
        used = [
            (joint, each) for joint, each in enumerate(outcomes) if isinstance(each, Innovation)
        ]
        if used:
            values = [float(each.value[0]) for _, each in used]
            self._innovation.publish(stamp, tuple(joint for joint, _ in used), values)

    def restart(self) -> None:
        """Forget when parameters were last published, as stamps may have gone back."""
        self._parameters_due = 0

    def _publish_disturbances(self, stamp: int, disturbed: list[tuple[int, Estimate]]) -> None:
        if not disturbed:
            return
        values = [value for _, each in disturbed for value in each.disturbance.tolist()]
        rates = [rate for _, each in disturbed for rate in each.disturbance_rate.tolist()]
        self._disturbance.publish(stamp, _indices(disturbed), values, rates)
        bounded = [item for item in disturbed if item[1].disturbance_bound.size]
        if bounded:
            bounds = [bound for _, each in bounded for bound in each.disturbance_bound.tolist()]
            self._disturbance_bound.publish(stamp, _indices(bounded), bounds)

    def _publish_parameters(self, stamp: int, valid: list[tuple[int, Estimate]]) -> None:
        if not valid or self._parameters is None:
            return
        values = [value for _, each in valid for value in each.parameters.tolist()]
        bounds = [bound for _, each in valid for bound in each.parameter_bound.tolist()]
        self._parameters.publish(stamp, _indices(valid), values)
        self._parameter_bounds.publish(stamp, _indices(valid), bounds)
        self._parameters_due = stamp + topics.PARAMETER_PERIOD


def _motion(states: Sequence[Array]) -> tuple[list[float], list[float]]:
    """Return the angles and the velocities in several [q₁, q̇₁, q₂, q̇₂]."""
    angles: list[float] = []
    velocities: list[float] = []
    for state in states:
        q1, v1, q2, v2 = state.tolist()
        angles += (q1, q2)
        velocities += (v1, v2)
    return angles, velocities


def _indices(items: list[tuple[int, Estimate]]) -> tuple[int, ...]:
    return tuple(joint for joint, _ in items)
