# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages whose names and numbers do not belong together, or that are none."""

import math
from collections.abc import Iterator
from typing import Any

from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from faults.arm import Arm
from faults.script import Event, Fate, Sender, kind
from tsobs_ros.estimation.records import RejectReason

_FAMILY = "message"
_MANY = 3000


def _changed(
    arm: Arm, begin: int, fate: Fate | RejectReason, seconds: float = 0.5, **changes: Any
) -> Iterator[Event]:
    for stamp in arm.stamps(begin, seconds):
        yield Event(stamp, arm.message(stamp, **changes), fate)


@kind(_FAMILY)
def empty_message(arm: Arm, begin: int) -> Iterator[Event]:
    """Nothing at all, not even a stamp: rejected."""
    for stamp in arm.stamps(begin, 0.5):
        yield Event(stamp, JointState(), RejectReason.WRONG_JOINT)


@kind(_FAMILY)
def no_effort(arm: Arm, begin: int) -> Iterator[Event]:
    """No effort: rejected, as `assume_zero_torque` is false."""
    return _changed(arm, begin, RejectReason.WRONG_JOINT, effort=[])


@kind(_FAMILY)
def no_position(arm: Arm, begin: int) -> Iterator[Event]:
    """No position: rejected."""
    return _changed(arm, begin, RejectReason.WRONG_JOINT, position=[])


@kind(_FAMILY)
def velocity_alone(arm: Arm, begin: int) -> Iterator[Event]:
    """A velocity, which nobody asked for, and nothing else: rejected."""
    return _changed(arm, begin, RejectReason.WRONG_JOINT, position=[], effort=[], velocity=[1.0])


@kind(_FAMILY)
def more_names_than_positions(arm: Arm, begin: int) -> Iterator[Event]:
    """The joint's place in the names is beyond the positions: rejected."""
    return _changed(arm, begin, RejectReason.WRONG_JOINT, name=["hip", arm.joint])


@kind(_FAMILY)
def more_positions_than_names(arm: Arm, begin: int) -> Iterator[Event]:
    """Numbers without a name after those of the joint: used, as the joint's are there."""
    for stamp in arm.stamps(begin, 0.5):
        sample = arm.measurement(stamp)
        position, effort = [*sample.y.tolist(), 9.0, 9.0], [*sample.u.tolist(), 9.0]
        yield Event(stamp, arm.message(stamp, position=position, effort=effort))


@kind(_FAMILY)
def foreign_joint(arm: Arm, begin: int) -> Iterator[Event]:
    """Another joint only: rejected."""
    return _changed(arm, begin, RejectReason.WRONG_JOINT, name=["elbow"])


@kind(_FAMILY)
def joint_twice(arm: Arm, begin: int) -> Iterator[Event]:
    """The joint's name comes twice: the first counts."""
    for stamp in arm.stamps(begin, 0.5):
        sample = arm.measurement(stamp)
        changes = {"position": [*sample.y.tolist(), 9.0], "effort": [*sample.u.tolist(), 9.0]}
        yield Event(stamp, arm.message(stamp, name=[arm.joint] * 2, **changes))


@kind(_FAMILY)
def thousands_of_joints(arm: Arm, begin: int) -> Iterator[Event]:
    """The joint is the last of three thousand, the others without numbers: used."""
    others = [f"joint_{index}" for index in range(_MANY)]
    nothing = [math.nan] * _MANY
    for stamp in arm.stamps(begin, 0.05):
        sample = arm.measurement(stamp)
        position, effort = nothing + sample.y.tolist(), nothing + sample.u.tolist()
        fields = {"name": [*others, arm.joint], "position": position, "effort": effort}
        yield Event(stamp, arm.message(stamp, **fields))


@kind(_FAMILY)
def thousands_of_foreign_joints(arm: Arm, begin: int) -> Iterator[Event]:
    """Three thousand joints, none of them ours: rejected, in a line that stays short."""
    others = [f"joint_{index}" for index in range(_MANY)]
    return _changed(arm, begin, RejectReason.WRONG_JOINT, 0.05, name=others, position=[0.0] * _MANY)


@kind(_FAMILY)
def very_long_name(arm: Arm, begin: int) -> Iterator[Event]:
    """A joint with a name of a hundred thousand letters: rejected, in a line that stays short."""
    return _changed(arm, begin, RejectReason.WRONG_JOINT, 0.05, name=["x" * 100_000])


@kind(_FAMILY)
def name_that_is_not_ascii(arm: Arm, begin: int) -> Iterator[Event]:
    """A joint named in other letters, one of them a control character: rejected."""
    return _changed(arm, begin, RejectReason.WRONG_JOINT, name=["елбоу 关节\x1b[31m🦾"])


@kind(_FAMILY)
def long_frame(arm: Arm, begin: int) -> Iterator[Event]:
    """A frame of ten thousand letters: of no interest, used."""
    for stamp in arm.stamps(begin, 0.1):
        message = arm.message(stamp)
        message.header.frame_id = "frame" * 2000
        yield Event(stamp, message)


@kind(_FAMILY)
def truncated_bytes(arm: Arm, begin: int) -> Iterator[Event]:
    """Bytes that end in the middle of a message: rejected."""
    for stamp in arm.stamps(begin, 0.1):
        data = serialize_message(arm.message(stamp))
        yield Event(stamp, data[: len(data) // 2], RejectReason.WRONG_JOINT, Sender.RAW)


@kind(_FAMILY)
def random_bytes(arm: Arm, begin: int) -> Iterator[Event]:
    """Bytes that claim to hold four thousand million joints: rejected."""
    for stamp in arm.stamps(begin, 0.1):
        yield Event(stamp, b"\x00\x01\x00\x00" + b"\xff" * 60, RejectReason.WRONG_JOINT, Sender.RAW)


@kind(_FAMILY)
def name_that_is_not_utf8(arm: Arm, begin: int) -> Iterator[Event]:
    """A message well formed but for letters that no encoding has: rejected."""
    for stamp in arm.stamps(begin, 0.1):
        data = serialize_message(arm.message(stamp, name=["elastic_joinX"]))
        data = data.replace(b"elastic_joinX", b"elastic_joi\xff\xfe")
        yield Event(stamp, data, RejectReason.WRONG_JOINT, Sender.RAW)
