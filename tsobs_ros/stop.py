# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The actions of SIGINT, SIGTERM and SIGHUP, without heavy imports, to be in place early.

Not even typing is imported: it takes four times as long as everything else up to the first
handler, and an earlier signal kills the process.
"""

from __future__ import annotations

import os
import signal
import sys
import threading

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType
    from typing import Any

_SIGNALS = [signal.SIGINT, signal.SIGTERM]
# A terminal that closes sends SIGHUP; a process under nohup inherits that it is ignored.
if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
    _SIGNALS.append(signal.SIGHUP)


PARENT = "TSOBS_PARENT"
"""Variable with the reading end of a pipe; only the parent, such as a demo, has the other end."""


def end_at_once(exit_code: int = 0) -> None:
    """Let the signals end the process while nothing has started."""
    for number in _SIGNALS:
        signal.signal(number, lambda _number, _frame: os._exit(exit_code))


def end_with_parent() -> None:
    """Interrupt this process when the parent, which holds the other end of `PARENT`, ends."""
    pipe = os.environ.pop(PARENT, "")

    def wait() -> None:
        os.read(int(pipe), 1)
        os.kill(os.getpid(), signal.SIGINT)

    if pipe:
        threading.Thread(target=wait, daemon=True).start()


def interrupt() -> None:
    """Let the first of the signals raise KeyboardInterrupt; further ones change nothing."""

    def raise_once(number: int, frame: FrameType | None) -> None:
        # Not SIG_IGN, with which the interpreter complains about a signal that came before.
        for each in _SIGNALS:
            signal.signal(each, lambda _number, _frame: None)
        raise KeyboardInterrupt

    def raise_again(lost: Any) -> None:
        """Interrupt a moment later if the exception was lost, as in a destructor."""
        if not isinstance(lost.exc_value, KeyboardInterrupt):
            sys.__unraisablehook__(lost)
            return
        signal.signal(signal.SIGINT, raise_once)
        threading.Timer(0.001, os.kill, (os.getpid(), signal.SIGINT)).start()

    sys.unraisablehook = raise_again
    for number in _SIGNALS:
        signal.signal(number, raise_once)


def ignore_signals() -> None:
    """Ignore the signals for the rest of the process, even while the interpreter shuts down."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def signal_came() -> bool:
    """Return whether a signal came to the latest flag."""
    return StopFlag.last is not None and StopFlag.last()


class StopFlag:
    """Callable that is true once a signal came; catches the signals inside a `with` block.

    Further signals change nothing, so an impatient second Ctrl-C cannot interrupt the teardown.

    Attributes:
        last: The latest flag that has caught signals, None before there is one.
    """

    last: StopFlag | None = None

    def __init__(self) -> None:
        self._raised = False
        self._previous: dict[signal.Signals, Any] = {}

    def __call__(self) -> bool:
        return self._raised

    def __enter__(self) -> StopFlag:
        StopFlag.last = self
        for number in _SIGNALS:
            self._previous[number] = signal.signal(number, self._raise)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _raise(self, number: int, frame: FrameType | None) -> None:
        self._raised = True
