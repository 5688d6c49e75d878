# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `tsobs` command: words, options and exit codes; what the words do is in `commands`.

Exit codes: 0 done, 1 it failed or was interrupted (stderr says why), 2 wrong usage.
"""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from tsobs_ros import __version__, commands
from tsobs_ros.errors import TsobsError

_EXTRAS = {
    "cvxpy": "design",
    "clarabel": "design",
    "matplotlib": "report",
    "plotly": "report",
    "tqdm": "report",
    "mcap_ros2": "report",
}
"""Which optional dependency of the package brings which module."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run `tsobs` with the given arguments, `sys.argv` by default; return the exit code."""
    options = _parser().parse_args(argv)
    command: Callable[[argparse.Namespace], int] = options.command
    if threading.current_thread() is threading.main_thread():
        # As Ctrl-C: what was begun, nodes of the demo above all, is ended in order.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return command(options)
    except TsobsError as error:
        print(f"error: {error}", file=sys.stderr)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in _EXTRAS:
            raise
        hint = f"pip install 'tsobs_ros[{_EXTRAS[missing]}]'"
        print(f"error: {missing} is not installed; {hint}", file=sys.stderr)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    except BrokenPipeError:
        # The reader of our output has gone; flushing at exit would fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tsobs",
        description="State and sensor-disturbance estimation for an arm with an elastic joint.",
    )
    parser.add_argument("--version", action="version", version=f"tsobs {__version__}")
    words = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_demo(words)
    _add_design(words)
    _add_verify(words)
    _add_report(words)
    _add_paper(words)
    return parser


def _add_demo(words: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    demo = words.add_parser("demo", help="simulate, observe, record and report, over ROS")
    demo.add_argument("--output", type=Path, help="folder to make (default: demo/<date and time>)")
    demo.add_argument("--duration", type=_positive, default=20.0, metavar="S")
    demo.add_argument("--seed", type=int, default=1)
    demo.add_argument("--bias", type=float, default=0.1, metavar="RAD", help="size of the step")
    demo.add_argument("--bias-at", type=_positive, default=8.0, metavar="S")
    demo.add_argument(
        "--stiffness", type=float, default=0.0, metavar="X", help="true stiffness is 1 + X nominal"
    )
    demo.add_argument(
        "--gravity", type=float, default=0.0, metavar="X", help="true gravity is 1 + X nominal"
    )
    demo.add_argument("--design", type=Path, metavar="FILE", help="design of the observer")
    demo.add_argument(
        "--domain-id",
        type=int,
        metavar="N",
        help="ROS domain (default: one of its own, so that nothing else is disturbed)",
    )
    _add_json(demo)
    demo.set_defaults(command=commands.demo)


def _add_design(words: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    design = words.add_parser("design", help="design a gain and write its file")
    design.add_argument(
        "request", type=Path, nargs="?", help="YAML with the arm, noise and domain; else defaults"
    )
    design.add_argument("--output", type=Path, required=True, metavar="FILE")
    design.add_argument(
        "--method",
        choices=("certified", "paper"),
        default="certified",
        help="the certified design, or Steps 1-5 of the published method for one of its examples",
    )
    design.add_argument(
        "--example", type=int, choices=(1, 2, 3), default=1, help="of the published method"
    )
    design.add_argument("--force", action="store_true", help="replace an existing file")
    _add_json(design)
    design.set_defaults(command=commands.design)


def _add_verify(words: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    verify = words.add_parser("verify", help="re-check the certificate of a design file")
    verify.add_argument("design", type=Path, nargs="?", help="default: the shipped design")
    verify.add_argument(
        "--exact", action="store_true", help="in rational arithmetic, without any rounding"
    )
    _add_json(verify)
    verify.set_defaults(command=commands.verify)


def _add_report(words: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    report = words.add_parser("report", help="table and figures of a recorded run")
    report.add_argument("bag", type=Path)
    report.add_argument("--output", type=Path, help="folder for the report (default: by the bag)")
    report.add_argument("--design", type=Path, metavar="FILE", help="default: the shipped design")
    report.add_argument("--no-ekf", action="store_true", help="leave out the EKF comparison")
    _add_json(report)
    report.set_defaults(command=commands.report)


def _add_paper(words: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    paper = words.add_parser("paper", help="the published method: its figures, and what holds")
    paper.add_argument("--output", type=Path, default=Path("paper"), help="folder to write to")
    paper.add_argument("--seeds", type=int, default=20, metavar="N", help="runs of Example 3")
    _add_json(paper)
    paper.set_defaults(command=commands.paper)


def _add_json(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", action="store_true", help="print the result as JSON")


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return value


if __name__ == "__main__":
    sys.exit(main())
