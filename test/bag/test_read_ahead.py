# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Reading ahead gives what reading gives, no more of it at a time, and errors where they belong."""

import threading
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsobs_ros.bag import BagReader, BagWriter
from tsobs_ros.bag.read_ahead import BagSource, ReadAhead
from tsobs_ros.errors import BagReadError

STRING = "std_msgs/msg/String"
PAYLOAD = b"\0\1\0\0\1\0\0\0\0"


@given(st.lists(st.integers(0, 100)), st.integers(0, 2000))
def test_reading_ahead_changes_nothing(sizes: list[int], limit: int) -> None:
    ahead = ReadAhead(sizes, lambda size: size, limit)

    assert list(ahead) == sizes
    assert list(ahead) == []
    ahead.close()


def test_no_more_is_read_ahead_than_allowed() -> None:
    read = 0

    def items() -> Iterator[int]:
        nonlocal read
        while True:
            read += 1
            yield read

    ahead = ReadAhead(items(), lambda _: 10, 1000)
    assert list(islice(ahead, 500)) == list(range(1, 501))
    ahead.close()
    ahead.close()

    assert 500 <= read <= 600
    assert next(ahead, None) is None
    assert not any(thread.name == "read ahead" for thread in threading.enumerate())


@pytest.mark.parametrize("error", [BagReadError("damaged"), RuntimeError("a bug")])
def test_an_error_comes_after_everything_before_it(error: Exception) -> None:
    def items() -> Iterator[int]:
        yield from range(100)
        raise error

    ahead = ReadAhead(items(), lambda _: 1, 100)

    assert list(islice(ahead, 100)) == list(range(100))
    with pytest.raises(type(error), match=str(error)):
        next(ahead)
    ahead.close()


@pytest.fixture
def reader(tmp_path: Path) -> BagReader:
    """Give a bag with /a at 0, 10 … 90 ns and /latched at 5, 25, 45 and 45 ns."""
    with BagWriter(tmp_path / "bag") as writer:
        for topic, times in (("/a", range(0, 100, 10)), ("/latched", (5, 25, 45, 45))):
            writer.add_topic(topic, STRING)
            for time in times:
                writer.write(topic, PAYLOAD, time, 0)
    return BagReader(tmp_path / "bag")


def read(source: BagSource, time: int, again: bool, count: int) -> list[tuple[str, int] | None]:
    found = list(islice(source.read(time, again), count))
    source.close()
    return [None if m is None else (m.topic, m.log_time) for m in found]


def test_a_pass_is_read_with_what_is_latched_before_it(reader: BagReader) -> None:
    source = BagSource(reader, ["/a", "/latched"], {"/latched": 2}, 0, 60, 10_000)

    assert read(source, 45, False, 99) == [
        ("/latched", 5), ("/latched", 25), ("/latched", 45), ("/latched", 45),
        ("/a", 50), ("/a", 60), None,
    ]  # fmt: skip
    assert read(source, 46, False, 3) == [("/latched", 45), ("/latched", 45), ("/a", 50)]
    assert read(source, 100, False, 99) == [("/latched", 45), ("/latched", 45), None]


def test_pass_after_pass_is_read_from_the_start(reader: BagReader) -> None:
    source = BagSource(reader, ["/a"], {}, 70, 80, 10_000)

    again = [("/a", 70), ("/a", 80), None]
    assert read(source, 80, True, 7) == [*again[1:], *again, *again[:2]]


def test_reading_elsewhere_gives_up_what_was_read(reader: BagReader) -> None:
    source = BagSource(reader, ["/a"], {}, 0, 90, 10_000)
    first = source.read(0, True)
    assert next(first) is not None

    second = source.read(90, False)

    assert next(first, None) is None
    assert [m and m.log_time for m in second] == [90, None]
    source.close()
