# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs design`: design a gain; `tsobs verify`: re-check the certificate of its file."""

import argparse
import math
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_command, show
from tsobs_ros.errors import complain, printable
from tsobs_ros.files import require_new
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.schema import naming

_UNITS = {"inertia": "kg m^2", "stiffness": "N m/rad", "torque": "N m", "damping": "N m s/rad"}


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
    from tsobs_ros.design.file import load_request, request_entries, save_design
    from tsobs_ros.design.request import ArmRequest
    from tsobs_ros.design.synthesis import synthesise

    require_new([options.output], force=options.force)
    request = load_request(options.request) if options.request else ArmRequest()
    design = synthesise(request)
    save_design(design, options.output)
    entries, lines = request_entries(request), list[str]()
    if isinstance(request, ArmRequest):
        units = {name: _UNITS[name.rpartition("_")[2]] for name in entries["design"]["arm"]}
        arm = [f"{k} {v:g} {units[k]}" for k, v in entries["design"]["arm"].items()]
        held, free = (frequency / math.tau for frequency in request.arm.resonances)
        lines = [
            f"arm: {', '.join(arm)}",
            f"resonances: {held:.3g} Hz with the motor held, {free:.3g} Hz with both free",
        ]
        if request.rate < 10.0 * free:
            lines.append(
                f"warning: a rate of {request.rate:g} Hz is too low for these resonances: expected "
                f"at least {10.0 * free:.0f} Hz"
            )
    lines += [design.text(), f"written to {printable(str(options.output))}"]
    summary = {"design": str(options.output), "request": entries, **design.summary()}
    show(summary, "\n".join(lines), options.json)
    return 0


def _verify(options: argparse.Namespace) -> int:
    from tsobs_ros.design.file import parse_design, request_entries

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
        holds, text = design.certificate.holds, design.text()
        plain = {"request": request_entries(design.request), **design.summary()}
    show({"design": str(path), **plain}, f"{printable(str(path))}\n{text}", options.json)
    if not holds:
        complain(f"{path}: the certificate does not hold")
    return 0 if holds else 1
