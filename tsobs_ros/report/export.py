# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics of a bag as CSV or Parquet files, one each; numbers read back to the same bits."""

import csv
import json
import os
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from tsobs_ros.bag.reader import BagReader
from tsobs_ros.errors import BagReadError, ExportError
from tsobs_ros.report.export_table import Column, Table

FORMATS = ("csv", "parquet")

_BLOCK = 16_384
_MAX_INT64 = 2**63 - 1
# A spreadsheet takes text with such a first character for a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


class Exported(NamedTuple):
    """A file that was written.

    Attributes:
        topic: The topic.
        path: The file.
        rows: Number of messages.
        columns: Number of columns.
        damage: The place where reading ended early, if it did.
    """

    topic: str
    path: Path
    rows: int
    columns: int
    damage: BagReadError | None


def export_bag(
    bag: Path, output: Path, *, topics: Sequence[str] = (), format: str = "csv"
) -> list[Exported]:
    """Write each topic to a file of its name, below a folder.

    Args:
        bag: Bag folder or MCAP file.
        output: The folder; it is created, but no file in it is replaced.
        topics: The topics; all that have messages if empty.
        format: One of `FORMATS`.

    Raises:
        BagReadError: The bag cannot be read, has no such topic, or a topic cannot be decoded.
        ExportError: A file exists already or cannot be written, or a topic's name is no file's.
        ModuleNotFoundError: Parquet is asked for, but pyarrow is not installed.
    """
    reader = BagReader(bag)
    if unknown := [topic for topic in topics if topic not in reader.topics]:
        has = ", ".join(reader.topics) or "none"
        raise BagReadError(f"{bag}: no topic {', '.join(unknown)}; topics: {has}")
    chosen = topics or [name for name, info in reader.topics.items() if info.count]
    write = _write_parquet if format == "parquet" else _write_csv
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
    """Return a topic's file, which is below the folder whatever the topic's name is."""
    parts = topic.removeprefix("/").split("/")
    if not topic.isprintable() or not {"", ".", ".."}.isdisjoint(parts):
        raise ExportError(f"topic {topic!r}: there is no file of such a name")
    return output.joinpath(*parts[:-1], f"{parts[-1]}.{format}")


def _write_csv(table: Table, path: Path) -> None:
    with path.open("x", encoding="utf-8", newline="") as stream:
        plain = csv.writer(stream, lineterminator="\n")
        quoted = csv.writer(stream, lineterminator="\n", quoting=csv.QUOTE_ALL)
        plain.writerow(
            [f"{one.name} [{one.unit}]" if one.unit else one.name for one in table.columns]
        )
        for row in table.rows():
            cells = [_csv_cell(value) for value in row]
            # The csv module leaves a lone carriage return unquoted, which ends a line for readers.
            broken = any(isinstance(cell, str) and "\r" in cell for cell in cells)
            (quoted if broken else plain).writerow(cells)


def _csv_cell(value: Any) -> Any:
    match value:
        case None:
            return ""
        case bool():
            return "true" if value else "false"
        case bytes():
            return value.hex()
        case list():
            return json.dumps(value)
        case float():
            return repr(value)
        case str() if value.startswith(_FORMULA):
            return f"'{value}"
        case _:
            return value


def _write_parquet(table: Table, path: Path) -> None:
    # Here, so that pyarrow is needed only for Parquet.
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {
        bool: pa.bool_(),
        int: pa.int64(),
        float: pa.float64(),
        str: pa.string(),
        bytes: pa.binary(),
    }

    def field(column: Column) -> Any:
        if column.kind is list:
            kind = pa.list_(kinds[column.item])
        else:
            kind = pa.uint64() if column.largest > _MAX_INT64 else kinds[column.kind]
        return pa.field(column.name, kind, metadata={"unit": column.unit} if column.unit else None)

    fields = [field(column) for column in table.columns]
    schema = pa.schema(fields).with_metadata({"topic": table.topic})
    rows = table.rows()
    with path.open("xb") as stream, pq.ParquetWriter(stream, schema) as writer:
        while block := list(islice(rows, _BLOCK)):
            columns = zip(*block, strict=True)
            arrays = [pa.array(one, kind.type) for one, kind in zip(columns, schema, strict=True)]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
