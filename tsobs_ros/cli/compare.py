# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs compare`: all observers on the same data, in one table."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_json
from tsobs_ros.cli.estimate import METHODS, add_observer_options, estimate


def add_parser(commands: Commands) -> None:
    """Add the command `compare`."""
    compare = commands.add_parser(
        "compare", help="all observers on the same bag or log, in a table"
    )
    add_observer_options(compare, METHODS)
    compare.add_argument(
        "--output", type=Path, metavar="NEWBAG", help="also write a bag of all their estimates"
    )
    add_json(compare)
    compare.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Run observers over a recording and compare them."""
    return estimate(options, options.output, skip_misfits=True)
