# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs paper`: regenerate the published method's figures and the table of its claims."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_json, show


def add_parser(commands: Commands) -> None:
    """Add the command `paper`."""
    paper = commands.add_parser("paper", help="the published method: its figures, and what holds")
    paper.add_argument("--output", type=Path, default=Path("paper"), help="folder to write to")
    paper.add_argument("--seeds", type=int, default=20, metavar="N", help="runs of Example 3")
    paper.add_argument("--force", action="store_true", help="replace existing files")
    add_json(paper)
    paper.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Regenerate the published method's figures and the table of its claims."""
    from tsobs_ros.paper.page import make_paper_report

    result = make_paper_report(options.output, seeds=options.seeds, force=options.force)
    show(result.as_mapping(), str(result), options.json)
    return 0
