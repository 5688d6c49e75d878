# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs export-c`: a design's estimator as a file for C and C++ programs."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_json, at_least_one, show
from tsobs_ros.cli.estimate import pairs
from tsobs_ros.files import require_new


def add_parser(commands: Commands) -> None:
    """Add the command `export-c`."""
    command = commands.add_parser(
        "export-c", help="a design's estimator as a file for C and C++ programs"
    )
    add = command.add_argument
    add("design", type=Path, metavar="DESIGN", help="design file")
    add("--output", type=Path, required=True, metavar="FILE")
    add(
        "--param", type=pairs, action="append", default=[], metavar="NAME=VALUE,...",
        help="parameters of the observer node, such as settle_time=2.0,adapt=false",
    )  # fmt: skip
    add(
        "--max-steps", type=at_least_one, default=1024, metavar="N",
        help="most samples to which a late one can rewind; fewer take less memory (default: 1024)",
    )  # fmt: skip
    add("--force", action="store_true", help="replace an existing file")
    add_json(command)
    command.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Write a design's estimator into a file."""
    require_new([options.output], force=options.force)
    from tsobs_ros.design.file import load_design
    from tsobs_ros.exported import export_c
    from tsobs_ros.methods import ObserverSettings

    given = {name: value for one in options.param for name, value in one.items()}
    settings = ObserverSettings().with_parameters(given)
    design = load_design(options.design)
    size, room = export_c(design, options.output, settings, max_steps=options.max_steps)
    show(
        {"file": str(options.output), "bytes": size, "room": room},
        f"{options.output}: {size:,} bytes; a tracker needs {room:,} bytes of memory",
        options.json,
    )
    return 0
