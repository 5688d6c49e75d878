# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs export`: topics of a bag as CSV or Parquet files."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_json, complain, show
from tsobs_ros.errors import printable


def add_parser(commands: Commands) -> None:
    """Add the command `export`."""
    export = commands.add_parser(
        "export", help="topics of a bag as CSV or Parquet files, with units"
    )
    export.add_argument("bag", type=Path, metavar="BAG", help="bag folder or MCAP file")
    export.add_argument("--topic", nargs="+", default=[], metavar="NAME", help="default: all")
    export.add_argument("--format", choices=("csv", "parquet"), default="csv")
    export.add_argument("--output", type=Path, required=True, metavar="FOLDER")
    add_json(export)
    export.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Export topics of a bag."""
    from tsobs_ros.report.export import export_bag

    exported = export_bag(options.bag, options.output, topics=options.topic, format=options.format)
    lines = [
        f"{one.topic}: {one.rows:,} messages, {one.columns} columns in {one.path}"
        for one in exported
    ]
    damages = {str(one.damage) for one in exported if one.damage is not None}
    mapping = {
        "files": [
            {"topic": one.topic, "file": str(one.path), "rows": one.rows, "columns": one.columns}
            for one in exported
        ],
        "damage": sorted(damages),
    }
    show(mapping, "\n".join(map(printable, lines)) or f"{options.bag}: no messages", options.json)
    for damage in sorted(damages):
        complain(f"{damage}; exported up to there")
    return 1 if damages else 0
