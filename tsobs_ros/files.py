# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Opening of files that anybody may have put there, regular ones alone; files that are replaced.

A pipe that is called `x_0.mcap` waits for a writer for ever, and a link to `/dev/zero` never ends.
"""

import errno
import os
from collections.abc import Iterable
from pathlib import Path
from stat import S_ISREG
from typing import IO

from tsobs_ros.errors import OutputError


def open_regular(path: Path) -> IO[bytes]:
    """Open a regular file, or a link to one, for reading.

    Raises:
        OSError: It is none, or cannot be opened.
    """
    if not S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    # Without waiting, should it have become a pipe since.
    return open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))


def require_new(paths: Iterable[Path], *, force: bool) -> None:
    """Refuse to replace files.

    Args:
        paths: Files to write.
        force: Whether they may be replaced.

    Raises:
        OutputError: One exists and may not be replaced.
    """
    for path in paths:
        if path.exists() and not force:
            raise OutputError(f"{path}: exists already; --force replaces it")
