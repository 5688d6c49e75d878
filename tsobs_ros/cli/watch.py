# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs watch`: an observer's estimates, bounds, faults, rates and rejects, live in a terminal."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from tsobs_ros.cli.common import Commands, add_command, positive, show
from tsobs_ros.errors import NodeError
from tsobs_ros.stop import signal_came

if TYPE_CHECKING:
    from tsobs_ros.nodes.watcher import Snapshot

_ENOUGH = 1.0  # time of estimates that a single snapshot counts rates over [s]


def add_parser(commands: Commands) -> None:
    """Add the command `watch`."""
    text = "an observer's estimates and health, live"
    add = add_command(commands, "watch", run, text).add_argument
    add("--observer", default="/observer", metavar="NAME", help="the observer's full name")
    add("--period", type=positive, default=0.25, metavar="S", help="time between two pictures")
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

    console = Console(highlight=False)
    if options.once or options.json or not sys.stdout.isatty():
        taken, failed = _once(options)
        if taken is None or failed:
            return 1
        if signal_came():
            raise KeyboardInterrupt
        if not taken.is_known:
            raise NodeError(
                f"no observer {taken.observer} within {options.timeout:g} s; is it running, in the "
                "same ROS_DOMAIN_ID, and called so?"
            )
        if options.json:
            show(_plain(taken), "", as_json=True)
        else:
            console.print(picture(taken))
        return 0
    with ExitStack() as stack:
        screens: list[Live] = []

        def draw(snapshot: Snapshot) -> bool:
            # Not before there is something to show: an error would go with the screen.
            if not screens:
                live = Live(console=console, screen=True, auto_refresh=False)
                screens.append(stack.enter_context(live))
            screens[0].update(picture(snapshot), refresh=True)
            return True

        return _watch(options, draw)


def _once(options: argparse.Namespace) -> tuple[Snapshot | None, int]:
    """Return a snapshot with all that an observer publishes, or what there is, and an exit code."""
    taken: Snapshot | None = None
    deadline, first = time.monotonic() + options.timeout, math.inf

    def keep(snapshot: Snapshot) -> bool:
        nonlocal taken, first
        now, taken = time.monotonic(), snapshot
        if snapshot.positions:
            first = min(first, now)
        state = snapshot.statuses.get("state")
        is_silent = state is not None and not state.message.startswith(("TRACKING", "COASTING"))
        is_whole = state is not None and now > first + _ENOUGH
        return not (is_silent or is_whole or now > deadline)

    failed = _watch(options, keep)
    return taken, failed


def _watch(options: argparse.Namespace, take: Callable[[Snapshot], bool]) -> int:
    from tsobs_ros.nodes import runtime
    from tsobs_ros.nodes.watcher import Watcher

    return runtime.run(lambda: Watcher(options.observer, options.period, take), args=[])


def _plain(value: Any) -> Any:
    """Return a record, or a mapping of them, as plain data."""
    value = value._asdict() if hasattr(value, "_asdict") else value
    return {k: _plain(v) for k, v in value.items()} if isinstance(value, dict) else value
