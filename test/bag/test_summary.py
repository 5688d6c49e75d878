# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The largest gap is that of all messages, however chunks and files overlap."""

from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

from foreign import STRING, write_mcap
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.bag import BagReader, BagWriter
from tsobs_ros.bag.summary import summarise

WRITTEN = st.lists(st.tuples(st.sampled_from(["/a", "/b"]), st.integers(0, 60)), max_size=30)


@settings(max_examples=12)
@given(WRITTEN, st.integers(1, 6))
def test_gaps_are_those_of_all_messages(written: list[tuple[str, int]], chunk: int) -> None:
    with TemporaryDirectory() as folder:
        with BagWriter(Path(folder) / "bag", max_duration_ns=40) as writer:
            for topic in ("/a", "/b"):
                writer.add_topic(topic, STRING)
            for number, (topic, time) in enumerate(written):
                writer.write(topic, b"", time, 0)
                if number % chunk == 0:
                    writer.flush()
        summary = summarise(Path(folder) / "bag")
    for topic in summary["topics"]:
        times = sorted(time for name, time in written if name == topic["name"])
        gaps = [later - earlier for earlier, later in pairwise(times)]
        assert topic["messages"] == len(times)
        assert topic["largest_gap_ns"] == (max(gaps) if gaps else None)


def test_the_last_time_there_is_and_an_empty_bag_are_shown(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "far") as writer:
        writer.add_topic("/a", STRING)
        writer.write("/a", b"", 2**63 - 2, 0)
    assert "Start:        2262-04-11" in summarise(tmp_path / "far").text()
    BagWriter(tmp_path / "empty").close()
    summary = summarise(tmp_path / "empty")
    assert (summary["messages"], summary["start_ns"], summary["duration_ns"]) == (0, None, 0)
    assert "Start:        none" in summary.text()


def test_chunks_that_overlap_in_any_way_are_looked_at_in_a_few_steps(tmp_path: Path) -> None:
    """Chunks of two messages each, the first and the last there are."""
    times = [time for number in range(300) for time in (number, 10**9 - number)]
    write_mcap(tmp_path / "x.mcap", [(1, time, b"", 0) for time in times], chunk_size=1)
    assert summarise(tmp_path / "x.mcap")["topics"][0]["largest_gap_ns"] == 10**9 - 598
    times = [message.log_time for message in BagReader(tmp_path / "x.mcap").messages()]
    assert times == sorted(times)
