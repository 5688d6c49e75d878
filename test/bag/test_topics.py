# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics as arrays: the same numbers as message by message, whatever blocks; and tick logs."""

from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tsobs_ros.bag import BagReader, BagWriter
from tsobs_ros.bag.cdr import TICK_LOG, decode_ticks, encode_tick
from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateDecoder, JointStateEncoder
from tsobs_ros.errors import BagReadError, MessageError

COUNT = 50
NAMES = [("a", "b"), ("b",), ("other", "a"), ("a",)]
WANTED = [[("b", "position"), ("none", "effort")], [("a", "position"), ("a", "effort")]]


@pytest.fixture
def bag(tmp_path: Path) -> BagReader:
    """A bag of chunks that overlap, with a malformed message."""
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/j", JOINT_STATE)
        writer.add_topic("/text", "std_msgs/msg/String")
        for k in range(COUNT):
            names = NAMES[k % len(NAMES)]
            encode = JointStateEncoder(names)
            effort = [2.0 * k] if names == ("a",) else []
            data = b"\0\1\0\0" if k == 7 else encode(k, [float(k)] * len(names), [], effort)
            writer.write("/j", data, 100 + (k ^ 3), k)
            writer.write("/text", b"\0\1\0\0\1\0\0\0\0", 100 + k, k)
            if k % 6 == 0:
                writer.flush()
    return BagReader(tmp_path / "bag")


@pytest.mark.parametrize("size", [None, 8, 40])
def test_blocks_hold_what_the_messages_do(bag: BagReader, size: int | None) -> None:
    decode, row, found = JointStateDecoder(), 0, dict[str, None]()
    messages = list(bag.messages(["/j"]))
    for block in bag.blocks(["/text", "/j"], size):
        raw, count = block["/j"], len(block["/j"].log_times)
        found |= decode.names(raw.groups)
        named, stamps, values = decode.read_places(count, raw.groups, WANTED)
        for k in range(count):
            message, row = messages[row], row + 1
            assert (raw.log_times[k], raw.publish_times[k]) == message[3:]
            assert named[k] == (message.publish_time != 7)
            if named[k]:
                state = decode(message.data)
                # Of the last group that it has an entry of.
                name = "a" if "a" in state.names else "b"
                effort = state.effort[0] if state.effort else np.nan
                expected = [state.position[state.names.index(name)], effort]
                np.testing.assert_array_equal([stamps[k], *values[k]], [state.stamp, *expected])
    assert row == COUNT
    read = [decode(message.data).names for message in messages if message.publish_time != 7]
    assert [*found] == [*dict.fromkeys(name for names in read for name in names)]


def test_up_to_damage_everything_is_read(bag: BagReader) -> None:
    path, last = bag.files[0], bag.summaries[0].spans[-1]
    data = bytearray(path.read_bytes())
    data[last.offset + last.size - 20] ^= 255
    path.write_bytes(data)
    with pytest.raises(BagReadError, match="no topic /none"):
        next(bag.blocks(["/none"]))
    with pytest.raises(BagReadError, match="/text is std_msgs/msg/String, expected sensor"):
        bag.require(["/j", "/text"], JOINT_STATE)
    with pytest.raises(BagReadError, match="damaged"):
        list(bag.blocks(["/j"]))
    damage: list[BagReadError] = []
    (block,) = bag.blocks(["/j"], on_damage=damage.append)
    assert len(damage) == 1
    assert 40 < len(block["/j"].log_times) < COUNT


STAMP = 1_700_000_000_123_456_789


def as_rows(*messages: bytes) -> "np.ndarray[tuple[int, int], np.dtype[np.uint8]]":
    return np.stack([np.frombuffer(message, np.uint8) for message in messages])


@pytest.mark.parametrize("measured", [[], [b"one"], [b"one", b"one", b"another"]])
def test_a_tick_is_read_as_written_and_has_the_layout_of_its_type(measured: list[bytes]) -> None:
    message = encode_tick(STAMP, 7, True, measured)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(find_definition(TICK_LOG, []).text, TICK_LOG))
    assert list(store.deserialize_cdr(message, TICK_LOG).data)[1:3] == [7, 1]
    expected = [STAMP, 7, 1, *map(crc32, measured)]
    assert decode_ticks(as_rows(message, message)).tolist() == [expected, expected]


@pytest.mark.parametrize(
    "message", [b"", bytes(60), encode_tick(STAMP, 1, True, [])[:-8], bytes(200)]
)
def test_messages_of_another_layout_are_refused(message: bytes) -> None:
    with pytest.raises(MessageError, match="tick log"):
        decode_ticks(as_rows(message))
