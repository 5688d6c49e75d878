# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics of a bag to files, one each."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tsobs_ros.bag.reader import BagReader
from tsobs_ros.errors import BagReadError, ExportError
from tsobs_ros.report.export_table import Table

FORMATS = ("csv", "parquet")


class Exported(NamedTuple):
    """A file that was written.

    Attributes:
        topic: What is in it.
        path: The file.
        rows: How many messages.
        columns: How many columns.
        damage: Where reading ended early, if it did.
    """

    topic: str
    path: Path
    rows: int
    columns: int
    damage: BagReadError | None


def export_bag(
    bag: Path, output: Path, *, topics: Sequence[str] = (), format: str = "csv"
) -> list[Exported]:
    """Write each topic to a file that is called like it, below a folder.

    Args:
        bag: Bag folder or MCAP file.
        output: The folder; it is created, but no file in it is replaced.
        topics: The topics; all that have messages if empty.
        format: One of `FORMATS`.

    Raises:
        BagReadError: The bag cannot be read, has no such topic, or a topic cannot be decoded.
        ExportError: A file exists already or cannot be written, or none can be called like a topic.
        ModuleNotFoundError: Parquet is asked for, but pyarrow is not installed.
    """
    reader = BagReader(bag)
    if unknown := [topic for topic in topics if topic not in reader.topics]:
        has = ", ".join(reader.topics) or "none"
        raise BagReadError(f"{bag}: no topic {', '.join(unknown)}; topics: {has}")
    chosen = topics or [name for name, info in reader.topics.items() if info.count]
    if format == "parquet":
        # Here, so that pyarrow is needed only for what it does.
        from tsobs_ros.report.export_parquet import write_parquet as write
    else:
        from tsobs_ros.report.export_csv import write_csv as write
    paths = {topic: _file_of(topic, output, format) for topic in chosen}
    for path in paths.values():
        if os.path.lexists(path):
            raise ExportError(f"{path}: exists already, files are not overwritten")
    # All topics before the first file: one that cannot be decoded leaves none behind.
    tables = [(Table(reader, topic), path) for topic, path in paths.items()]
    exported = []
    for table, path in tables:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write(table, path)
        except OSError as error:
            raise ExportError(f"{path}: cannot write it: {error}") from error
        exported.append(Exported(table.topic, path, table.count, len(table.columns), table.damage))
    return exported


def _file_of(topic: str, output: Path, format: str) -> Path:
    """Return a topic's file, which is below the folder whatever a bag calls its topics."""
    parts = topic.removeprefix("/").split("/")
    if "\0" in topic or not {"", ".", ".."}.isdisjoint(parts):
        raise ExportError(f"topic {topic!r}: there is no file of such a name")
    return output.joinpath(*parts[:-1], f"{parts[-1]}.{format}")
