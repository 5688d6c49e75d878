# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Chunks copied from bag to bag: every reader gives the same messages in the same order."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from foreign import write_mcap
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType

from tsobs_ros.bag import BagMessage, BagReader, BagWriter, QosProfile
from tsobs_ros.bag.copying import add_topics, copy_chunks
from tsobs_ros.bag.metadata import profiles_to_yaml
from tsobs_ros.bag.verification import verify

BYTES = "std_msgs/msg/UInt64"
TEXT = "uint64 data\n"
QOS = profiles_to_yaml([QosProfile()])
TOPICS = "/a", "/b", "/c"

Entry = tuple[str, int]
"""Topic and log time; the rest follows from them and the place."""

entries = st.lists(st.tuples(st.sampled_from(TOPICS), st.integers(0, 60)), max_size=40)


def message(number: int) -> bytes:
    return b"\0\1\0\0" + number.to_bytes(8, "little")


def foreign(
    path: Path, written: list[Entry], *, skipped: int = 0, compression: str = "zstd", **options: Any
) -> Path:
    """Write a file as another recorder may do."""
    calls = [
        (1 + TOPICS.index(topic), time, message(number), 1000 + number)
        for number, (topic, time) in enumerate(written)
    ]
    others = [(f"std_msgs/msg/Other{k}", "ros2msg", b"uint8 data\n") for k in range(skipped)]
    metadata = {"offered_qos_profiles": QOS, "topic_type_hash": "RIHS01_0"}
    return write_mcap(
        path,
        calls,
        schemas=[*others, (BYTES, "ros2msg", TEXT.encode())],
        channels=[(topic, "cdr", 1 + skipped, metadata) for topic in TOPICS],
        compression=CompressionType[compression.upper()],
        **({"chunk_size": 200} | options),
    )


def write_bag(path: Path, written: list[Entry], **options: Any) -> Path:
    """Write a bag as the recorder does; after ten messages a chunk ends."""
    with BagWriter(path, **options) as writer:
        for topic in TOPICS:
            writer.add_topic(topic, BYTES, [QosProfile()])
        for number, (topic, time) in enumerate(written):
            writer.write(topic, message(number), time, 1000 + number)
            if number % 10 == 9:
                writer.flush()
    return path


def copy(source: Path, target: Path, topics: tuple[str, ...], **options: Any) -> Path:
    """Copy as an estimation does, and write some messages of another topic."""
    reader = BagReader(source)
    with BagWriter(target, **options) as writer:
        add_topics(reader, writer, topics)
        writer.add_topic("/made", BYTES, [QosProfile()])
        copy_chunks(reader, writer, topics)
        for time in (14, 29, 60):
            writer.write("/made", message(0), time, time)
    return target


def copied(path: Path) -> list[BagMessage]:
    return [one for one in BagReader(path).messages() if one.topic != "/made"]


def chunks_of(path: Path) -> Iterator[bytes]:
    """Yield the content of the chunks as it is in a file."""
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                yield record.data


def check(source: Path, target: Path, topics: tuple[str, ...]) -> None:
    """Compare what readers give of both bags, and check the new one."""
    expected = [one for one in BagReader(source).messages() if one.topic in topics]
    assert copied(target) == expected
    made = list(BagReader(target).messages())
    # A message that was made comes behind the recorded ones of its time.
    assert [one for one in made if one.log_time == 60][-1:][0].topic == "/made"
    verification = verify(target)
    assert (verification.errors, verification.unchecked) == ((), 0)


@settings(max_examples=10)
@given(
    entries,
    st.sampled_from(["none", "lz4", "zstd"]),
    st.sampled_from([TOPICS, ("/a", "/c"), ("/b",)]),
    st.integers(0, 2),
    st.integers(1, 400),
    st.booleans(),
)
def test_readers_give_what_others_recorded(
    written: list[Entry],
    compression: str,
    topics: tuple[str, ...],
    skipped: int,
    chunk_size: int,
    is_checked: bool,
) -> None:
    with TemporaryDirectory() as folder:
        file = foreign(
            Path(folder) / "other.mcap",
            written,
            compression=compression,
            skipped=skipped,
            chunk_size=chunk_size,
            enable_crcs=is_checked,
        )
        recorded = [
            BagMessage(topic, BYTES, message(number), time, 1000 + number)
            for number, (topic, time) in enumerate(written)
        ]
        assert list(BagReader(file).messages()) == sorted(recorded, key=lambda one: one.log_time)
        check(file, copy(file, Path(folder) / "new", topics), topics)


WRITTEN = [(TOPICS[k % 3], k) for k in range(60)]


def stay(source: Path, target: Path) -> tuple[int, int]:
    """Return how many chunks there are, and how many of these are in the new bag as they are."""
    files = BagReader(target).files
    new = {data for file in files for data in chunks_of(file)}
    old = [data for file in BagReader(source).files for data in chunks_of(file)]
    return len(old), sum(data in new for data in old)


# What is wanted, how it was written, and how many chunks there are and have the same bytes after.
OURS = {"compression": "zstd"}
OTHERS: dict[str, tuple[tuple[str, ...], dict[str, Any], tuple[int, int]]] = {
    "as we write it": (TOPICS, OURS, (6, 6)),
    "as others write it": (TOPICS, {"chunk_size": 500}, (6, 6)),
    "schemas with other ids": (TOPICS, {"skipped": 2}, (13, 12)),
    "messages that nobody wants": (("/a", "/b"), {"chunk_size": 500}, (6, 0)),
    "no checksums": (TOPICS, {"enable_crcs": False}, (13, 12)),
}


@pytest.mark.parametrize(("topics", "options", "expected"), OTHERS.values(), ids=OTHERS)
def test_chunks_are_copied_as_they_are_or_the_messages_picked_out(
    tmp_path: Path, topics: tuple[str, ...], options: dict[str, Any], expected: tuple[int, int]
) -> None:
    write = write_bag if options == OURS else foreign
    file = write(tmp_path / "other.mcap", WRITTEN, **options)
    new = copy(file, tmp_path / "new", topics)
    check(file, new, topics)
    assert stay(file, new) == expected
