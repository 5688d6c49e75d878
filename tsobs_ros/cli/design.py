# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs design`: design a gain; `tsobs verify`: re-check the certificate of its file."""

import argparse
from dataclasses import asdict
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_command, complain, note, show
from tsobs_ros.errors import printable
from tsobs_ros.files import require_new
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.schema import naming


def add_parser(commands: Commands) -> None:
    """Add the commands `design` and `verify`."""
    add = add_command(commands, "design", run, "design a gain and write its file").add_argument
    add(
        "request", type=Path, nargs="?",
        help="YAML with the arm or T-S system, noise and domain; else defaults",
    )  # fmt: skip
    add("--output", type=Path, required=True, metavar="FILE")
    add("--force", action="store_true", help="replace an existing file")
    text = "re-check the certificate of a design file"
    add = add_command(commands, "verify", _verify, text).add_argument
    add("design", type=Path, nargs="?", help="default: the shipped design")
    add("--exact", action="store_true", help="in rational arithmetic, without any rounding")


def run(options: argparse.Namespace) -> int:
    """Design a gain and write its file."""
    from tsobs_ros.design.file import load_request, save_design
    from tsobs_ros.design.plausible import description, questions, resonances
    from tsobs_ros.design.request import ArmRequest
    from tsobs_ros.design.synthesis import synthesise

    require_new([options.output], force=options.force)
    request = load_request(options.request) if options.request else ArmRequest()
    for question in questions(request):
        note(f"is it meant so? {question}")
    design = synthesise(request)
    save_design(design, options.output)
    summary, lines = {"design": str(options.output), **design.summary()}, []
    if isinstance(request, ArmRequest):
        lines = description(request)
        summary |= {"arm": asdict(request.arm), "resonances": list(resonances(request.arm))}
    lines += [design.text(), f"written to {printable(str(options.output))}"]
    show(summary, "\n".join(lines), options.json)
    return 0


def _verify(options: argparse.Namespace) -> int:
    from tsobs_ros.design.file import parse_design

    path = options.design or config_path(SHIPPED_DESIGN)
    design = parse_design(path)
    if options.exact:
        from tsobs_ros.design.exact import verify_exactly

        with naming(path):
            proof = verify_exactly(design)
        holds, plain = proof.holds, {"holds": proof.holds, "inequalities": proof.as_mappings}
        verdict = "proved" if holds else "NOT PROVED"
        lines = [*(f"  {each}" for each in proof.inequalities), f"{verdict} in exact arithmetic"]
        text = "\n".join(lines)
    else:
        holds, plain, text = design.certificate.holds, design.summary(), design.text()
    show({"design": str(path), **plain}, f"{printable(str(path))}\n{text}", options.json)
    if not holds:
        complain(f"{path}: the certificate does not hold")
    return 0 if holds else 1
