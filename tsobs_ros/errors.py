# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of this package, below one root; each is also the builtin error that callers expect.

The module also has the advice on missing libraries. It names the libraries, as extras of the
package ('tsobs_ros[design]') are of no use after a build with colcon.
"""

import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

_BASE = ("pyyaml>=6.0", "msgspec>=0.21", "mcap>=1.5", "zstandard>=0.22", "lz4>=4.3")
_DESIGN = ("cvxpy-base>=1.5", "clarabel>=0.9", "scipy>=1.11")
_DECODER = "mcap-ros2-support>=0.5.5"
_REPORT = ("matplotlib>=3.8", "plotly>=6", "tqdm>=4.66", _DECODER)
LIBRARIES: Mapping[str, tuple[str, ...]] = {
    "rclpy": ("ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"),
    "numpy": ("numpy>=1.26", *_BASE),
    **dict.fromkeys(("yaml", "msgspec", "mcap", "zstandard", "lz4"), _BASE),
    **dict.fromkeys(("cvxpy", "clarabel", "scipy"), _DESIGN),
    **dict.fromkeys(("matplotlib", "plotly", "tqdm", "mcap_ros2"), _REPORT),
    "pyarrow": ("pyarrow>=14", _DECODER),
    "rich": ("rich>=13",),
}
"""Modules that may be missing, each with the packages to install."""
CORE = "tsobs_ros.core.native"
"""The compiled core: missing if the sources were only copied, or possibly older than they are."""


class TsobsError(Exception):
    """Root of every error raised on purpose by this package; its text is meant for the user."""


class ModelError(TsobsError, ValueError):
    """A model, signal or measurement does not make sense (shape, sign, range, finiteness)."""


class DesignError(TsobsError, RuntimeError):
    """A gain could not be designed: the solver failed or its answer did not pass the re-check.

    Attributes:
        remedies: Changes of the request for which `design.synthesis` found a design.
    """

    def __init__(self, message: str, remedies: Sequence[Any] = ()) -> None:
        super().__init__(message)
        self.remedies = tuple(remedies)


class DetectabilityError(DesignError):
    """A design cannot exist because the sensor does not see a mode of the error system."""


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
    """An arm's own log cannot be read: a column is missing, or a cell is malformed."""


class MessageError(TsobsError, ValueError):
    """A message cannot be read or written: its bytes or its values do not fit its type."""


class NodeError(TsobsError, RuntimeError):
    """A node cannot start or continue, for a reason that its user can act on."""


def printable(text: str, newline: str = r"\n") -> str:
    """Return a text in which everything that a terminal would obey instead of show is escaped.

    Names in bags, messages and files may contain anything. `newline` separates the lines; the
    default is an escaped newline, as for names.

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
    """Print how to install a missing module, and return the exit code 1.

    Raises:
        ModuleNotFoundError: The given error, if its module belongs to no library.
    """
    if (advice := missing_library(error.name)) is None:
        raise error
    return complain(advice)


def missing_library(name: str | None) -> str | None:
    """Return the advice on a missing module: how to install it for this Python.

    It is None if the module is not the core and belongs to no library of the package.
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
        if version("numpy").startswith("1."):  # ROS and the system's libraries were built for it
            libraries.insert(0, "numpy<2")
    ros = "source ROS 2 Jazzy, or " if module == "rclpy" else ""
    return (
        f"{module} is not installed: {ros}{sys.executable} -m pip install {shlex.join(libraries)} "
        "(the README has the way with Ubuntu's Python)"
    )
