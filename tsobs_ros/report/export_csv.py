# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A table as a CSV file: units in the header, numbers that read back to the same bits."""

import csv
import json
from pathlib import Path
from typing import Any

from tsobs_ros.report.export_table import Table


def write_csv(table: Table, path: Path) -> None:
    """Write a table to a new file.

    Raises:
        OSError: The file exists or cannot be written.
    """
    with path.open("x", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(
            [f"{one.name} [{one.unit}]" if one.unit else one.name for one in table.columns]
        )
        writer.writerows([_text(value) for value in row] for row in table.rows())


def _text(value: Any) -> Any:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, list):
        return json.dumps(value)
    return repr(value) if isinstance(value, float) else value
