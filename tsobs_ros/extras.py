# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Advice on missing libraries, as one command that fits a virtual environment and Ubuntu's Python.

Extras of the package ('tsobs_ros[design]') are of no use to those who built it with colcon, so the
advice names the libraries.
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
