# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The one way in which functions of this package are compiled.

Loops run in the order in which they are written: no fused multiplication and addition, no changed
order of sums. So the numbers are the same bits on every CPU, and the same as those of the
interpreter, which runs the same functions if the environment has NUMBA_DISABLE_JIT=1. Only sines,
exponentials and the like come from the system's mathematical library.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return a function compiled at its first call, once for each combination of types.

    The result is kept beside the package, else in the user's cache folder; if neither can be
    written, every process compiles for itself. The function holds Python's lock while it runs.
    """
    return _compile(function, nogil=False)


def compiled_nogil(function: Function) -> Function:
    """Return a compiled function that lets other threads of Python run; for whole series."""
    return _compile(function, nogil=True)


def _compile(function: Function, nogil: bool) -> Function:
    njit: Any = numba.njit
    try:
        result: Function = njit(cache=True, error_model="numpy", nogil=nogil)(function)
    except RuntimeError:  # no folder for the cache
        result = njit(error_model="numpy", nogil=nogil)(function)
    return result
