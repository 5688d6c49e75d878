# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs excite`: a motion that reveals a joint's numbers; `tsobs fit`: a fit of these numbers."""

import argparse
from pathlib import Path
from typing import Any

from tsobs_ros.cli.common import (
    Commands,
    add_command,
    add_log_options,
    at_least_one,
    keywords,
    note,
    positive,
    progress,
    show,
)
from tsobs_ros.errors import complain, printable
from tsobs_ros.files import require_new, write_whole, written_whole


def add_parser(commands: Commands) -> None:
    """Add the commands `excite` and `fit`."""
    text = "make a torque motion that reveals the numbers that fit looks for"
    add = add_command(commands, "excite", _excite, text).add_argument
    add("request", type=Path, help="YAML with the numbers of data sheets")
    add("--output", type=Path, required=True, metavar="FILE", help="CSV to write")
    add("--force", action="store_true", help="replace an existing file")
    add("--duration", type=positive, default=30.0, metavar="S", help="of the motion (default: 30)")
    add(
        "--max-torque", type=positive, metavar="NM",
        help="largest torque at the motor (default: half of the request's torque_limit, at most "
        "the gravity torque, or 10 rad/s^2 of both inertias without gravity)",
    )  # fmt: skip
    add(
        "--max-angle", type=positive, metavar="RAD",
        help="largest angle of link and motor (default: 0.9 of the request's x_max)",
    )  # fmt: skip
    add(
        "--max-velocity", type=positive, metavar="RAD/S",
        help="largest velocity of both (default: none)",
    )  # fmt: skip
    add(
        "--free", action="append", default=[], metavar="NAME",
        help="a number to show, or a group, as for fit; can be repeated (default: all but "
        "torque.gain)",
    )  # fmt: skip
    add(
        "--candidates", type=at_least_one, metavar="N",
        help="motions that the search tries (default: 120, fewer of more than 30 s)",
    )  # fmt: skip
    add("--seed", type=int, default=0, help="of the search (default: 0)")

    text = "fit a request's numbers to recordings of the arm"
    command = add_command(commands, "fit", _fit, text)
    add = command.add_argument
    add("request", type=Path, help="YAML with the numbers of data sheets")
    add("logs", type=Path, nargs="+", metavar="LOG", help="CSV logs or bags")
    add("--output", type=Path, required=True, metavar="FILE", help="fitted request")
    add(
        "--report", type=Path, metavar="PAGE.html",
        help="page of the fit: its numbers, predictions, residuals, and what the model lacks",
    )  # fmt: skip
    add("--force", action="store_true", help="replace existing files")
    add(
        "--free", action="append", default=[], metavar="NAME",
        help="a number to fit, such as stiffness or torque.gain, or a group, such as arm; can be "
        "repeated (default: all but torque.gain)",
    )  # fmt: skip
    add(
        "--held-out", type=float, default=0.25, metavar="SHARE",
        help="share at the end of each log to predict instead (default: 0.25)",
    )  # fmt: skip
    add("--joint", help="the joint's name in the logs, if they have several")
    add("--topic", help="the measurements' topic in bags, if they have several")
    add_log_options(command)


def _excite(options: argparse.Namespace) -> int:
    """Find a motion and write it."""
    from tsobs_ros.design.file import load_request
    from tsobs_ros.identification.excitation import excite

    require_new([options.output], force=options.force)
    request: Any = load_request(options.request)
    with progress(0, " motions", quiet=options.json) as advance:
        found = excite(request, advance=advance, **keywords(options, excite))
    found.save(options.output, force=options.force)
    text = f"{found}\nwritten to {printable(str(options.output))}"
    show({"motion": str(options.output), **found.summary()}, text, options.json)
    if found.unseen:
        note(f"the motion does not show {', '.join(found.unseen)}")
    return 0


def _fit(options: argparse.Namespace) -> int:
    """Fit and write the fitted request."""
    from tsobs_ros.design.file import load_request
    from tsobs_ros.identification.fit import fit
    from tsobs_ros.identification.recordings import DAMAGED
    from tsobs_ros.identification.result import request_text

    report: Path | None = options.report
    require_new([options.output, *([report] if report else [])], force=options.force)
    if report:
        # Imported here, so that a missing library is noticed before the work.
        from tsobs_ros.report.fit import write_page
    request: Any = load_request(options.request)
    with progress(0, " samples", scale=True, quiet=options.json) as advance:
        found = fit(request, *options.logs, advance=advance, **keywords(options, fit))
    names = ", ".join(each.name for each in options.logs)
    write_whole(options.output, request_text(found, names))
    text = f"{found}\nwritten to {printable(str(options.output))}, for tsobs design"
    if report:
        with written_whole(report.parent, force=options.force) as folder:
            write_page(folder / report.name, found, names)
        text += f"\npage: {printable(str(report))}"
    files = {"request": str(options.output), "report": report and str(report)}
    show({**files, **found.summary()}, text, options.json)
    if not all(each.seen for each in found.numbers if each.name.startswith("arm.")):
        note("the recording does not show all numbers of the arm: see above")
    damage = [each for each in found.notes if each.startswith(DAMAGED)]
    return max(map(complain, damage), default=0)
