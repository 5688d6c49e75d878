# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of the tick log, and names."""

from zlib import crc32

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tsobs_ros.bag.cdr import TICK_LOG, TICK_LOG_TEXT, decode_ticks, encode_tick
from tsobs_ros.bag.estimate_topics import parameter_names, sides
from tsobs_ros.errors import MessageError

STAMP = 1_700_000_000_123_456_789


def as_rows(*messages: bytes) -> "np.ndarray[tuple[int, int], np.dtype[np.uint8]]":
    return np.stack([np.frombuffer(message, np.uint8) for message in messages])


@pytest.mark.parametrize("measured", [[], [b"one"], [b"one", b"one", b"another"]])
def test_a_tick_is_read_as_written_and_has_the_layout_of_its_type(measured: list[bytes]) -> None:
    message = encode_tick(STAMP, 7, True, measured)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(TICK_LOG_TEXT, TICK_LOG))
    assert list(store.deserialize_cdr(message, TICK_LOG).data)[1:3] == [7, 1]
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
