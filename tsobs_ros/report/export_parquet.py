# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A table as a Parquet file: typed columns, with each one's unit in its metadata."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from tsobs_ros.report.export_table import Column, Table

_ROWS = 16_384
_KINDS: dict[type, Any] = {
    bool: pa.bool_(),
    int: pa.int64(),
    float: pa.float64(),
    str: pa.string(),
    bytes: pa.binary(),
}
_LARGEST_INT64 = 2**63 - 1


def write_parquet(table: Table, path: Path) -> None:
    """Write a table to a new file; the unit of a column is its field's metadata `unit`.

    Raises:
        OSError: The file exists or cannot be written.
    """
    schema = pa.schema([_field(column) for column in table.columns]).with_metadata(
        {"topic": table.topic}
    )
    rows = table.rows()
    with path.open("xb") as stream, pq.ParquetWriter(stream, schema) as writer:
        for block in _blocks(rows):
            columns = zip(*block, strict=True)
            arrays = [
                pa.array(values, field.type) for values, field in zip(columns, schema, strict=True)
            ]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))


def _blocks(rows: Iterator[list[Any]]) -> Iterator[list[list[Any]]]:
    while block := list(islice(rows, _ROWS)):
        yield block


def _field(column: Column) -> Any:
    if column.kind is list:
        kind = pa.list_(_KINDS[column.item])
    elif column.largest > _LARGEST_INT64:
        kind = pa.uint64()
    else:
        kind = _KINDS[column.kind]
    return pa.field(column.name, kind, metadata={"unit": column.unit} if column.unit else None)
