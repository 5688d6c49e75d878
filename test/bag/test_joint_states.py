# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""JointStates in CDR: what rosbags and rclpy make of them, and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState as RosJointState

from tsobs_ros.bag.joint_states import JointState, JointStateDecoder, JointStateEncoder
from tsobs_ros.errors import MessageError

TYPES = get_typestore(Stores.ROS2_JAZZY)
NUMBERS = st.lists(st.floats(width=64, allow_nan=False), max_size=8)
NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9)
STAMPS = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
MESSAGES = st.builds(
    JointState,
    stamp=STAMPS,
    names=st.lists(NAMES, max_size=8).map(tuple),
    position=NUMBERS.map(tuple),
    velocity=NUMBERS.map(tuple),
    effort=NUMBERS.map(tuple),
    frame_id=NAMES,
)
EXAMPLE = JointState(5_000_000_007, ("elastic_joint",), (1.5,), (), (-2.0,), "base")


def encoded(message: JointState) -> bytes:
    encode = JointStateEncoder(message.names)
    return encode(message.stamp, message.position, message.velocity, message.effort)


def by_rosbags(message: JointState) -> bytes:
    sec, nanosec = divmod(message.stamp, 10**9)
    stamp = TYPES.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
    made = TYPES.types["sensor_msgs/msg/JointState"](
        header=TYPES.types["std_msgs/msg/Header"](stamp=stamp, frame_id=message.frame_id),
        name=list(message.names),
        position=np.array(message.position, dtype=np.float64),
        velocity=np.array(message.velocity, dtype=np.float64),
        effort=np.array(message.effort, dtype=np.float64),
    )
    return bytes(TYPES.serialize_cdr(made, "sensor_msgs/msg/JointState"))


def by_rclpy(message: JointState) -> bytes:
    ros = RosJointState(name=list(message.names))
    ros.header.frame_id = message.frame_id
    ros.header.stamp.sec, ros.header.stamp.nanosec = divmod(message.stamp, 10**9)
    ros.position, ros.velocity, ros.effort = map(list, message[2:5])
    return bytes(serialize_message(ros))


@settings(max_examples=25)
@given(MESSAGES)
def test_a_message_has_the_bytes_that_rosbags_and_rclpy_write(message: JointState) -> None:
    message = message._replace(frame_id="")
    data, theirs = encoded(message), by_rclpy(message)

    assert data == by_rosbags(message)
    # Also padding, where rclpy leaves whatever its buffer held before.
    assert len(data) <= len(theirs) <= len(data) + 16
    back = deserialize_message(data, RosJointState)
    assert by_rosbags(JointStateDecoder()(theirs)) == data
    assert (back.name, list(back.position)) == (list(message.names), list(message.position))


@settings(max_examples=25)
@given(st.lists(MESSAGES, max_size=12), st.integers(1, 3))
def test_messages_come_back_one_by_one_and_at_once(items, copies) -> None:
    messages = items * copies
    data = [by_rosbags(message) for message in messages]
    decode = JointStateDecoder()
    assert [decode(each) for each in data] == messages
    back: dict[int, JointState] = {}
    for size in {len(each) for each in data}:
        places = np.array([n for n, each in enumerate(data) if len(each) == size])
        for group in decode.decode_rows(places, rows_of([data[n] for n in places])):
            assert np.all(np.diff(group.places) > 0)
            for place, stamp, *arrays in zip(group.places, group.stamps, *group[3:], strict=True):
                numbers = [tuple(array.tolist()) for array in arrays]
                back[int(place)] = JointState(int(stamp), group.names, *numbers)
    assert [back[n] for n in range(len(data))] == [m._replace(frame_id="") for m in messages]


def rows_of(messages: list[bytes]) -> np.ndarray:
    return np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)


def test_messages_of_another_layout_are_left_out_of_a_group() -> None:
    encode = JointStateEncoder(["a", "b"])
    data = [encode(stamp, [1.0, 2.0], (), [stamp, 0.0]) for stamp in range(5)]
    data.insert(2, b"\0\1\0\0".ljust(len(data[0]), b"\xff"))
    (group,) = JointStateDecoder().decode_rows(np.arange(6), rows_of(data))
    assert (group.names, group.places.tolist()) == (("a", "b"), [0, 1, 3, 4, 5])
    assert group.velocity.shape == (5, 0)


def test_the_options_of_the_encoding_are_not_read() -> None:
    """Some middlewares set them; a row that did not fit its own template was decoded for ever."""
    plain = JointStateEncoder(["a"])(7, [1.0])
    data = [plain[:2] + b"\0\3" + plain[4:], plain]
    (group,) = JointStateDecoder().decode_rows(np.arange(2), rows_of(data))
    assert (group.places.tolist(), group.position.tolist()) == ([0, 1], [[1.0], [1.0]])
    decode = JointStateDecoder()
    assert decode(data[0]) == decode(data[1])


@settings(max_examples=25)
@given(MESSAGES, st.lists(STAMPS, min_size=1, max_size=4))
def test_many_messages_encoded_at_once_are_those_encoded_one_by_one(message, stamps) -> None:
    encode = JointStateEncoder(message.names)
    arrays = [np.array([numbers] * len(stamps)) for numbers in message[2:5]]

    assert list(map(bytes, encode.encode_rows(np.array(stamps), *arrays))) == [
        encode(stamp, *message[2:5]) for stamp in stamps
    ]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda d: b"", "0 bytes, .* not plain little-endian CDR"),
        (lambda d: b"\x00\x03" + d[2:], "encoding 0x0003.*: not plain little-endian CDR"),
        (lambda d: d[:8], "header.stamp: expected 8 bytes at 4"),
        (lambda d: d[:12] + b"\xff\xff\xff\x7f" + d[16:], "header.frame_id: 2147483647 elements"),
        (lambda d: d.replace(b"base\0", b"base!"), "header.frame_id: .* does not end in a zero"),
        (lambda d: d.replace(b"elastic", b"\xff\xfeastic"), "name: .* not UTF-8"),
        (lambda d: d[:-8], r"effort: expected 8 bytes at \d+, but the message ends after 0"),
        (lambda d: d[:-13], "velocity: expected 4 bytes"),
        (lambda d: d + bytes(17), r"17 bytes are left at \d+, after the effort"),
    ],
)
def test_what_is_no_message_is_refused_with_its_place(change, match: str) -> None:
    data = by_rosbags(EXAMPLE)
    decode = JointStateDecoder()
    assert decode(data) == EXAMPLE

    with pytest.raises(MessageError, match=match):
        decode(change(data))
    assert decode(data) == EXAMPLE


@pytest.mark.parametrize("stamp", [2**31 * 10**9, -(2**31) * 10**9 - 1])
def test_a_stamp_that_no_message_can_hold_is_refused(stamp: int) -> None:
    with pytest.raises(MessageError, match=f"stamp {stamp} ns"):
        JointStateEncoder(["a"])(stamp)
    with pytest.raises(MessageError, match=f"stamp {stamp} ns"):
        JointStateEncoder(["a"]).encode_rows(np.array([0, stamp]))
