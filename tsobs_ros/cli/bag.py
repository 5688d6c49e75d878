# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs bag`: look at a bag, check it, and recover a damaged one."""

import argparse
from contextlib import AbstractContextManager
from pathlib import Path

from tsobs_ros.cli.common import Advance, Commands, add_json, progress, show


def add_parser(commands: Commands) -> None:
    """Add the command `bag` and its actions."""
    bag = commands.add_parser("bag", help="look at a bag, check it, or recover a damaged one")
    actions = bag.add_subparsers(required=True, metavar="ACTION")
    _add_info(actions)
    _add_verify(actions)
    _add_recover(actions)


def _add_info(actions: Commands) -> None:
    info = actions.add_parser("info", help="files, times and topics, also of an unfinished bag")
    _add_bag(info)
    add_json(info)
    info.set_defaults(command=_info)


def _add_verify(actions: Commands) -> None:
    verify = actions.add_parser(
        "verify", help="check that every tool reads the bag; exit code 1 with the reasons if not"
    )
    _add_bag(verify)
    _add_trusted(verify)
    add_json(verify)
    verify.set_defaults(command=_verify)


def _add_recover(actions: Commands) -> None:
    recover = actions.add_parser(
        "recover", help="make a whole bag of a damaged or unfinished one, which is not touched"
    )
    _add_bag(recover)
    recover.add_argument(
        "--output", type=Path, metavar="FOLDER", help="bag to make (default: BAG_recovered)"
    )
    recover.add_argument(
        "--compression", choices=("none", "lz4", "zstd"), default="zstd", help="of the new bag"
    )
    recover.add_argument(
        "--keep-unchecked",
        action="store_true",
        help="also keep what can be read where checksums fail: some of it is wrong",
    )
    _add_trusted(recover)
    add_json(recover)
    recover.set_defaults(command=_recover)


def _add_bag(action: argparse.ArgumentParser) -> None:
    action.add_argument("bag", type=Path, help="a bag's folder, or one MCAP file")


def _add_trusted(action: argparse.ArgumentParser) -> None:
    action.add_argument(
        "--trusted",
        action="store_true",
        help="read chunks however much they decompress to (default: 1 GiB + 100 times the file)",
    )


def _info(options: argparse.Namespace) -> int:
    from tsobs_ros.bag.summary import summarise

    summary = summarise(options.bag)
    show(summary.as_mapping(), summary.text(), options.json)
    return 0


def _verify(options: argparse.Namespace) -> int:
    from tsobs_ros.bag.verification import verify

    with _bytes_read(options, passes=1) as advance:
        verification = verify(options.bag, advance, is_trusted=options.trusted)
    show(verification.as_mapping(), verification.text(), options.json)
    return 0 if verification.holds else 1


def _recover(options: argparse.Namespace) -> int:
    from tsobs_ros.bag.recovery import recover

    bag = options.bag.absolute()
    default = bag.with_name(f"{bag.name.removesuffix('.mcap')}_recovered")
    with _bytes_read(options, passes=2) as advance:
        recovery = recover(
            options.bag,
            options.output or default,
            compression=options.compression,
            keep_unchecked=options.keep_unchecked,
            is_trusted=options.trusted,
            progress=advance,
        )
    show(recovery.as_mapping(), recovery.text(), options.json)
    return 0


def _bytes_read(options: argparse.Namespace, passes: int) -> AbstractContextManager[Advance]:
    """Show how much of the bag has been read."""
    files = options.bag.glob("*.mcap") if options.bag.is_dir() else [options.bag]
    total = passes * sum(file.stat().st_size for file in files if file.is_file())
    return progress(total, "B", scale=True, quiet=options.json)
