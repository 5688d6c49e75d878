# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""End the process on time when its teardown hangs, with the exit code it deserves.

Fast DDS 2.14 sometimes spins for ever while a participant is destroyed (two or three in a thousand
processes when two nodes stop together) and holds the GIL, so no Python code can intervene.
`faulthandler.dump_traceback_later(exit=True)` can, but it prints a traceback and exits with 1
although everything that matters has been closed by then. A POSIX timer whose expiry runs C's
`_exit(code)` in a thread of its own needs neither the GIL nor a failure code.
"""

import ctypes
import faulthandler
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_CLOCK_MONOTONIC = 1
_SIGEV_THREAD = 2


class _SignalEvent(ctypes.Structure):
    """C's struct sigevent as glibc lays it out for SIGEV_THREAD."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signo", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("padding", ctypes.c_byte * 32),
    )


class _TimerSpec(ctypes.Structure):
    """C's struct itimerspec."""

    _fields_ = (
        ("interval_s", ctypes.c_long),
        ("interval_ns", ctypes.c_long),
        ("value_s", ctypes.c_long),
        ("value_ns", ctypes.c_long),
    )


@contextmanager
def exit_guard(timeout: float, exit_code: int) -> Iterator[None]:
    """End the process with `exit_code` if the block takes longer than `timeout`.

    Args:
        timeout: Longest time the block may take, in seconds.
        exit_code: What a forced end reports. Where the C library lacks POSIX timers it is 1, and
            a traceback is printed.

    Yields:
        Nothing; the guard is lifted at the end of the block.
    """
    disarm = arm(timeout, exit_code)
    try:
        yield
    finally:
        disarm()


def arm(timeout: float, exit_code: int) -> "Disarm":
    """Arm the guard without a block to end it, for the interpreter's own shutdown.

    Args:
        timeout: Time until the process is ended, in seconds.
        exit_code: What a forced end reports, as for `exit_guard`.

    Returns:
        A callable that lifts the guard.
    """
    sys.stdout.flush()
    sys.stderr.flush()  # a forced end runs no exit handlers
    try:
        return Disarm(_start_timer(timeout, exit_code))
    except (OSError, AttributeError):
        faulthandler.dump_traceback_later(timeout, exit=True)
        return Disarm(None)


class Disarm:
    """Lifts a guard when called; made by `arm`."""

    def __init__(self, timer: ctypes.c_void_p | None) -> None:
        """Keep the POSIX timer, or None where faulthandler stands in."""
        self._timer = timer

    def __call__(self) -> None:
        """Lift the guard."""
        if self._timer is None:
            faulthandler.cancel_dump_traceback_later()
        else:
            _c_library().timer_delete(self._timer)


def _start_timer(timeout: float, exit_code: int) -> ctypes.c_void_p:
    library = _c_library()
    event = _SignalEvent(
        value=exit_code,
        notify=_SIGEV_THREAD,
        function=ctypes.cast(library._exit, ctypes.c_void_p).value,
    )
    timer = ctypes.c_void_p()
    if library.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) != 0:
        raise OSError(ctypes.get_errno(), "timer_create failed")
    seconds = int(timeout)
    spec = _TimerSpec(value_s=seconds, value_ns=int((timeout - seconds) * 1e9))
    if library.timer_settime(timer, 0, ctypes.byref(spec), None) != 0:
        raise OSError(ctypes.get_errno(), "timer_settime failed")
    return timer


def _c_library() -> ctypes.CDLL:
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "timer_create"):  # glibc before 2.34 keeps timers apart
        ctypes.CDLL("librt.so.1", mode=ctypes.RTLD_GLOBAL)
    return library
