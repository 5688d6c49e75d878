# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs export`: topics of a bag as files; `tsobs export-c`: an estimator for C programs."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_command, at_least_one, joined, pairs, show
from tsobs_ros.errors import complain, printable
from tsobs_ros.files import require_new


def add_parser(commands: Commands) -> None:
    """Add the commands `export` and `export-c`."""
    text = "topics of a bag as CSV or Parquet files, with units"
    add = add_command(commands, "export", _export, text).add_argument
    add("bag", type=Path, metavar="BAG", help="bag folder or MCAP file")
    add("--topic", nargs="+", default=[], metavar="NAME", dest="topics", help="default: all")
    add("--format", choices=("csv", "parquet"), default="csv")
    add("--output", type=Path, required=True, metavar="FOLDER")
    text = "a design's estimator as a file for C and C++ programs"
    add = add_command(commands, "export-c", _export_c, text).add_argument
    add("design", type=Path, metavar="DESIGN", help="design file")
    add("--output", type=Path, required=True, metavar="FILE")
    add(
        "--param", type=pairs, action="append", default=[], metavar="NAME=VALUE,...",
        help="parameters of the observer node, such as settle_time=2.0,adapt=false",
    )  # fmt: skip
    add(
        "--max-steps", type=at_least_one, default=1024, metavar="N",
        help="most samples that a late one can rewind; fewer take less memory (default: 1024)",
    )  # fmt: skip
    add("--force", action="store_true", help="replace an existing file")


def _export(options: argparse.Namespace) -> int:
    from tsobs_ros.report.export import export_bag

    exported = export_bag(options.bag, options.output, topics=options.topics, format=options.format)
    lines = [
        f"{one.topic}: {one.rows:,} messages, {one.columns} columns in {one.path}"
        for one in exported
    ]
    damages = sorted({str(one.damage) for one in exported if one.damage is not None})
    mapping = {
        "files": [
            {"topic": one.topic, "file": str(one.path), "rows": one.rows, "columns": one.columns}
            for one in exported
        ],
        "damage": damages,
    }
    show(mapping, "\n".join(map(printable, lines)) or f"{options.bag}: no messages", options.json)
    for damage in damages:
        complain(f"{damage}; exported up to there")
    return 1 if damages else 0


def _export_c(options: argparse.Namespace) -> int:
    require_new([options.output], force=options.force)
    from tsobs_ros.design.file import load_design
    from tsobs_ros.methods import ObserverSettings, export_c
    from tsobs_ros.settings import changed

    settings = changed(ObserverSettings(), joined(options.param))
    design = load_design(options.design)
    size, room = export_c(design, options.output, settings, max_steps=options.max_steps)
    show(
        {"file": str(options.output), "bytes": size, "room": room},
        f"{options.output}: {size:,} bytes; a tracker needs {room:,} bytes of memory",
        options.json,
    )
    return 0
