# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs report`: table and figures of a recorded run."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_json, show
from tsobs_ros.resources import SHIPPED_DESIGN, config_path


def add_parser(commands: Commands) -> None:
    """Add the command `report`."""
    report = commands.add_parser("report", help="table and figures of a recorded run")
    report.add_argument("bag", type=Path)
    report.add_argument("--output", type=Path, help="folder for the report (default: by the bag)")
    report.add_argument("--design", type=Path, metavar="FILE", help="default: the shipped design")
    report.add_argument("--no-ekf", action="store_true", help="leave out the EKF comparison")
    add_json(report)
    report.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Report on a recorded run."""
    folder = options.output or options.bag.parent
    design_path = options.design or config_path(SHIPPED_DESIGN)
    return report_on(options.bag, folder, design_path, ekf=not options.no_ekf, as_json=options.json)


def report_on(bag: Path, output: Path, design_path: Path, *, ekf: bool, as_json: bool) -> int:
    """Report on a bag and return the exit code."""
    from tsobs_ros.design.file import load_arm_design
    from tsobs_ros.report.bag_report import make_bag_report

    result = make_bag_report(bag, output, load_arm_design(design_path), ekf=ekf)
    show(result.as_mapping(), result.text(), as_json)
    return 0
