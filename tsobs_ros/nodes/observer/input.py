# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples of joints in JointState messages, read from the bytes on the wire.

Building rclpy's message objects would cost more than the whole estimation.
"""

import math
import operator
import reprlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.joint_states import JointStateDecoder
from tsobs_ros.checks import Array
from tsobs_ros.design.signals import Place, Signals
from tsobs_ros.errors import MessageError
from tsobs_ros.estimation.history import REASONS, USED
from tsobs_ros.estimation.records import RejectReason

Stamps: TypeAlias = NDArray[np.int64]
Numbers: TypeAlias = Sequence[float]
Pick: TypeAlias = Callable[[Numbers], Numbers]

NOT_NAMED = -1
"""Code of a joint that a message does not name."""
WRONG = REASONS.index(RejectReason.WRONG_JOINT)
MISSING = REASONS.index(RejectReason.MISSING_INPUT)

_MAX_LAYOUTS = 256
# What follows a message's numbers, so that each number of a row has a place, and its places.
_CONSTANTS = (math.nan, 0.0)
_NOTHING, _ZERO = -2, -1


class Batch(NamedTuple):
    """Messages in the order of their stamps, N of them, with samples of k joints.

    Attributes:
        order: Their places among those that were read.
        stamps: [ns]; 0 of a message that cannot be read; shape (N,).
        y: Measured outputs of each joint, NaN if there is none, k of shape (N, p).
        u: Inputs of each joint, NaN if there is none, k of shape (N, m).
        codes: `USED` of samples, else the code of the rejection or `NOT_NAMED`, shape (k, N).
    """

    order: Sequence[int]
    stamps: Stamps
    y: list[Array]
    u: list[Array]
    codes: Stamps


class _Layout(NamedTuple):
    """Where the samples are in messages with the same names and lengths.

    Attributes:
        pick: Takes a row's numbers from a message's, which `_CONSTANTS` follow.
        codes: As those of `Batch`, of each joint.
    """

    pick: Pick
    codes: tuple[int, ...]


class MeasurementReader:
    """Finds the samples of the node's joints in messages of any joints, in any order.

    A sample has an output at least, and all inputs.

    Args:
        joints: Places of each joint's signals, by the joint's name.
        assume_zero_torque: Whether a message without effort means torque 0.
    """

    def __init__(self, joints: Mapping[str, Signals], assume_zero_torque: bool) -> None:
        self._joints = dict(joints)
        self._absent_effort = _ZERO if assume_zero_torque else _NOTHING
        self._decode = JointStateDecoder()
        # By the names and lengths of a message, which hardly ever change.
        self._layouts: dict[tuple[tuple[str, ...], int, int, int], _Layout] = {}
        # Where the outputs, inputs and other inputs of the joints are in a row.
        self._parts: list[tuple[slice, slice, slice]] = []
        end = 0
        for each in joints.values():
            parts = []
            for count in map(len, (each.outputs, each.inputs, each.other_inputs)):
                parts.append(slice(end, end + count))
                end += count
            self._parts.append((parts[0], parts[1], parts[2]))
        self._unreadable = [math.nan] * end, (WRONG,) * len(joints)

    def read(self, messages: Sequence[bytes]) -> Batch:
        """Return the samples in messages, in the order of the messages' stamps.

        Bytes that are no JointState, and messages with none of the joints, are wrong for all.
        """
        rows = [self._read(data) for data in messages]
        order = sorted(range(len(rows)), key=[row[0] for row in rows].__getitem__)
        stamps, numbers, codes = zip(*[rows[place] for place in order], strict=True)
        table, y, u = np.array(numbers, np.float64), [], []
        for outputs, inputs, others in self._parts:
            y.append(np.ascontiguousarray(table[:, outputs]))
            own = np.ascontiguousarray(table[:, inputs])
            if others.start < others.stop:
                own = np.where(np.isnan(own), table[:, others], own)
            u.append(own)
        return Batch(order, np.array(stamps, np.int64), y, u, np.array(codes, np.int64).T.copy())

    def _read(self, data: bytes) -> tuple[int, Numbers, tuple[int, ...]]:
        try:
            stamp, names, position, velocity, effort, _ = self._decode(data)
        except MessageError:
            return 0, *self._unreadable
        key = (names, len(position), len(velocity), len(effort))
        layout = self._layouts.get(key) or self._find(*key)
        if layout.codes.count(NOT_NAMED) == len(layout.codes):
            return 0, *self._unreadable
        return stamp, layout.pick(position + velocity + effort + _CONSTANTS), layout.codes

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
        """Return the layout of messages with these names and numbers of values."""
        if len(self._layouts) >= _MAX_LAYOUTS:
            self._layouts.clear()
        # Of a name that comes twice, the first.
        found = {name: place for place, name in reversed(list(enumerate(names)))}
        parts = {
            "position": (0, positions),
            "velocity": (positions, velocities),
            "effort": (positions + velocities, efforts),
        }

        def place_of(place: Place) -> int:
            begin, length = parts[place.field]
            index = found.get(place.name, length)
            if index < length:
                return begin + index
            return self._absent_effort if place.field == "effort" and not efforts else _NOTHING

        picked, codes = [], []
        for each in self._joints.values():
            outputs, inputs, others = (
                [place_of(place) for place in places]
                for places in (each.outputs, each.inputs, each.other_inputs)
            )
            for index, other in enumerate(others):
                if inputs[index] == _NOTHING:
                    inputs[index] = other
            picked += outputs + inputs + others
            measured = any(place != _NOTHING for place in outputs)
            if measured and _NOTHING not in inputs:
                codes.append(USED)
            elif each.entries.isdisjoint(found):
                codes.append(NOT_NAMED)
            else:
                codes.append(MISSING if measured else WRONG)
        layout = self._layouts[names, positions, velocities, efforts] = _Layout(
            picker(picked), tuple(codes)
        )
        return layout


def picker(places: Sequence[int]) -> Pick:
    """Return what takes the numbers at some places out of others."""
    if len(places) > 1:
        return operator.itemgetter(*places)
    return lambda numbers: [numbers[place] for place in places]
