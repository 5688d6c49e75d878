# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Opening of files that anybody may have put there, if they are regular; files that appear whole.

A pipe that is called `x_0.mcap` waits for a writer for ever, and a link to `/dev/zero` never ends.
"""

import errno
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from stat import S_ISREG
from tempfile import TemporaryDirectory
from typing import IO

from tsobs_ros.errors import OutputError, TsobsError


def open_regular(path: Path) -> IO[bytes]:
    """Open a regular file, or a link to one, for reading.

    Raises:
        OSError: It is not a regular file, or cannot be opened.
    """
    if not S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    # Without waiting, in case the path has become a pipe since the check.
    return open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))


def fsync_folder(folder: Path) -> None:
    """Force a folder's entries to the disk: a new file is lost without its name.

    Raises:
        OSError: The folder cannot be opened or the disk fails.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def naming_path(
    path: str | os.PathLike[str], error: Callable[[str], TsobsError], what: str = "read"
) -> Iterator[None]:
    """Turn an OSError in a block into an `error` that names the file; a TsobsError passes as is."""
    try:
        yield
    except TsobsError:
        raise
    except OSError as problem:
        raise error(f"{path}: cannot {what} it: {problem.strerror or problem}") from problem


def require_new(paths: Iterable[Path], *, force: bool) -> None:
    """Refuse to replace files, unless forced to.

    Raises:
        OutputError: One exists and may not be replaced.
    """
    for path in paths:
        if path.exists() and not force:
            raise OutputError(f"{path}: exists already; --force replaces it")


@contextmanager
def written_whole(
    folder: Path, error: Callable[[str], TsobsError] = OutputError, *, force: bool = False
) -> Iterator[Path]:
    """Yield a temporary folder whose content moves to `folder` once the block has succeeded.

    `folder` is made if missing. It gets nothing if the block fails, as by a signal or a full disk.
    A kill leaves the temporary folder inside `folder`, under a name that ends in `.partial`.

    Raises:
        TsobsError: A file cannot be written, or exists and may not be replaced; of the class
            `error`.
    """
    partial = ""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(
            suffix=".partial", prefix=".tsobs-", dir=folder, ignore_cleanup_errors=True
        ) as partial:
            yield Path(partial)
            _move(Path(partial), folder, error, force=force)
            fsync_folder(folder)
    except TsobsError as problem:
        # Messages name the files by their final paths.
        problem.args = (str(problem).replace(partial or str(folder), str(folder)),)
        raise
    except OSError as problem:
        raise error(f"{folder}: cannot write it: {problem.strerror or problem}") from problem


def write_whole(
    path: str | os.PathLike[str],
    content: str | bytes,
    error: Callable[[str], TsobsError] = OutputError,
    *,
    force: bool = True,
) -> None:
    """Make or replace a file in one step, so that a power cut cannot leave half of it.

    Raises:
        TsobsError: It cannot be written, or exists and may not be replaced; of the class `error`.
    """
    if Path(path).is_dir():
        raise error(f"{path}: cannot write it: a folder is there")
    with written_whole(Path(path).parent, error, force=force) as folder:
        data = content.encode() if isinstance(content, str) else content
        (folder / Path(path).name).write_bytes(data)


def _move(source: Path, target: Path, error: Callable[[str], TsobsError], *, force: bool) -> None:
    for entry in sorted(source.iterdir()):
        there = target / entry.name
        if entry.is_dir() and there.is_dir():
            _move(entry, there, error, force=force)
            continue
        if not force and os.path.lexists(there):
            raise error(f"{there}: exists already")
        if entry.is_file():
            with entry.open("rb") as stream:  # some disks report only now that they are full
                os.fsync(stream.fileno())
        entry.rename(there)
