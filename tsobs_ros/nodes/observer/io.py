# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""JointState messages in and estimates out, as the bytes on the wire.

Building, converting and taking rclpy's message objects would cost more than the whole estimation.
"""

import math
import operator
import reprlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_states import JointStateDecoder, JointStateEncoder
from tsobs_ros.checks import Array, Flags
from tsobs_ros.design.signals import Place, Signals
from tsobs_ros.errors import MessageError
from tsobs_ros.estimation.records import Estimate
from tsobs_ros.nodes.observer.rejections import MISSING, WRONG

MEASUREMENT_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Sensor data, with room for a second of samples: the queue is only emptied once a tick."""

_RELIABLE = QoSProfile(depth=10)
_RESTARTS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_MAX_KNOWN = 256
_CONSTANTS = (math.nan, 0.0)
"""What follows a message's numbers, so that each number of a row has a place."""
_NOTHING, _ZERO = -2, -1
"""The places of the constants."""

Stamps: TypeAlias = NDArray[np.int64]
_Numbers: TypeAlias = Sequence[float]
_Pick: TypeAlias = Callable[[_Numbers], _Numbers]
_Row: TypeAlias = tuple[int, _Numbers, list[bool], list[int]]
"""Of a message: its stamp, its numbers, which joints it has a sample of, and `_Layout.wrong`."""
_Values: TypeAlias = tuple[int, _Numbers, _Numbers]
"""Of a message's part: its index, its positions and its velocities."""


class Batch(NamedTuple):
    """Messages in the order of their stamps, N of them, with samples of k joints.

    Attributes:
        order: Their places among those that were read.
        stamps: [ns]; 0 of a message that cannot be read; shape (N,).
        y: Measured outputs of each joint, NaN if there is none, k of shape (N, p).
        u: Inputs of each joint, NaN if there is none, k of shape (N, m).
        given: Whether a message has a sample of a joint, shape (k, N); None: all have.
        wrong: The code of the rejection if it should have one and has none, else 0, shape (k, N);
            None: all 0.
    """

    order: Sequence[int]
    stamps: Stamps
    y: list[Array]
    u: list[Array]
    given: Flags | None
    wrong: Stamps | None


class _Layout(NamedTuple):
    """Where the samples are in messages with the same names and lengths.

    Attributes:
        pick: Takes a row's numbers from a message's, which `_CONSTANTS` follow.
        given: Whether there is a sample of each joint.
        wrong: The code of the rejection if there should be one and is none, else 0.
        known: Whether any of the joints is named.
    """

    pick: _Pick
    given: list[bool]
    wrong: list[int]
    known: bool


class MeasurementReader:
    """Finds the samples of the node's joints in messages of any joints, in any order.

    A sample has an output at least, and all inputs.

    Args:
        joints: Places of each joint's signals, by the joint's name.
        assume_zero_torque: Whether a message without effort means torque 0.
    """

    def __init__(self, joints: Mapping[str, Signals], assume_zero_torque: bool) -> None:
        self._joints = dict(joints)
        self._assume_zero_torque = assume_zero_torque
        self._decode = JointStateDecoder()
        # By the names and lengths of a message, which hardly ever change.
        self._layouts: dict[tuple[tuple[str, ...], int, int, int], _Layout] = {}
        # Where the outputs, inputs and other inputs of the joints are in a row, and how many.
        self._outputs: list[tuple[int, int]] = []
        self._inputs: list[tuple[int, int]] = []
        self._other_inputs: dict[int, tuple[int, int]] = {}
        end = 0
        for joint, each in enumerate(joints.values()):
            p, m, others = map(len, (each.outputs, each.inputs, each.other_inputs))
            self._outputs.append((end, p))
            self._inputs.append((end + p, m))
            if others:
                self._other_inputs[joint] = end + p + m, others
            end += p + m + others
        count = len(joints)
        self._all = [True] * count
        self._unreadable: _Row = (0, [math.nan] * end, [False] * count, [WRONG] * count)

    def read(self, messages: Sequence[bytes]) -> Batch:
        """Return the samples in messages, in the order of the messages' stamps.

        Bytes that are no JointState, and messages with none of the joints, are wrong for all.
        """
        rows = [self._read(data) for data in messages]
        order = sorted(range(len(rows)), key=[row[0] for row in rows].__getitem__)
        stamps, numbers, given, wrong = zip(*[rows[place] for place in order], strict=True)
        complete = all(each is self._all for each in given)
        table = np.ascontiguousarray(np.array(numbers, np.float64).T)
        columns = list(table[..., np.newaxis])
        y, u = _joined(columns, self._outputs), _joined(columns, self._inputs)
        for joint, part in self._other_inputs.items():
            (others,) = _joined(columns, [part])
            u[joint] = np.where(np.isnan(u[joint]), others, u[joint])
        return Batch(
            order,
            np.array(stamps, np.int64),
            y,
            u,
            None if complete else np.array(given, np.bool_).T,
            None if complete else np.array(wrong, np.int64).T,
        )

    def _read(self, data: bytes) -> _Row:
        try:
            stamp, names, position, velocity, effort, _ = self._decode(data)
        except MessageError:
            return self._unreadable
        key = (names, len(position), len(velocity), len(effort))
        layout = self._layouts.get(key) or self._find(*key)
        if not layout.known:
            return self._unreadable
        numbers = layout.pick(position + velocity + effort + _CONSTANTS)
        return stamp, numbers, layout.given, layout.wrong

    def describe(self, data: bytes, joint: str) -> str:
        """Return what a message contains of a joint, for the log line of its rejection."""
        try:
            message = self._decode(data)
        except MessageError as error:
            return f"not a JointState: {error}"
        # The publisher decides how many names there are, and how long.
        names = reprlib.repr(list(message.names))
        own = self._joints[joint]
        if own.entries.isdisjoint(message.names):
            expected = dict.fromkeys(
                place.name for each in self._joints.values() for place in each.outputs + each.inputs
            )
            return f"expected {', '.join(expected)}; got names {names}"
        text = f"stamp {message.stamp * 1e-9:.3f}"
        for place in own.outputs + own.inputs:
            text += f", {place.field} " if place.name == joint else f", {place.described} "
            if place.name not in message.names:
                text += f"missing (names {names})"
                continue
            index, numbers = message.names.index(place.name), getattr(message, place.field)
            there = index < len(numbers)
            text += str(numbers[index]) if there else f"missing ({len(numbers)} in all)"
        return text

    def _find(
        self, names: tuple[str, ...], positions: int, velocities: int, efforts: int
    ) -> _Layout:
        if len(self._layouts) >= _MAX_KNOWN:
            self._layouts.clear()
        # Of a name that comes twice, the first.
        found = {name: place for place, name in reversed(list(enumerate(names)))}
        parts = {
            "position": (0, positions),
            "velocity": (positions, velocities),
            "effort": (positions + velocities, efforts),
        }
        absent_effort = _ZERO if self._assume_zero_torque and not efforts else _NOTHING

        def places_of(wanted: Sequence[Place]) -> list[int]:
            places = []
            for name, field in wanted:
                begin, length = parts[field]
                index = found.get(name, length)
                absent = absent_effort if field == "effort" else _NOTHING
                places.append(begin + index if index < length else absent)
            return places

        picked, given, wrong = [], [], []
        for each in self._joints.values():
            outputs, inputs, others = map(places_of, (each.outputs, each.inputs, each.other_inputs))
            for index, other in enumerate(others):
                if inputs[index] == _NOTHING:
                    inputs[index] = other
            measured = any(place != _NOTHING for place in outputs)
            there = measured and _NOTHING not in inputs
            picked += outputs + inputs + others
            given.append(there)
            named = not there and not each.entries.isdisjoint(found)
            wrong.append(named * (MISSING if measured else WRONG))
        layout = _Layout(
            _picker(picked), self._all if all(given) else given, wrong, any(given) or any(wrong)
        )
        self._layouts[names, positions, velocities, efforts] = layout
        return layout


def _joined(columns: list[Array], parts: Sequence[tuple[int, int]]) -> list[Array]:
    """Return each part, its columns side by side in one piece of memory; it may have none."""
    nothing = columns[0][:, :0]
    return [
        columns[first]
        if count == 1
        else np.concatenate([nothing, *columns[first : first + count]], axis=1)
        for first, count in parts
    ]


def _picker(places: Sequence[int]) -> _Pick:
    """Return what takes the numbers at some places out of others."""
    if len(places) > 1:
        return operator.itemgetter(*places)
    return lambda numbers: [numbers[place] for place in places]


class _Output:
    """A publisher of JointStates of any of some parts, each with its names.

    Args:
        node: The node.
        topic: Below the node's name.
        names: Of each part.
        qos: Of the topic.
        is_effort: Whether the messages have efforts in place of positions and velocities.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        names: Sequence[Sequence[str]],
        qos: QoSProfile = _RELIABLE,
        *,
        is_effort: bool = False,
    ) -> None:
        # Every QoS event is one more thing the executor gathers for each of its waits.
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        self._publisher = node.create_publisher(
            JointState, f"~/{topic}", qos, event_callbacks=quiet
        )
        self._latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self._names, self._is_effort = names, is_effort
        self._encoders: dict[tuple[int, ...], JointStateEncoder] = {}

    @property
    def is_heard(self) -> bool:
        """Whether there may be a listener."""
        return self._latched or bool(self._publisher.get_subscription_count())

    def publish(self, stamp: int, rows: Sequence[_Values]) -> None:
        """Send one message of all the rows' parts, if it has any and there may be a listener."""
        if not rows or not self.is_heard:
            return
        parts = tuple([row[0] for row in rows])
        encode = self._encoders.get(parts)
        if encode is None:
            if len(self._encoders) >= _MAX_KNOWN:
                self._encoders.clear()
            names = [name for part in parts for name in self._names[part]]
            encode = self._encoders[parts] = JointStateEncoder(names)
        positions = [value for row in rows for value in row[1]]
        if self._is_effort:
            self._publisher.publish(encode(stamp, effort=positions))
            return
        velocities = [value for row in rows for value in row[2]]
        if velocities and len(velocities) < len(positions):
            # A velocity for each name or none at all: those of an arm beside a T–S system.
            velocities = [value for row in rows for value in row[2] or [math.nan] * len(row[1])]
        self._publisher.publish(encode(stamp, positions, velocities))


class EstimatePublisher:
    """Publishes estimates, innovations and parameters under the node's private names.

    Args:
        node: The node.
        joints: Places of each joint's signals, by the joint's name; there are topics of torque
            disturbances only if there are any.
        learnt: Names of the learnt parameters of each joint; there are topics of them only if
            there are any.
    """

    def __init__(
        self, node: Node, joints: Mapping[str, Signals], learnt: Sequence[tuple[str, ...]]
    ) -> None:
        names, places = [[joint] for joint in joints], list(joints.values())
        states = [list(dict.fromkeys(place.name for place in each.states)) for each in places]
        self._motions = [
            tuple(
                _picker([i for i, place in enumerate(each.states) if place.field == field])
                for field in ("position", "velocity")
            )
            for each in places
        ]
        self._states = _Output(node, topics.STATES, states)
        self._state_bounds = _Output(node, topics.STATE_BOUNDS, states)
        disturbances = [each.disturbances for each in places]
        self._disturbance = _Output(node, topics.DISTURBANCE, disturbances)
        self._disturbance_bound = _Output(node, topics.DISTURBANCE_BOUND, disturbances)
        self._innovation = _Output(
            node, topics.INNOVATION, [[name] for own in disturbances for name in own]
        )
        self._restarts = _Output(node, topics.RESTARTS, names, _RESTARTS)
        alone = len(joints) == 1
        own = [topics.parameter_names(joint, topics.CONDITIONS, alone=alone) for joint in joints]
        self._health = _Output(node, topics.HEALTH, own)
        self._joint_count = len(joints)
        self._parameters: tuple[_Output, _Output] | None = None
        if any(learnt):
            own = [
                topics.parameter_names(joint, each, alone=alone)
                for joint, each in zip(joints, learnt, strict=True)
            ]
            self._parameters = (
                _Output(node, topics.PARAMETERS, own),
                _Output(node, topics.PARAMETER_BOUNDS, own),
            )
        self._parameters_due = 0
        self._torques: tuple[_Output, _Output] | None = None
        torques = [[place.name for place in each.torques] for each in places]
        if any(torques):
            self._torques = (
                _Output(node, topics.TORQUE_DISTURBANCE, torques, is_effort=True),
                _Output(node, topics.TORQUE_DISTURBANCE_BOUND, torques, is_effort=True),
            )

    def publish(self, stamp: int, estimates: Sequence[Estimate | None]) -> bool:
        """Publish the joints' estimates at a stamp [ns]; what they lack is left out.

        Args:
            stamp: Of the messages [ns].
            estimates: One entry a joint; None if it has no estimate.

        Returns:
            Whether there was an estimate.
        """
        known = [(joint, each) for joint, each in enumerate(estimates) if each is not None]
        if not known:
            return False
        self._states.publish(stamp, [self._motion(joint, each.state) for joint, each in known])
        self._state_bounds.publish(
            stamp,
            [
                self._motion(joint, each.state_bound)
                for joint, each in known
                if each.state_bound.size
            ],
        )
        disturbed = [(joint, each) for joint, each in known if each.disturbance.size]
        self._disturbance.publish(
            stamp,
            [
                (joint, each.disturbance.tolist(), each.disturbance_rate.tolist())
                for joint, each in disturbed
            ],
        )
        self._disturbance_bound.publish(
            stamp,
            [
                (joint, each.disturbance_bound.tolist(), ())
                for joint, each in disturbed
                if each.disturbance_bound.size
            ],
        )
        if self._torques is not None:
            torques, bounds = self._torques
            pushed = [(joint, each) for joint, each in known if each.torque_disturbance.size]
            torques.publish(
                stamp, [(joint, each.torque_disturbance.tolist(), ()) for joint, each in pushed]
            )
            bounds.publish(
                stamp,
                [
                    (joint, each.torque_disturbance_bound.tolist(), ())
                    for joint, each in pushed
                    if each.torque_disturbance_bound.size
                ],
            )
        if self._parameters is not None and stamp >= self._parameters_due:
            valid = [(joint, each) for joint, each in known if each.parameters_valid]
            values, bounds = self._parameters
            values.publish(stamp, [(joint, each.parameters.tolist(), ()) for joint, each in valid])
            bounds.publish(
                stamp, [(joint, each.parameter_bound.tolist(), ()) for joint, each in valid]
            )
            if valid:
                self._parameters_due = stamp + topics.SLOW_PERIOD
        return True

    def publish_innovations(self, stamps: Stamps, innovations: Array) -> None:
        """Publish y − ŷ of messages, stamped as they are.

        Args:
            stamps: Of the messages [ns], shape (N,).
            innovations: Of the outputs of all joints, one after the other, NaN of those that are
                not used, shape (N, outputs).
        """
        if not self._innovation.is_heard:
            return
        for stamp, values in zip(stamps.tolist(), innovations.tolist(), strict=True):
            self._innovation.publish(
                stamp,
                [(output, (each,), ()) for output, each in enumerate(values) if each == each],
            )

    def publish_health(self, stamp: int, estimates: Sequence[Estimate | None]) -> None:
        """Publish what the joints' estimates are worth.

        Args:
            stamp: Of the estimates [ns].
            estimates: One entry a joint; None if it has none.
        """
        self._health.publish(
            stamp,
            [(joint, each.health, ()) for joint, each in enumerate(estimates) if each],
        )

    def publish_restart(self, stamp: int, number: int) -> None:
        """Publish that the joints have no past from now on, for those who come later too.

        Args:
            stamp: Time on the node's clock [ns].
            number: Number of restarts up to this one, 0 at the start.
        """
        count = float(number)
        self._restarts.publish(stamp, [(joint, (count,), ()) for joint in range(self._joint_count)])

    def restart(self) -> None:
        """Let parameters be published again at once, as stamps may have gone back."""
        self._parameters_due = 0

    def _motion(self, joint: int, state: Array) -> _Values:
        """Return states as positions and velocities."""
        (positions, velocities), values = self._motions[joint], state.tolist()
        return joint, positions(values), velocities(values)
