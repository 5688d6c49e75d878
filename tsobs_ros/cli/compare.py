# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs compare`: all observers on the same data, in one table."""

import argparse
from pathlib import Path

from tsobs_ros.cli.estimate import estimate
from tsobs_ros.cli.observer_options import METHODS, add_observer_options
from tsobs_ros.cli.options import Words, add_json


def add_parser(words: Words) -> None:
    """Add the word `compare`."""
    compare = words.add_parser("compare", help="all observers on the same bag or log, in a table")
    add_observer_options(compare, METHODS)
    compare.add_argument(
        "--output", type=Path, metavar="NEWBAG", help="also write a bag of all their estimates"
    )
    add_json(compare)
    compare.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Run observers over a recording and compare them."""
    return estimate(options, options.output)
