# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples of joints in JointStates, for a node or from a bag: outputs, inputs and rejections.

They are read from the bytes on the wire: rclpy's message objects would take more time than the
whole estimation.
"""

import math
import reprlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import accumulate, chain, pairwise, zip_longest
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsobs_ros.bag.joint_states import JointStateDecoder
from tsobs_ros.checks import Array
from tsobs_ros.design.signals import Place, Signals
from tsobs_ros.errors import MessageError
from tsobs_ros.estimation.records import USED, RejectReason
from tsobs_ros.series import Stamps

if TYPE_CHECKING:
    from tsobs_ros.bag.reader import RawMessages  # which needs a library that nodes lack

NOT_NAMED = -1
"""Code of a joint that a message does not name."""
WRONG, MISSING = map(int, (RejectReason.WRONG_JOINT, RejectReason.MISSING_INPUT))

# Constants behind a message's numbers, for numbers of a row that it lacks; their places.
_CONSTANTS = (math.nan, 0.0)
_NOTHING, _ZERO = -2, -1
# A limit, because any publisher may choose the names in messages.
_MAX_LAYOUTS = 256


class Batch(NamedTuple):
    """N messages, in the order of their stamps or as recorded, with samples of k joints.

    Attributes:
        order: Their places among the messages that were read.
        stamps: [ns], 0 for a message that cannot be read, shape (N,).
        y: Measured outputs of each joint, NaN if there is none, k arrays of shape (N, p).
        u: Inputs of each joint, NaN if there is none, k arrays of shape (N, m).
        codes: `USED` for samples, else the code of the rejection or `NOT_NAMED`, shape (k, N).
    """

    order: Sequence[int]
    stamps: Stamps
    y: list[Array]
    u: list[Array]
    codes: Stamps


class MeasurementReader:
    """Finds the samples of the node's joints in messages of any joints, in any order.

    A sample has at least one output, and all inputs. A motor's own entry is that of its sensor,
    unless it is the name of a joint.
    """

    def __init__(self, joints: Mapping[str, Signals], assume_zero_torque: bool) -> None:
        self._joints = dict(joints)
        self._absent_effort = _ZERO if assume_zero_torque else _NOTHING
        self._decode = JointStateDecoder()
        # Messages hardly ever change their names and lengths.
        self._layout = lru_cache(_MAX_LAYOUTS)(self._find)
        # The places of each joint's outputs, inputs and other inputs in a row.
        self._parts: list[list[slice]] = []
        end = 0
        for each in joints.values():
            counts = map(len, (each.outputs, each.inputs, each.other_inputs))
            ends = list(accumulate(counts, initial=end))
            self._parts.append([slice(*pair) for pair in pairwise(ends)])
            end = ends[-1]
        self._unreadable = [math.nan] * end, (WRONG,) * len(joints)
        self._found = set[int]()  # places in a row for which any message had a number

    def read(self, messages: Sequence[bytes]) -> Batch:
        """Return the samples in messages, in the order of the messages' stamps.

        Bytes that are no JointState, and messages with none of the joints, are wrong for all.
        """
        rows = [self._read(data) for data in messages]
        order = sorted(range(len(rows)), key=[row[0] for row in rows].__getitem__)
        stamps, numbers, codes = zip(*[rows[place] for place in order], strict=True)
        y, u = self._split(np.array(numbers, np.float64))
        return Batch(
            order, np.array(stamps, np.int64), y, u, np.array(list(zip(*codes, strict=True)))
        )

    def read_raw(self, raw: "RawMessages") -> Batch:
        """Return the samples in messages of a bag, in the order of recording."""
        count, (nothing, wrong) = len(raw.log_times), self._unreadable
        stamps, table = np.zeros(count, np.int64), np.full((count, len(nothing)), math.nan)
        codes = np.full((len(wrong), count), WRONG)
        for group in chain.from_iterable(self._decode.decode_rows(*one) for one in raw.groups):
            at, fields = group.places, group[3:]
            picked, of_joints = self._layout(group.names, *(each.shape[1] for each in fields))
            stamps[at] = group.stamps
            if any(code != NOT_NAMED for code in of_joints):
                constants = np.broadcast_to(_CONSTANTS, (len(at), len(_CONSTANTS)))
                table[at] = np.hstack([*fields, constants])[:, picked]
                codes[:, at] = np.array(of_joints)[:, np.newaxis]
        y, u = self._split(table)
        return Batch(range(count), stamps, y, u, codes)

    def found(self) -> list[list[bool]]:
        """Return for each output of each joint whether any message has had it, even as NaN."""
        return [
            [place in self._found for place in range(outputs.start, outputs.stop)]
            for outputs, _, _ in self._parts
        ]

    def _split(self, table: Array) -> tuple[list[Array], list[Array]]:
        """Return the outputs and the inputs of each joint."""
        y, u = [], []
        for outputs, inputs, others in self._parts:
            y.append(table[:, outputs])
            own = table[:, inputs]
            if others.start < others.stop:
                own = np.where(np.isnan(own), table[:, others], own)
            u.append(own)
        return y, u

    def _read(self, data: bytes) -> tuple[int, Sequence[float], tuple[int, ...]]:
        try:
            stamp, names, position, velocity, effort, _ = self._decode(data)
        except MessageError:
            return 0, *self._unreadable
        picked, codes = self._layout(names, len(position), len(velocity), len(effort))
        if codes.count(NOT_NAMED) == len(codes):
            return 0, *self._unreadable
        numbers = position + velocity + effort + _CONSTANTS
        return stamp, [numbers[place] for place in picked], codes

    def describe(self, data: bytes, joint: str) -> str:
        """Return a message's numbers of a joint as text, for the log line of its rejection."""
        try:
            message = self._decode(data)
        except MessageError as error:
            return f"not a JointState: {error}"
        own, text = self._joints[joint], f"stamp {message.stamp * 1e-9:.3f}"
        for place in dict.fromkeys(own.outputs + own.inputs):
            named = zip(message.names, getattr(message, place.field), strict=False)
            number = next((str(number) for name, number in named if name == place.name), "missing")
            text += f", {place.described} {number}"
        # The publisher decides how many names there are, and how long.
        return f"{text}, names {reprlib.repr(list(message.names))}"

    def _find(
        self, names: tuple[str, ...], positions: int, velocities: int, efforts: int
    ) -> tuple[list[int], tuple[int, ...]]:
        """Return where messages with these names and lengths have the numbers of a row, and codes.

        The codes of the joints are those of `Batch`. If a name comes twice, the first one counts.
        """
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

        picked, codes = list[int](), []
        for each in self._joints.values():
            own = {place.name for place in each.other_outputs}
            has_own = own & found.keys() - self._joints.keys()
            outputs, inputs, others = (
                [place_of(place) for place in places]
                for places in (
                    each.other_outputs if has_own else each.outputs,
                    each.inputs,
                    each.other_inputs,
                )
            )
            picked += outputs + inputs + others
            measured = any(place != _NOTHING for place in outputs)
            fed = all(
                {*pair} != {_NOTHING} for pair in zip_longest(inputs, others, fillvalue=_NOTHING)
            )
            if measured and fed:
                codes.append(USED)
            elif each.entries.isdisjoint(found):
                codes.append(NOT_NAMED)
            else:
                codes.append(MISSING if measured else WRONG)
        self._found |= {place for place, number in enumerate(picked) if number >= 0}
        return picked, tuple(codes)
