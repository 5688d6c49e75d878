# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs fit`: a request's numbers from recordings."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import Commands, add_json, load_arm_request, note, progress, show
from tsobs_ros.cli.estimate import pairs
from tsobs_ros.errors import printable
from tsobs_ros.files import require_nameable, require_new, written_whole


def add_parser(commands: Commands) -> None:
    """Add the command `fit`."""
    fit = commands.add_parser("fit", help="fit a request's numbers to recordings of the arm")
    fit.add_argument("request", type=Path, help="YAML with the numbers of data sheets")
    fit.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="CSV logs or bags")
    fit.add_argument("--output", type=Path, required=True, metavar="FILE", help="fitted request")
    fit.add_argument(
        "--report", type=Path, metavar="PAGE.html",
        help="page of the fit: its numbers, predictions, residuals, and what the model lacks",
    )  # fmt: skip
    fit.add_argument("--force", action="store_true", help="replace existing files")
    fit.add_argument(
        "--free", action="append", default=[], metavar="NAME",
        help="a number to fit, such as stiffness or torque.gain, or a group, such as arm; can be "
        "repeated (default: all but torque.gain)",
    )  # fmt: skip
    fit.add_argument(
        "--held-out", type=float, default=0.25, metavar="SHARE",
        help="share at the end of each log to predict instead (default: 0.25)",
    )  # fmt: skip
    fit.add_argument("--joint", help="the joint's name in the logs, if they have several")
    fit.add_argument("--topic", help="the measurements' topic in bags, if they have several")
    fit.add_argument(
        "--columns", type=pairs, default={}, metavar="WHAT=COLUMN,...",
        help="columns of CSV logs: time=t,motor_angle=q,torque=tau",
    )  # fmt: skip
    fit.add_argument(
        "--units", type=pairs, default={}, metavar="WHAT=UNIT,...",
        help="their units: time=ms,angle=deg,torque=mNm",
    )  # fmt: skip
    add_json(fit)
    fit.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Fit and write the fitted request."""
    from tsobs_ros.identification.fit import fit
    from tsobs_ros.identification.writing import request_text
    from tsobs_ros.yaml_files import write_yaml

    report: Path | None = options.report
    require_new([options.output, *([report] if report else [])], force=options.force)
    if report:
        # Here, so that a library that is missing shows before the work.
        from tsobs_ros.report.fit import write_page

        require_nameable(report)
    request = load_arm_request(options.request)
    with progress(0, " samples", scale=True, quiet=options.json) as advance:
        found = fit(
            request,
            *options.logs,
            free=options.free,
            held_out=options.held_out,
            columns=options.columns,
            units=options.units,
            joint=options.joint,
            topic=options.topic,
            advance=advance,
        )
    names = ", ".join(each.name for each in options.logs)
    write_yaml(options.output, request_text(found, names))
    page = ""
    if report:
        with written_whole(report.parent, force=options.force) as folder:
            write_page(folder / report.name, found, names)
        page = f"\npage: {printable(str(report))}"
    show(
        {"request": str(options.output), "report": report and str(report), **found.summary()},
        f"{found}\nwritten to {printable(str(options.output))}; next: tsobs design "
        f"{printable(str(options.output))} --output my_arm.design.yaml{page}",
        options.json,
    )
    if not all(each.seen for each in found.numbers if each.name.startswith("arm.")):
        note("the recording does not show all numbers of the arm: see above")
    return 0
