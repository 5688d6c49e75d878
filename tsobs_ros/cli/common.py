# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Options and output that the commands share: text for people, JSON for programs, progress."""

import argparse
import inspect
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from importlib.util import find_spec
from typing import Any, TypeAlias

from tsobs_ros.errors import printable

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""The object to which a command adds its parser."""

Run = Callable[[argparse.Namespace], int]
"""Runs a command with its options, and returns the exit code."""

Advance = Callable[[int], None]
"""Called with the amount of work done since its last call."""


def add_command(commands: Commands, name: str, run: Run, text: str) -> argparse.ArgumentParser:
    """Add a command that shows its result, as text or as JSON; return its parser."""
    command = commands.add_parser(name, help=text)
    command.add_argument("--json", action="store_true", help="print the result as JSON")
    command.set_defaults(command=run, parser=command)
    return command


def add_log_options(command: argparse.ArgumentParser) -> None:
    """Add options that describe CSV logs if the header does not."""
    add = command.add_argument_group("for CSV logs", "if the header does not say it").add_argument
    add(
        "--columns", type=pairs, default={}, metavar="WHAT=COLUMN,...",
        help="time=t,angle=q,torque=tau, or names of outputs, as motor_angle=q2; "
        "angle.JOINT=… and torque.JOINT=… for several joints",
    )  # fmt: skip
    add(
        "--units", type=pairs, default={}, metavar="WHAT=UNIT,...",
        help="time=ms,angle=deg,torque=mNm, for columns whose name has no unit, as in 'q [deg]'",
    )  # fmt: skip


def keywords(options: argparse.Namespace, function: Callable[..., Any]) -> dict[str, Any]:
    """Return the options that have the names of a function's keyword-only arguments."""
    parameters = inspect.signature(function).parameters.values()
    names = {each.name for each in parameters if each.kind is each.KEYWORD_ONLY}
    return {name: value for name, value in vars(options).items() if name in names}


def positive(text: str, kind: type[float] = float) -> float:
    """Return the number in an option's text, which must be above 0."""
    with suppress(ValueError):
        if 0 < (value := kind(text)) < math.inf:
            return value
    whole = "whole " * (kind is int)
    raise argparse.ArgumentTypeError(f"expected a {whole}number above 0, got {text}")


at_least_one = partial(positive, kind=int)


def pairs(text: str) -> dict[str, str]:
    """Return the pairs in an option's text, such as `time=t,angle=q`."""
    items = [item.partition("=") for item in text.split(",")]
    for name, sign, value in items:
        if not (name.strip() and sign and value.strip()):
            raise argparse.ArgumentTypeError(f"expected NAME=VALUE,…, got {text!r}")
    return {name.strip(): value.strip() for name, _, value in items}


def joined(given: list[dict[str, str]]) -> dict[str, str]:
    """Return the pairs of a repeated option as one mapping."""
    return {name: value for one in given for name, value in one.items()}


def show(mapping: dict[str, Any], text: str, as_json: bool) -> None:
    """Print a result, as JSON or as text."""
    if as_json:
        text = json_text(mapping)
    print(printable(text, newline="\n"), flush=True)


def json_text(mapping: dict[str, Any]) -> str:
    """Return plain data as JSON, with null for numbers that JSON lacks."""
    plain = json.loads(json.dumps(mapping), parse_constant=lambda _: None)
    return json.dumps(plain, indent=2).replace("\x7f", r"\u007f")


def note(text: str) -> None:
    """Print a line that is not part of the result, to stderr."""
    with suppress(OSError):  # the terminal has gone
        print(text, file=sys.stderr)


@contextmanager
def progress(
    total: int, unit: str, *, scale: bool = False, quiet: bool = False
) -> Iterator[Advance]:
    """Show a progress bar while the block runs, if stderr is a terminal and tqdm is installed.

    With `scale`, large amounts of work have prefixes such as M.
    """
    if quiet or not sys.stderr.isatty() or find_spec("tqdm") is None:
        yield lambda _: None
        return
    from tqdm import tqdm

    with tqdm(total=total, unit=unit, unit_scale=scale, leave=False) as bar:
        yield bar.update
