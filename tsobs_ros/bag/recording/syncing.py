# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Forcing a bag to the disk from a thread of its own: a disk may take seconds over it."""

import time
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
        self._synced_at = time.monotonic()
        self._stopping = False
        self._wake = Event()
        self._thread = Thread(target=self._run, name="bag sync", daemon=True)
        self._thread.start()

    @property
    def age(self) -> float:
        """The time since the beginning of the last call that succeeded, s."""
        return time.monotonic() - self._synced_at

    def hurry(self) -> None:
        """Call at once instead of at the end of the pause."""
        self._wake.set()

    def stop(self) -> None:
        """End the calls and wait for the one in progress; safe to call twice."""
        self._stopping = True
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        while True:
            self._wake.wait(self._period)
            self._wake.clear()
            if self._stopping:
                return
            begun_at = time.monotonic()
            try:
                self._sync()
            except BagWriteError as error:
                self.error = error
                return
            self._synced_at = begun_at
