# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Forcing a bag to the disk from a thread of its own: a disk may take seconds over it."""

from collections.abc import Callable
from threading import Event, Thread

from tsobs_ros.errors import BagWriteError


class BackgroundSync:
    """Calls a function, such as `BagWriter.sync`, again and again in a thread until stopped.

    Args:
        sync: What to call; a BagWriteError it raises ends the calls and is kept in `error`.
        period: The pause between two calls, s.

    Attributes:
        error: Why the calls have ended by themselves, if they have.
    """

    def __init__(self, sync: Callable[[], None], period: float) -> None:
        self.error: BagWriteError | None = None
        self._sync = sync
        self._period = period
        self._stopping = Event()
        self._thread = Thread(target=self._run, name="bag sync", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the calls and wait for the one in progress; safe to call twice."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.wait(self._period):
            try:
                self._sync()
            except BagWriteError as error:
                self.error = error
                return
