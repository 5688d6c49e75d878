# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The one way in which functions of this package are compiled.

Loops run in the order in which they are written: no fused multiplication and addition, no changed
order of sums. So the numbers are the same bits on every CPU, and the same as those of the
interpreter, which runs the same functions if the environment has NUMBA_DISABLE_JIT=1. Sines and
exponentials are those of `model.trigonometry`.

What was compiled is kept in the folder NUMBA_CACHE_DIR if that is set, else beside the package,
else in the user's cache folder; if none of them can be written, every process compiles for itself.
numba notices a changed file but not a changed file that it calls into. So each function, for each
combination of types, has a folder of its own there, named after all source that goes into it.
Processes that compile the same at once do it twice, and keep one of the results.
"""

import hashlib
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from functools import cache
from itertools import product
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar

import numba
from numba.core.errors import NumbaError
from numba.core.registry import CPUDispatcher

Function = TypeVar("Function", bound=Callable[..., Any])

_LENGTH = 12
_choosing_folder = threading.RLock()


def compiled(function: Function) -> Function:
    """Return a function compiled at its first call, once for each combination of types.

    It holds Python's lock while it runs.
    """
    return _compile(function, nogil=False)


def compiled_nogil(function: Function) -> Function:
    """Return a compiled function that lets other threads of Python run; for whole series."""
    return _compile(function, nogil=True)


def compilations() -> int:
    """Return how many functions this process has compiled, or is compiling, instead of loading."""
    return _Compiled.compilations


def inlined(function: Function) -> Function:
    """Return a function that is compiled as a part of each compiled function that calls it.

    A compiled function is optimised again in all that call it. With few callers that takes longer.
    """
    if numba.config.DISABLE_JIT:
        return function
    njit: Any = numba.njit
    result: Function = njit(inline="always", error_model="numpy")(function)
    return result


def _compile(function: Function, nogil: bool) -> Function:
    if numba.config.DISABLE_JIT:
        return function
    result: Any = _Compiled(function, targetoptions=_OPTIONS | {"nogil": nogil})
    return result  # type: ignore[no-any-return]


_OPTIONS = {"nopython": True, "error_model": "numpy"}


class _Compiled(CPUDispatcher):
    """A function that numba compiles, from the cache where that can be read."""

    compilations = 0

    def compile(self, sig: Any) -> Any:
        """Return the function's entry point for a signature."""
        if sig in self.overloads:
            return super().compile(sig)
        folder = None if (root := _root()) is None else root / _name_of(self, repr(sig))
        _Compiled.compilations += folder is None or not any(folder.rglob("*.nbi"))
        if folder is None:
            return super().compile(sig)
        try:
            self._cache_in(folder)
            return super().compile(sig)
        except NumbaError:
            raise
        except Exception:  # unpickling what is damaged raises anything
            shutil.rmtree(folder, ignore_errors=True)
            return self._compile_without_cache(sig)

    def _cache_in(self, folder: Path) -> None:
        if not folder.exists():
            function, _, _ = folder.name.rpartition("-")
            for outdated in folder.parent.glob(f"{function.rpartition('-')[0]}-*"):
                if not outdated.name.startswith(f"{function}-"):
                    shutil.rmtree(outdated, ignore_errors=True)
        with _choosing_folder:
            before = numba.config.CACHE_DIR
            numba.config.CACHE_DIR = str(folder)
            try:
                self.enable_caching()
            finally:
                numba.config.CACHE_DIR = before

    def _compile_without_cache(self, sig: Any) -> Any:
        if sig not in self.overloads:  # else only saving has failed
            substitute = CPUDispatcher(self.py_func, targetoptions=self.targetoptions)
            substitute.compile(sig)
            self.add_overload(substitute.overloads[sig])
            self._substitute = substitute  # which takes what it has compiled with it
        return self.overloads[sig].entry_point


@cache
def _root() -> Path | None:
    """Return a folder for the cache that can be written, None if there is none."""
    for folder in _candidates():
        versions = folder / f"{sys.implementation.cache_tag}-numba-{numba.__version__}"
        try:
            versions.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=versions):
                return versions
        except OSError:
            continue
    return None


def _candidates() -> Iterator[Path]:
    package = Path(__file__).resolve().parent
    if numba.config.CACHE_DIR:
        yield Path(numba.config.CACHE_DIR, package.name)
    yield package / "__pycache__" / "compiled"
    own = f"{package.name}-{hashlib.sha256(str(package).encode()).hexdigest()[:_LENGTH]}"
    if user := os.environ.get("XDG_CACHE_HOME"):
        yield Path(user, own)
    try:
        yield Path.home() / ".cache" / own
    except RuntimeError:  # a user without a home
        return


def _name_of(function: _Compiled, signature: str) -> str:
    """Return a name that says which function, from which source, for which types."""
    found: set[str] = set()
    _gather(function, found, set())
    source = hashlib.sha256("".join(sorted(found)).encode()).hexdigest()[:_LENGTH]
    types = hashlib.sha256(signature.encode()).hexdigest()[:_LENGTH]
    name = f"{function.py_func.__module__}.{function.py_func.__qualname__}"
    return f"{name}-{source}-{types}"


def _gather(value: Any, found: set[str], seen: set[int]) -> None:
    """Add the text of all files that a compiled function calls into, and the constants it uses."""
    if isinstance(value, CPUDispatcher) and id(value) not in seen:
        seen.add(id(value))
        python: FunctionType = value.py_func
        found.add(_text_of(python.__code__.co_filename))
        names = _names_in(python.__code__)
        scopes = [python.__globals__]
        # Functions may be called by a module's name and their own.
        named = map(python.__globals__.get, names)
        scopes += [vars(module) for module in named if isinstance(module, ModuleType)]
        for name, scope in product(names, scopes):
            used = scope.get(name)
            if isinstance(used, int | float | str | tuple):
                found.add(f"{name} = {used!r}")
            else:
                _gather(used, found, seen)


def _names_in(code: CodeType) -> set[str]:
    inner = [each for each in code.co_consts if isinstance(each, CodeType)]
    return set(code.co_names).union(*map(_names_in, inner))


@cache
def _text_of(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError:  # run from a string
        return ""
