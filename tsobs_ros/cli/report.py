# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs report`: page, figure and table of a recorded run."""

import argparse
from pathlib import Path
from typing import Any

from tsobs_ros.cli.common import Commands, add_json, show
from tsobs_ros.errors import LogError


def add_parser(commands: Commands) -> None:
    """Add the command `report`."""
    report = commands.add_parser("report", help="page, figure and table of a recorded run")
    add = report.add_argument
    add("bag", type=Path)
    add("--output", type=Path, help="folder for the report (default: by the bag)")
    add("--joint", metavar="NAME", help="joint to report on, if there are several")
    add("--namespace", metavar="NS", help="namespace of its topics, if there are several arms")
    add(
        "--design", metavar="FILE",
        help="the observer's design (default: what the bag's observer ran, else the shipped one)",
    )  # fmt: skip
    add(
        "--other-design", action="store_true",
        help="let --design name another design than the bag's observer ran",
    )  # fmt: skip
    add("--no-ekf", action="store_true", help="leave out the EKF comparison")
    add("--force", action="store_true", help="replace existing files")
    add_json(report)
    report.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Report on a recorded run."""
    from tsobs_ros.replay.estimate import is_log

    if is_log(options.bag):
        raise LogError(
            f"{options.bag}: a log has no estimates to report on; first write a bag of them: "
            f"tsobs estimate {options.bag}"
        )
    return report_on(
        options.bag,
        options.output or options.bag.parent,
        as_json=options.json,
        design=options.design,
        other_design=options.other_design,
        ekf=not options.no_ekf,
        joint=options.joint,
        namespace=options.namespace,
        force=options.force,
    )


def report_on(bag: Path, output: Path, *, as_json: bool, **options: Any) -> int:
    """Report on a bag and return the exit code; the options are those of `make_bag_report`."""
    from tsobs_ros.report.bag_report import make_bag_report

    result = make_bag_report(bag, output, **options)
    show(result.as_mapping(), result.text(), as_json)
    return 0
