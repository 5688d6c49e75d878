# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder's services: those of rosbag2's recorder by name, with types that pip installs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from std_srvs.srv import Trigger

from tsobs_ros.errors import BagWriteError

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

    def is_paused(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = recorder.paused, state()
        return response

    answers = {
        "pause": pause,
        "resume": resume,
        "toggle_paused": toggle_paused,
        "split_bagfile": split_bagfile,
    }
    if snapshot_mode:
        answers["snapshot"] = snapshot
    for name, answer in answers.items():
        recorder.create_service(Trigger, f"~/{name}", _trigger(answer))
    recorder.create_service(Trigger, "~/is_paused", is_paused)


def _trigger(
    answer: Callable[[], str],
) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
    def callback(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message = answer()
            response.success = True
        except BagWriteError as error:  # the next tick meets it too, and ends the recording
            response.message = str(error)
        return response

    return callback
