# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs report`: page, figure and table of a recorded run; `tsobs paper` and `tsobs config`.

`tsobs paper` remakes the published method's figures, `tsobs config` prints the config folder.
"""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_command, at_least_one, keywords, progress, show
from tsobs_ros.errors import LogError
from tsobs_ros.resources import SHIPPED_DESIGN, config_path


def add_parser(commands: Commands) -> None:
    """Add the commands `report`, `paper` and `config`."""
    text = "page, figure and table of a recorded run"
    add = add_command(commands, "report", run, text).add_argument
    add("bag", type=Path)
    add("--output", type=Path, help="folder for the report (default: by the bag)")
    add("--joint", metavar="NAME", help="joint to report on, if there are several")
    add("--topic", metavar="NAME", help="its measurements, if there are several arms")
    add(
        "--design", metavar="FILE",
        help="the observer's design (default: what the bag's observer ran, else the shipped one)",
    )  # fmt: skip
    add(
        "--other-design", action="store_true",
        help="let --design name another design than the bag's observer ran",
    )  # fmt: skip
    add("--no-ekf", action="store_false", dest="ekf", help="leave out the EKF comparison")
    add("--force", action="store_true", help="replace existing files")
    text = "the published method: its figures, and what holds"
    add = add_command(commands, "paper", _paper, text).add_argument
    add("--output", type=Path, default=Path("paper"), help="folder to write to")
    add("--seeds", type=at_least_one, default=20, metavar="N", help="runs of Example 3")
    add("--force", action="store_true", help="replace existing files")
    text = "print the folder of the shipped parameters, requests and designs"
    commands.add_parser("config", help=text).set_defaults(command=_config)


def run(options: argparse.Namespace) -> int:
    """Report on a recorded run."""
    from tsobs_ros.replay.estimate import is_log

    if is_log(options.bag):
        raise LogError(
            f"{options.bag}: a log has no estimates to report on; first write a bag of them: "
            f"tsobs estimate {options.bag}"
        )
    from tsobs_ros.report.bag_report import make_bag_report

    output = options.output or options.bag.parent
    report = make_bag_report(options.bag, output, **keywords(options, make_bag_report))
    show(*report, options.json)
    return 0


def _paper(options: argparse.Namespace) -> int:
    from tsobs_ros.report.published import make_paper_report

    with progress(3, " examples", quiet=options.json) as advance:
        data, text = make_paper_report(
            options.output, options.seeds, force=options.force, advance=advance
        )
    show(data, text, options.json)
    return 0


def _config(options: argparse.Namespace) -> int:
    print(config_path(SHIPPED_DESIGN).parent)
    return 0
