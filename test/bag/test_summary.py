# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Summaries of bags at the limits of time."""

from pathlib import Path

from foreign import STRING

from tsobs_ros.bag import BagWriter
from tsobs_ros.bag.summary import summarise


def test_the_last_time_there_is_and_an_empty_bag_are_shown(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "far") as writer:
        writer.add_topic("/a", STRING)
        writer.write("/a", b"", 2**63 - 2, 0)
    assert "Start:        2262-04-11" in summarise(tmp_path / "far").text()
    BagWriter(tmp_path / "empty").close()
    summary = summarise(tmp_path / "empty")
    assert (summary["messages"], summary["start_ns"], summary["duration_ns"]) == (0, None, 0)
    assert "Start:        none" in summary.text()
