# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs verify`: re-check the certificate of a design file."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_json, complain, show
from tsobs_ros.errors import printable
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.schema import naming


def add_parser(commands: Commands) -> None:
    """Add the command `verify`."""
    verify = commands.add_parser("verify", help="re-check the certificate of a design file")
    verify.add_argument("design", type=Path, nargs="?", help="default: the shipped design")
    verify.add_argument(
        "--exact", action="store_true", help="in rational arithmetic, without any rounding"
    )
    add_json(verify)
    verify.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Re-check the certificate of a design file."""
    from tsobs_ros.design.file import parse_design

    path = options.design or config_path(SHIPPED_DESIGN)
    design = parse_design(path)
    if options.exact:
        from tsobs_ros.design.exact import verify_exactly

        with naming(path):
            proof = verify_exactly(design)
        holds, plain, text = proof.holds, proof.as_mapping(), proof.text()
    else:
        holds, plain, text = design.certificate.holds, design.summary(), design.text()
    show({"design": str(path), **plain}, f"{printable(str(path))}\n{text}", options.json)
    if not holds:
        complain(f"{path}: the certificate does not hold")
    return 0 if holds else 1
