# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of the tick log: what is written is read, and tools read it as the type it has."""

from zlib import crc32

import numpy as np
import pytest

from tsobs_ros.bag.cdr import TICK_LOG, TICK_LOG_TEXT, decode_ticks, encode_tick
from tsobs_ros.bag.definitions import MessageLayout
from tsobs_ros.errors import MessageError

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
