# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs campaign`: thousands of simulated runs."""

import argparse
import time
from pathlib import Path

from tsobs_ros.cli.common import (
    Commands,
    add_command,
    at_least_one,
    json_text,
    note,
    progress,
    show,
)
from tsobs_ros.errors import complain, printable
from tsobs_ros.files import write_whole


def add_parser(commands: Commands) -> None:
    """Add the command `campaign`."""
    text = "many simulated runs: their errors, compared with the certified bound"
    add = add_command(commands, "campaign", run, text).add_argument
    add("campaign", type=Path, nargs="?", metavar="FILE", help="YAML, as config/campaign.yaml")
    add(
        "--output", type=Path, metavar="DIR", required=True,
        help="folder; one of the same campaign is continued",
    )  # fmt: skip
    add("--runs", type=at_least_one, metavar="N", help="number of runs (default: the file's)")
    add(
        "--workers", type=at_least_one, metavar="N", dest="threads",
        help="threads (default: as many as cores)",
    )  # fmt: skip
    add(
        "--rerun", nargs=2, metavar=("ID", "DIR"),
        help="make one run of a campaign again, as a bag and a report in --output",
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Run a campaign, or make one of its runs again."""
    if (options.campaign is None) == (options.rerun is None):
        options.parser.error("expected one of FILE and --rerun ID DIR")
    if options.rerun is not None:
        if options.runs or options.threads:
            options.parser.error("--runs, --workers: are for FILE, not for --rerun")
        if not options.rerun[0].isdecimal():
            options.parser.error(f"--rerun: expected the number of a run, got {options.rerun[0]}")
        return _rerun(options)
    from tsobs_ros.campaign.definition import load_campaign
    from tsobs_ros.campaign.drawing import check
    from tsobs_ros.campaign.folder import SUMMARY, run_campaign
    from tsobs_ros.campaign.summary import render, summarise
    from tsobs_ros.schema import naming

    begin, campaign = time.monotonic(), load_campaign(options.campaign)
    if options.runs is not None:
        campaign = campaign.with_runs(options.runs)
    with naming(options.campaign):
        check(campaign)
    with progress(campaign.entries.runs, " runs", quiet=options.json) as advance:
        try:
            columns = run_campaign(
                campaign, options.output, threads=options.threads, progress=advance
            )
        except KeyboardInterrupt:
            complain("interrupted; the same command goes on with the runs that are missing")
            return 1
    summary = summarise(campaign, columns)
    text = render(summary)
    for name, content in zip(SUMMARY, (json_text(summary), text), strict=True):
        write_whole(options.output / name, content + "\n")
    note(f"{time.monotonic() - begin:.1f} s")
    show(summary, printable(text, newline="\n"), options.json)
    return 0


def _rerun(options: argparse.Namespace) -> int:
    from tsobs_ros.campaign.definition import CAMPAIGN, load_campaign
    from tsobs_ros.campaign.rerun import rerun
    from tsobs_ros.report.bag_report import make_bag_report

    number, folder = options.rerun
    bag = rerun(load_campaign(Path(folder, CAMPAIGN)), int(number), options.output)
    show(*make_bag_report(bag, options.output), options.json)
    return 0
