# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of this package: one root, subclasses that are also the expected builtin.

And the advice on missing libraries. Extras of the package ('tsobs_ros[design]') are of no use to
those who built it with colcon, so the advice names the libraries.
"""

import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

_BASE = ("pyyaml", "msgspec>=0.18.5", "mcap>=1.5", "zstandard", "lz4")
_DESIGN = ("cvxpy-base", "clarabel", "scipy")
_REPORT = ("matplotlib", "plotly", "tqdm", "mcap-ros2-support")
LIBRARIES: Mapping[str, tuple[str, ...]] = {
    "rclpy": ("ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"),
    "numpy": ("numpy>=1.26", *_BASE),
    **dict.fromkeys(("yaml", "msgspec", "mcap", "zstandard", "lz4"), _BASE),
    **dict.fromkeys(("cvxpy", "clarabel", "scipy"), _DESIGN),
    **dict.fromkeys(("matplotlib", "plotly", "tqdm", "mcap_ros2"), _REPORT),
    "pyarrow": ("pyarrow", "mcap-ros2-support"),
    "rich": ("rich",),
}
"""Modules that may be missing, each with what to install then."""
CORE = "tsobs_ros.core.native"
"""The compiled core, missing where the sources were only copied, or older than they are."""


class TsobsError(Exception):
    """Root of every error raised on purpose by this package; its text is meant for the user."""


class ModelError(TsobsError, ValueError):
    """A model, signal or measurement does not make sense (shape, sign, range, finiteness)."""


class DesignError(TsobsError, RuntimeError):
    """A gain could not be designed: the solver failed or its answer did not pass the re-check.

    Attributes:
        remedies: Changes of the request that were found to have a design, of `design.synthesis`.
    """

    def __init__(self, message: str, remedies: Sequence[Any] = ()) -> None:
        super().__init__(message)
        self.remedies = tuple(remedies)


class DetectabilityError(DesignError):
    """A design cannot exist because a mode of the error system is not seen by the sensor."""


class DesignFileError(TsobsError, ValueError):
    """A design file is missing, malformed or does not describe a design."""


class CertificateError(DesignFileError):
    """A design file is well formed but its certificate does not hold."""


class ParameterError(TsobsError, ValueError):
    """A ROS parameter is unknown, of the wrong type or out of range."""


class BagReadError(TsobsError, OSError):
    """A bag cannot be read: missing, truncated, of another format or with unknown definitions."""


class BagWriteError(TsobsError, OSError):
    """A bag cannot be written: the folder exists, the disk is full, or a topic is inconsistent."""


class OutputError(TsobsError, OSError):
    """A file cannot be written: it exists already, or the disk is full."""


class LogError(TsobsError, ValueError):
    """An arm's own log cannot be read: a column is missing, or a cell is not what it should be."""


class MessageError(TsobsError, ValueError):
    """A message cannot be read or written: its bytes or its values do not fit its type."""


class NodeError(TsobsError, RuntimeError):
    """A node cannot start or go on, for a reason its user can act on."""


def printable(text: str, newline: str = r"\n") -> str:
    """Return a text with everything escaped that a terminal would obey instead of showing it.

    Names in bags, messages and files may be anything. `newline` comes between lines; by default it
    is escaped too, as in a name.

    >>> print(printable("joint\\x1b[2J\\nb"))
    joint\\x1b[2J\\nb
    """
    lines = (
        "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
        for line in text.split("\n")
    )
    return newline.join(lines)


def complain(problem: object) -> int:
    """Print an error to stderr, on one line unless a design is at fault; return the exit code 1."""
    newline = "\n" if isinstance(problem, DesignError) else " "
    with suppress(OSError):  # the terminal has gone
        print(f"error: {printable(str(problem), newline)}", file=sys.stderr, flush=True)
    return 1


def complain_of_missing(error: ModuleNotFoundError) -> int:
    """Print what installs a missing module, and return the exit code 1.

    Raises:
        ModuleNotFoundError: It is the given error, on a module that belongs to no library.
    """
    if (advice := missing_library(error.name)) is None:
        raise error
    return complain(advice)


def missing_library(name: str | None) -> str | None:
    """Return that a module is missing and how to install it, as it fits this Python.

    None if the module is not the core and belongs to no library of the package.
    """
    if name == CORE:
        fault = "is built from other C sources" if CORE in sys.modules else "is not built"
        return (
            f"{CORE} {fault}: in the folder with setup.py, "
            f"{sys.executable} -m pip install -e . (or colcon build); it takes a C compiler"
        )
    from importlib.metadata import PackageNotFoundError, version  # which takes long to import

    module = (name or "").partition(".")[0]
    if module not in LIBRARIES:
        return None
    libraries = list(LIBRARIES[module])
    with suppress(PackageNotFoundError):
        if version("numpy").startswith("1."):  # that ROS and libraries of the system were built for
            libraries.insert(0, "numpy<2")
    ros = "source ROS 2 Jazzy, or " if module == "rclpy" else ""
    return (
        f"{module} is not installed: {ros}{sys.executable} -m pip install {shlex.join(libraries)} "
        "(the README has the way with Ubuntu's Python)"
    )
