# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The files of a bag, also of one whose metadata.yaml is missing or does not name them all."""

import re
from pathlib import Path
from typing import NamedTuple

from tsobs_ros.bag.metadata import BagMetadata, read_metadata
from tsobs_ros.errors import BagReadError

_NUMBER = re.compile(r"_(\d+)$")


class BagFiles(NamedTuple):
    """What there is of a bag.

    Attributes:
        paths: Its MCAP files in order of recording, those that are missing included.
        metadata: What the folder says about itself; None if it says nothing.
        metadata_error: Why it says nothing; empty if it does, or for a single file.
        unlisted: The files that the metadata does not name.
    """

    paths: tuple[Path, ...]
    metadata: BagMetadata | None
    metadata_error: str
    unlisted: tuple[Path, ...]


def find_files(bag: Path) -> BagFiles:
    """Return the files of a bag folder, or of a single file.

    Raises:
        BagReadError: There is no such folder or file, or no MCAP file in it.
    """
    if not bag.is_dir():
        if not bag.exists():
            raise BagReadError(f"{bag}: there is no such bag")
        return BagFiles((bag,), None, "", ())
    metadata, error = None, ""
    try:
        metadata = read_metadata(bag)
    except BagReadError as reason:
        error = str(reason)
    listed = [bag / Path(file.path).name for file in metadata.files] if metadata else []
    try:
        present = sorted(bag.glob("*.mcap"), key=_order)
    except OSError as reason:
        raise BagReadError(f"{bag}: cannot read it: {reason}") from reason
    unlisted = [path for path in present if path not in listed]
    if not (listed or unlisted):
        raise BagReadError(f"{bag}: not a bag, there is no .mcap file in it")
    return BagFiles((*listed, *unlisted), metadata, error, tuple(unlisted))


def _order(path: Path) -> tuple[int, str]:
    match = _NUMBER.search(path.stem)
    return (int(match[1]) if match else -1, path.name)
