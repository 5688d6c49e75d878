# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder's services: those of rosbag2's recorder by name, with types that pip installs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from tsobs_ros.errors import BagWriteError
from tsobs_ros.nodes.managed import Answer

if TYPE_CHECKING:
    from tsobs_ros.nodes.recorder import Recorder


def offer_services(recorder: Recorder, snapshot_mode: bool) -> None:
    """Let others pause, resume, split and take snapshots; every answer says what came of it.

    Args:
        recorder: The recorder, being configured.
        snapshot_mode: Whether there are snapshots to take.
    """

    def state() -> str:
        return "paused" if recorder.paused else "recording"

    def pause() -> str:
        recorder.pause()
        return state()

    def resume() -> str:
        recorder.resume()
        return state()

    def toggle_paused() -> str:
        return resume() if recorder.paused else pause()

    def split_bagfile() -> str:
        recorder.split()
        return f"{recorder.statistics.files} files"

    def snapshot() -> str:
        return f"{recorder.take_snapshot()} messages"

    def is_paused() -> tuple[bool, str]:
        return recorder.paused, state()

    answers = {
        "pause": _attempt(pause),
        "resume": _attempt(resume),
        "toggle_paused": _attempt(toggle_paused),
        "is_paused": is_paused,
        "split_bagfile": _attempt(split_bagfile),
    }
    if snapshot_mode:
        answers["snapshot"] = _attempt(snapshot)
    recorder.offer_triggers(answers)


def _attempt(act: Callable[[], str]) -> Answer:
    """Return what does something that may fail with the bag, and tells why it did."""

    def answer() -> tuple[bool, str]:
        try:
            return True, act()
        except BagWriteError as error:  # the next tick meets it too, and ends the recording
            return False, str(error)

    return answer
