# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs verify`: re-check the certificate of a design file."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_json, complain, show
from tsobs_ros.cli.design_summary import summary, summary_text
from tsobs_ros.errors import DesignFileError
from tsobs_ros.resources import SHIPPED_DESIGN, config_path


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
    from tsobs_ros.design.ts_file import is_ts_file, parse_ts_design

    path = options.design or config_path(SHIPPED_DESIGN)
    if is_ts_file(path):
        if options.exact:
            raise DesignFileError(f"{path}: --exact is for designs of the arm, not of T-S models")
        ts_design = parse_ts_design(path)
        show({"design": str(path), **ts_design.summary()}, ts_design.text(), options.json)
        return _verdict(path, ts_design.certificate.holds)
    parsed = parse_design(path)
    if options.exact:
        from tsobs_ros.design.exact import verify_exactly

        proof = verify_exactly(parsed)
        show({"design": str(path), **proof.as_mapping()}, f"{path}\n{proof.text()}", options.json)
        return _verdict(path, proof.holds)
    holds = parsed.certificate.holds
    verdict = "the certificate holds" if holds else "THE CERTIFICATE DOES NOT HOLD"
    show(
        {"design": str(path), **summary(parsed)},
        f"{path}\n{summary_text(parsed)}\n{verdict}",
        options.json,
    )
    return _verdict(path, holds)


def _verdict(path: Path, holds: bool) -> int:
    if not holds:
        complain(f"{path}: the certificate does not hold")
    return 0 if holds else 1
