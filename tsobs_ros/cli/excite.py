# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs excite`: a torque motion that shows a joint's numbers to `tsobs fit`."""

import argparse
from pathlib import Path

from tsobs_ros.cli.common import (
    Commands,
    add_json,
    at_least_one,
    load_arm_request,
    note,
    positive,
    progress,
    show,
)
from tsobs_ros.errors import printable
from tsobs_ros.files import require_new


def add_parser(commands: Commands) -> None:
    """Add the command `excite`."""
    excite = commands.add_parser(
        "excite", help="make a torque motion that shows what fit looks for"
    )
    excite.add_argument("request", type=Path, help="YAML with the numbers of data sheets")
    excite.add_argument("--output", type=Path, required=True, metavar="FILE", help="CSV to write")
    excite.add_argument("--force", action="store_true", help="replace an existing file")
    excite.add_argument(
        "--duration", type=positive, default=30.0, metavar="S", help="of the motion (default: 30)"
    )
    excite.add_argument(
        "--max-torque", type=positive, metavar="NM",
        help="largest torque at the motor (default: half of the request's torque_limit, at most "
        "the gravity torque, or 10 rad/s^2 of both inertias without gravity)",
    )  # fmt: skip
    excite.add_argument(
        "--max-angle", type=positive, metavar="RAD",
        help="largest angle of link and motor (default: 0.9 of the request's x_max)",
    )  # fmt: skip
    excite.add_argument(
        "--max-velocity", type=positive, metavar="RAD/S",
        help="largest velocity of both (default: a swing through x_max at the joint's fastest "
        "frequency)",
    )  # fmt: skip
    excite.add_argument(
        "--free", action="append", default=[], metavar="NAME",
        help="a number to show, or a group, as of fit; can be repeated (default: all but "
        "torque.gain)",
    )  # fmt: skip
    excite.add_argument(
        "--candidates", type=at_least_one, metavar="N",
        help="motions that the search tries (default: 120, fewer of more than 30 s)",
    )  # fmt: skip
    excite.add_argument("--seed", type=int, default=0, help="of the search (default: 0)")
    add_json(excite)
    excite.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Find a motion and write it."""
    from tsobs_ros.identification.excitation import excite

    require_new([options.output], force=options.force)
    request = load_arm_request(options.request)
    with progress(0, " motions", quiet=options.json) as advance:
        found = excite(
            request,
            duration=options.duration,
            max_torque=options.max_torque,
            max_angle=options.max_angle,
            max_velocity=options.max_velocity,
            free=options.free,
            seed=options.seed,
            candidates=options.candidates,
            advance=advance,
        )
    found.save(options.output, force=options.force)
    path = printable(str(options.output))
    show(
        {"motion": str(options.output), **found.summary()},
        f"{found}\nwritten to {path}",
        options.json,
    )
    if found.unseen:
        note(f"the motion does not show {', '.join(found.unseen)}")
    return 0
