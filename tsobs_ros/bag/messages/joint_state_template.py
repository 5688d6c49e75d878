# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""JointStates that have the same names and lengths, packed and unpacked at once.

The messages of a topic nearly always do: only the stamp and the numbers change.
"""

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.messages.cdr import HEADER
from tsobs_ros.checks import Array

NANOSECONDS = 1_000_000_000
CONSTANT = HEADER + 8
"""Where what comes after the stamp begins."""

Places = NDArray[np.intp]
"""Which messages of a sequence, ascending."""


class JointState(NamedTuple):
    """One message.

    Attributes:
        stamp: Of its header, ns since the epoch.
        names: The joints.
        position: Of each joint [rad or m], or empty.
        velocity: Of each joint [rad/s or m/s], or empty.
        effort: Of each joint [N m or N], or empty.
        frame_id: Of its header.
    """

    stamp: int
    names: tuple[str, ...]
    position: tuple[float, ...] = ()
    velocity: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()
    frame_id: str = ""


class JointStates(NamedTuple):
    """Messages that have the same names and lengths, m of them.

    Attributes:
        places: Which ones they are of those that were decoded together, ascending, shape (m,).
        names: The joints.
        stamps: Of their headers, ns since the epoch, shape (m,).
        position: Shape (m, joints), or (m, 0) where it was left empty.
        velocity: As `position`.
        effort: As `position`.
    """

    places: Places
    names: tuple[str, ...]
    stamps: NDArray[np.int64]
    position: Array
    velocity: Array
    effort: Array


class Template:
    """What messages with the same names and lengths have in common.

    Args:
        header: The encapsulation header.
        constant: The bytes between the stamp and the positions.
        lengths: Of position, velocity and effort.
        order: The byte order, as `struct` writes it.
        names: The joints, as `constant` has them.
        frame_id: Of the message's header, as `constant` has it.
    """

    def __init__(
        self,
        header: bytes,
        constant: bytes,
        lengths: tuple[int, int, int],
        order: str,
        names: tuple[str, ...],
        frame_id: str,
    ) -> None:
        self._header, self._constant, self._lengths = header, constant, lengths
        self._order, self._names, self._frame_id = order, names, frame_id
        layout, self._starts = f"{order}4siI{len(constant)}s", []
        end = CONSTANT + len(constant)
        for place, length in enumerate(lengths):
            if place:
                # A count, and padding only before an array that is not empty.
                padding = -(end + 4 - HEADER) % 8 if length else 0
                layout += f"I{padding}x"
                end += 4 + padding
            layout += f"{length}d"
            self._starts.append(end)
            end += 8 * length
        self._struct = struct.Struct(layout)
        first = 4 + lengths[0]
        self._position, self._velocity = slice(4, first), slice(first + 1, first + 1 + lengths[1])
        self._effort = slice(self._velocity.stop + 1, None)

    def pack(
        self,
        stamp: int,
        position: Sequence[float],
        velocity: Sequence[float],
        effort: Sequence[float],
    ) -> bytes:
        """Return the message with these numbers, as many as the lengths say."""
        sec, nanosec = divmod(stamp, NANOSECONDS)
        _, velocities, efforts = self._lengths
        return self._struct.pack(
            self._header,
            sec,
            nanosec,
            self._constant,
            *position,
            velocities,
            *velocity,
            efforts,
            *effort,
        )

    def unpack(self, data: bytes) -> JointState | None:
        """Return the message if the bytes, of which there are enough, fit the template."""
        fields = self._struct.unpack_from(data)
        if (
            fields[0] != self._header
            or fields[3] != self._constant
            or fields[self._velocity.start - 1] != self._lengths[1]
            or fields[self._velocity.stop] != self._lengths[2]
        ):
            return None
        return JointState(
            fields[1] * NANOSECONDS + fields[2],
            self._names,
            fields[self._position],
            fields[self._velocity],
            fields[self._effort],
            self._frame_id,
        )

    def unpack_all(self, places: Places, data: bytes, size: int) -> JointStates:
        """Return those of the messages, of `size` bytes each, that fit the template."""
        rows = np.frombuffer(data, self._dtype(size))
        fits = (rows["header"] == np.frombuffer(self._header, np.uint8)).all(axis=1)
        fits &= (rows["constant"] == np.frombuffer(self._constant, np.uint8)).all(axis=1)
        fits &= (rows["velocities"] == self._lengths[1]) & (rows["efforts"] == self._lengths[2])
        rows = rows[fits]
        return JointStates(
            places[fits],
            self._names,
            rows["sec"].astype(np.int64) * NANOSECONDS + rows["nanosec"],
            *(rows[name].astype(np.float64) for name in ("position", "velocity", "effort")),
        )

    def pack_all(
        self, stamps: NDArray[np.int64], position: Array, velocity: Array, effort: Array
    ) -> list[bytes]:
        """Return many messages with these numbers, each of as many as the lengths say."""
        size = self._struct.size
        rows = np.zeros(len(stamps), self._dtype(size))
        rows["header"] = np.frombuffer(self._header, np.uint8)
        rows["sec"], rows["nanosec"] = np.divmod(stamps, NANOSECONDS)
        rows["constant"] = np.frombuffer(self._constant, np.uint8)
        rows["velocities"], rows["efforts"] = self._lengths[1:]
        rows["position"], rows["velocity"], rows["effort"] = position, velocity, effort
        data = rows.tobytes()
        return [data[begin : begin + size] for begin in range(0, len(data), size)]

    def _dtype(self, size: int) -> np.dtype[Any]:
        integer, unsigned, double = (self._order + kind for kind in ("i4", "u4", "f8"))
        positions, velocities, efforts = self._lengths
        position, velocity, effort = self._starts
        fields: dict[str, tuple[Any, int]] = {
            "header": (("u1", (HEADER,)), 0),
            "sec": (integer, HEADER),
            "nanosec": (unsigned, HEADER + 4),
            "constant": (("u1", (len(self._constant),)), CONSTANT),
            "position": ((double, (positions,)), position),
            "velocities": (unsigned, position + 8 * positions),
            "velocity": ((double, (velocities,)), velocity),
            "efforts": (unsigned, velocity + 8 * velocities),
            "effort": ((double, (efforts,)), effort),
        }
        return np.dtype(
            {
                "names": list(fields),
                "formats": [form for form, _ in fields.values()],
                "offsets": [offset for _, offset in fields.values()],
                "itemsize": size,
            }
        )
