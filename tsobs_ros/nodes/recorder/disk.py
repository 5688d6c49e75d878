# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where a recorder puts its bag, and how much room there is."""

import shutil
from datetime import datetime
from itertools import chain, count
from pathlib import Path

_MIB = 2**20


def output_folder(output: str) -> Path:
    """Return the bag's folder as an absolute path, a dated one in the current folder if unnamed."""
    if output:
        return Path(output).expanduser().absolute()
    dated = Path(datetime.now().strftime("rosbag2_%Y_%m_%d-%H_%M_%S")).absolute()
    others = (dated.with_name(f"{dated.name}_{number}") for number in count(2))
    return next(path for path in chain([dated], others) if not path.exists())


def free_disk(path: Path) -> float:
    """Return the free space, MiB, on the disk that holds a path or will hold it."""
    existing = next(folder for folder in (path, *path.parents) if folder.exists())
    return shutil.disk_usage(existing).free / _MIB
