# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs bag`: look at a bag, check it, and recover a damaged one."""

import argparse
from contextlib import AbstractContextManager
from pathlib import Path

from tsobs_ros.cli.common import Advance, Commands, add_command, keywords, progress, show


def add_parser(commands: Commands) -> None:
    """Add the command `bag` and its actions."""
    bag = commands.add_parser("bag", help="look at a bag, check it, or recover a damaged one")
    actions = bag.add_subparsers(required=True, metavar="ACTION")
    for name, run, text in (
        ("info", _info, "files, times and topics, also of an unfinished bag"),
        ("verify", _verify, "check that every tool reads the bag; exit code 1 with reasons if not"),
        ("recover", _recover, "make a whole copy of a damaged or unfinished bag"),
    ):
        add = add_command(actions, name, run, text).add_argument
        add("bag", type=Path, help="a bag's folder, or one MCAP file")
        if name != "info":
            add(
                "--trusted", action="store_true", dest="is_trusted",
                help="read chunks of any decompressed size (default: 1 GiB + 100 times the file)",
            )  # fmt: skip
    add("--output", type=Path, metavar="FOLDER", help="bag to make (default: BAG_recovered)")
    add("--compression", choices=("none", "lz4", "zstd"), default="zstd", help="of the new bag")


def _info(options: argparse.Namespace) -> int:
    from tsobs_ros.bag.summary import summarise

    summary = summarise(options.bag)
    show(summary, summary.text(), options.json)
    return 0


def _verify(options: argparse.Namespace) -> int:
    from tsobs_ros.bag.verification import verify

    with _bytes_read(options) as advance:
        verification = verify(options.bag, advance, is_trusted=options.is_trusted)
    show(verification.as_mapping(), verification.text(), options.json)
    return 0 if verification.holds else 1


def _recover(options: argparse.Namespace) -> int:
    from tsobs_ros.bag.recovery import recover

    bag = options.bag.absolute()
    output = options.output or bag.with_name(f"{bag.name.removesuffix('.mcap')}_recovered")
    with _bytes_read(options) as advance:
        recovery = recover(options.bag, output, progress=advance, **keywords(options, recover))
    show(recovery.as_mapping(), recovery.text(), options.json)
    return 0


def _bytes_read(options: argparse.Namespace) -> AbstractContextManager[Advance]:
    """Show how much of the bag has been read."""
    files = options.bag.glob("*.mcap") if options.bag.is_dir() else [options.bag]
    total = sum(file.stat().st_size for file in files if file.is_file())
    return progress(total, "B", scale=True, quiet=options.json)
