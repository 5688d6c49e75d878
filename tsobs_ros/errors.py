# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of this package: one root, subclasses that are also the expected builtin.

And the advice on missing libraries, as one command that fits a virtual environment and Ubuntu's
Python. Extras of the package ('tsobs_ros[design]') are of no use to those who built it with colcon,
so the advice names the libraries.
"""

import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path

_FILES = ("mcap>=1.5", "zstandard", "lz4", "msgspec>=0.18.5")
_DESIGN = ("cvxpy", "clarabel")
_REPORT = ("matplotlib", "plotly", "tqdm", "mcap-ros2-support")
LIBRARIES: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("mcap", "zstandard", "lz4", "msgspec"), _FILES),
    **dict.fromkeys(("cvxpy", "clarabel"), _DESIGN),
    **dict.fromkeys(("matplotlib", "plotly", "tqdm", "mcap_ros2"), _REPORT),
    "pyarrow": ("pyarrow", "mcap-ros2-support"),
}
"""Modules that rosdep does not install, each with what to install when it is missing."""


class TsobsError(Exception):
    """Root of every error raised on purpose by this package; its text is meant for the user."""


class ModelError(TsobsError, ValueError):
    """A model, signal or measurement does not make sense (shape, sign, range, finiteness)."""


class DesignError(TsobsError, RuntimeError):
    """A gain could not be designed: the solver failed or its answer did not pass the re-check."""


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


class ExportError(TsobsError, OSError):
    """A topic cannot be written to a file: it exists, or the disk is full."""


class LogError(TsobsError, ValueError):
    """An arm's own log cannot be read: a column is missing, or a cell is not what it should be."""


class MessageError(TsobsError, ValueError):
    """A message cannot be read or written: its bytes or its values do not fit its type."""


class NodeError(TsobsError, RuntimeError):
    """A node cannot start or go on, for a reason its user can act on."""


class InterruptionError(NodeError):
    """A signal came before a node had started; the process ends cleanly."""


def printable(text: str) -> str:
    """Return a text with everything escaped that a terminal would obey instead of showing it.

    What is said of bags and files repeats names that are in them, and those may be anything.
    """
    return "".join(
        c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text
    )


def missing_library(error: ModuleNotFoundError) -> str | None:
    """Return what is missing and how to install it; None if it is no library of the package."""
    module = (error.name or "").partition(".")[0]
    if module == "rclpy":
        return "rclpy is not installed: source ROS 2 Jazzy, or " + _command(
            ("ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces")
        )
    if module not in LIBRARIES:
        return None
    return f"{module} is not installed: {_command(LIBRARIES[module])}"


def _command(libraries: tuple[str, ...]) -> str:
    # Debian and Ubuntu refuse to install into their Python without this option (PEP 668).
    managed = Path(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED").is_file()
    option = "--break-system-packages " if managed and sys.prefix == sys.base_prefix else ""
    names = " ".join(f"'{name}'" if set(name) & set("[>") else name for name in libraries)
    return f"{sys.executable} -m pip install {option}{names}"
