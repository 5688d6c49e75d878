# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Paths of the files installed beside the package, for every kind of installation, without ROS.

The files nearest to the running code are taken, so that both have the same version: those of its
source tree (checkout, editable install), else of its prefix (colcon, pip), else of the environment.
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

from tsobs_ros.errors import TsobsError

SHIPPED_DESIGN = "elastic_joint.design.yaml"
"""The default design, in the package's config folder."""

FIXED_DESIGN = "elastic_joint_fixed.design.yaml"
"""The same without uncertain parameters: nothing is learnt."""


def config_path(name: str) -> Path:
    """Return the path of a file of the package's config folder, such as "observer.yaml".

    Raises:
        TsobsError: No installation or source tree holds such a file.
    """
    folders = list(dict.fromkeys(_config_folders()))
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise TsobsError(f"no config file '{name}' in {', '.join(map(str, folders))}")


def _config_folders() -> Iterator[Path]:
    package = Path(__file__).absolute().parent
    # Resolved too: colcon's --symlink-install leads from its build folder to the sources.
    for location in (package, package.resolve()):
        if (location.parent / "package.xml").is_file():
            yield location.parent / "config"
    # <prefix>/local/lib/python3.12/dist-packages/tsobs_ros is the deepest known layout.
    ament = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    for prefix in (*package.parents[:5], *map(Path, filter(None, ament)), Path(sys.prefix)):
        yield prefix / "share" / "tsobs_ros" / "config"
