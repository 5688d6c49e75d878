# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs paper`: regenerate the published method's figures; `tsobs config`: shipped files."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_json, show
from tsobs_ros.resources import SHIPPED_DESIGN, config_path


def add_parser(commands: Commands) -> None:
    """Add the commands `paper` and `config`."""
    paper = commands.add_parser("paper", help="the published method: its figures, and what holds")
    paper.add_argument("--output", type=Path, default=Path("paper"), help="folder to write to")
    paper.add_argument("--seeds", type=int, default=20, metavar="N", help="runs of Example 3")
    paper.add_argument("--force", action="store_true", help="replace existing files")
    add_json(paper)
    paper.set_defaults(command=_paper)
    config = commands.add_parser(
        "config", help="print the folder of the shipped parameters, requests and designs"
    )
    config.set_defaults(command=_config)


def _paper(options: argparse.Namespace) -> int:
    from tsobs_ros.paper.page import make_paper_report

    result = make_paper_report(options.output, seeds=options.seeds, force=options.force)
    show(result.as_mapping(), str(result), options.json)
    return 0


def _config(options: argparse.Namespace) -> int:
    print(config_path(SHIPPED_DESIGN).parent)
    return 0
