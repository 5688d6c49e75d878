# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs config`: the folder of the shipped parameters, requests and designs."""

import argparse

from tsobs_ros.cli.common import Commands
from tsobs_ros.resources import SHIPPED_DESIGN, config_path


def add_parser(commands: Commands) -> None:
    """Add the command `config`."""
    config = commands.add_parser(
        "config", help="print the folder of the shipped parameters, requests and designs"
    )
    config.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Print the folder."""
    print(config_path(SHIPPED_DESIGN).parent)
    return 0
