# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs watch`: an observer's estimates, bounds and diagnostics, live in a terminal."""

from __future__ import annotations

import argparse
import math
import sys
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING

from tsobs_ros.cli.common import Commands, add_command, positive, show
from tsobs_ros.errors import NodeError
from tsobs_ros.stop import signal_came

if TYPE_CHECKING:
    from tsobs_ros.nodes.watcher import View

# Time after the first diagnostics within which everything else arrives [s].
_ENOUGH = 1.0


def add_parser(commands: Commands) -> None:
    """Add the command `watch`."""
    text = "an observer's estimates and health, live"
    add = add_command(commands, "watch", run, text).add_argument
    add("--observer", default="/observer", metavar="NAME", help="the observer's full name")
    add("--once", action="store_true", help="print one picture and end, as without a terminal")
    add(
        "--timeout", type=positive, default=10.0, metavar="S",
        help="time to wait for the observer with --once",
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Show an observer until Ctrl-C, or once."""
    from rich.console import Console
    from rich.live import Live

    from tsobs_ros.cli.picture import picture
    from tsobs_ros.nodes import runtime
    from tsobs_ros.nodes.watcher import Watcher

    console = Console(highlight=False)
    once = options.once or options.json or not sys.stdout.isatty()
    deadline: float = time.monotonic() + options.timeout
    seen = math.inf
    newest: View | None = None
    live: Live | None = None

    def take(view: View) -> bool:
        nonlocal newest, live, seen
        newest, now = view, time.monotonic()
        if not once:
            # Only once there is something to show: an earlier error would vanish with the screen.
            live = live or screen.enter_context(
                Live(console=console, screen=True, auto_refresh=False)
            )
            live.update(picture(view), refresh=True)
            return True
        seen = min(seen, now) if view.statuses else seen
        return now < min(deadline, seen + _ENOUGH)

    with ExitStack() as screen:
        failed = runtime.run(lambda: Watcher(options.observer, take), args=[])
    if failed or not once:
        return failed
    if signal_came() or newest is None:
        raise KeyboardInterrupt
    if not (newest.statuses or newest.tables["estimate"]):
        raise NodeError(
            f"no observer {newest.observer} within {options.timeout:g} s; is it running, in the "
            "same ROS_DOMAIN_ID, and called so?"
        )
    if options.json:
        statuses = {name: status._asdict() for name, status in newest.statuses.items()}
        show({**newest._asdict(), "statuses": statuses}, "", as_json=True)
    else:
        console.print(picture(newest))
    return 0
