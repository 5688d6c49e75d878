# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Layouts of hostile definitions neither end nor occupy a check; messages of the tick log."""

from zlib import crc32

import numpy as np
import pytest

from tsobs_ros.bag.cdr import TICK_LOG, TICK_LOG_TEXT, decode_ticks, encode_tick
from tsobs_ros.bag.definitions import MessageLayout
from tsobs_ros.bag.estimate_topics import parameter_names, sides
from tsobs_ros.errors import MessageError

HEADER = b"\x00\x01\x00\x00"


def nested(depth: int, fields: int) -> str:
    """Return a definition in which each type has several of the next one."""
    definitions = [
        "\n".join(f"T{level + 1} field_{n}" for n in range(fields)) for level in range(depth)
    ]
    definitions.append("uint8 value")
    separator = "=" * 80
    first, *others = definitions
    texts = [f"{separator}\nMSG: p/T{n}\n{text}" for n, text in enumerate(others, start=1)]
    return "\n".join([first, *texts, ""])


def test_a_message_has_the_length_its_definition_gives_it() -> None:
    layout = MessageLayout("p/msg/T0", nested(depth=3, fields=2))

    layout.check(HEADER + bytes(8))
    with pytest.raises(MessageError, match="its values need 12 bytes, but it has 11"):
        layout.check(HEADER + bytes(7))


def test_a_type_of_ever_more_parts_is_given_up_where_the_message_ends() -> None:
    layout = MessageLayout("p/msg/T0", nested(depth=60, fields=2))

    with pytest.raises(MessageError, match="its values need"):
        layout.check(HEADER + bytes(8))


def test_a_type_that_is_nested_too_deep_is_malformed() -> None:
    with pytest.raises(ValueError, match="nested too deep"):
        MessageLayout("p/msg/T0", nested(depth=5000, fields=1))


STAMP = 1_700_000_000_123_456_789


def as_rows(*messages: bytes) -> "np.ndarray[tuple[int, int], np.dtype[np.uint8]]":
    return np.stack([np.frombuffer(message, np.uint8) for message in messages])


@pytest.mark.parametrize("measured", [[], [b"one"], [b"one", b"one", b"another"]])
def test_a_tick_is_read_as_written_and_has_the_layout_of_its_type(measured: list[bytes]) -> None:
    message = encode_tick(STAMP, 7, True, measured)
    MessageLayout(TICK_LOG, TICK_LOG_TEXT).check(message)
    expected = [STAMP, 7, 1, *map(crc32, measured)]
    assert decode_ticks(as_rows(message, message)).tolist() == [expected, expected]


@pytest.mark.parametrize(
    "message", [b"", bytes(60), encode_tick(STAMP, 1, True, [])[:-8], bytes(200)]
)
def test_messages_of_another_layout_are_refused(message: bytes) -> None:
    with pytest.raises(MessageError, match="tick log"):
        decode_ticks(as_rows(message))


def test_names_of_sides_and_parameters_name_their_joint_unless_it_is_alone() -> None:
    assert sides("elbow") == ("elbow_link", "elbow_motor")
    assert parameter_names("elbow", ("k",), alone=True) == ("k",)
    assert parameter_names("elbow", ("k",), alone=False) == ("elbow/k",)
