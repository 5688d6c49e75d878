# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Chunks copied from bag to bag: every reader gives the same messages in the same order."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from foreign import write_mcap
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType

from tsobs_ros.bag import BagReader, BagWriter, QosProfile
from tsobs_ros.bag.metadata import profiles_to_yaml
from tsobs_ros.bag.reader import BagMessage
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


def copy(source: Path, target: Path, topics: tuple[str, ...], **options: Any) -> Path:
    """Copy as an estimation does, and write some messages of another topic."""
    reader = BagReader(source)
    with BagWriter(target, **options) as writer:
        writer.add_topics(one for one in reader.topics.values() if one.name in topics)
        writer.add_topic("/made", BYTES, [QosProfile()])
        writer.copy_topics(reader, topics)
        for time in (14, 29, 60):
            writer.write("/made", message(0), time, time)
    return target


def copied(path: Path) -> list[BagMessage]:
    return [one for one in BagReader(path).messages() if one.topic != "/made"]


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


# What is wanted, how it was written, and how many chunks there are and have the same bytes after.
