# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs campaign`: thousands of simulated runs, here or on a cluster."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tsobs_ros.cli.common import (
    Commands,
    add_command,
    at_least_one,
    complain,
    keywords,
    progress,
    show,
)
from tsobs_ros.errors import printable

if TYPE_CHECKING:
    from tsobs_ros.campaign.folder import CampaignFolder


def add_parser(commands: Commands) -> None:
    """Add the command `campaign`."""
    text = "many simulated runs: errors, and the certified bound against them"
    add = add_command(commands, "campaign", run, text).add_argument
    add("campaign", type=Path, nargs="?", metavar="FILE", help="YAML, as config/campaign.yaml")
    add("--output", type=Path, metavar="DIR", help="folder; of the same campaign: to go on with it")
    add("--runs", type=at_least_one, metavar="N", help="instead of the file's")
    add(
        "--workers", type=at_least_one, metavar="N", dest="threads",
        help="threads of this machine (default: its cores)",
    )  # fmt: skip
    add("--scheduler", metavar="ADDRESS", help="of a Dask cluster, such as tcp://10.0.0.1:8786")
    add("--force", action="store_true", help="replace another campaign in the folder")
    add("--show", type=Path, metavar="DIR", help="show the tables of a campaign")
    add(
        "--rerun", nargs=2, metavar=("ID", "DIR"),
        help="make one run of a campaign again, as a bag and a report in --output",
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Run a campaign, show one, or make one of its runs again."""
    if sum(each is not None for each in (options.campaign, options.show, options.rerun)) != 1:
        options.parser.error("expected one of FILE, --show DIR and --rerun ID DIR")
    if options.show is None and options.output is None:
        options.parser.error("--output is missing")
    if options.threads is not None and options.scheduler is not None:
        options.parser.error("--workers is for this machine, not for a cluster")
    if options.rerun is not None:
        return _rerun(options)
    from tsobs_ros.campaign.folder import CampaignFolder

    if options.show is not None:
        return _show(options, CampaignFolder.open(options.show), None)
    return _run(options)


def _run(options: argparse.Namespace) -> int:
    from tsobs_ros.campaign.definition import load_campaign
    from tsobs_ros.campaign.folder import run_campaign

    begin = time.monotonic()
    campaign = load_campaign(options.campaign)
    if options.runs is not None:
        campaign = campaign.with_runs(options.runs)
    with progress(campaign.entries.runs, " runs", quiet=options.json) as advance:
        try:
            folder = run_campaign(
                campaign, options.output, progress=advance, **keywords(options, run_campaign)
            )
        except KeyboardInterrupt:
            complain("interrupted; the same command goes on with the runs that are missing")
            return 1
    return _show(options, folder, time.monotonic() - begin)


def _show(options: argparse.Namespace, folder: "CampaignFolder", seconds: float | None) -> int:
    from tsobs_ros.campaign.summary import render, summarise

    summary = summarise(folder.campaign, folder.read())
    text = render(summary)
    if seconds is not None:
        folder.write_summary([json.dumps(summary, indent=2) + "\n", text + "\n"])
        print(f"{seconds:.1f} s", file=sys.stderr)
    show(summary, printable(text, newline="\n"), options.json)
    return 0


def _rerun(options: argparse.Namespace) -> int:
    from tsobs_ros.campaign.folder import CampaignFolder
    from tsobs_ros.campaign.rerun import rerun
    from tsobs_ros.report.bag_report import make_bag_report

    number, folder = options.rerun
    bag = rerun(CampaignFolder.open(Path(folder)).campaign, int(number), options.output)
    show(*make_bag_report(bag, options.output), options.json)
    return 0
