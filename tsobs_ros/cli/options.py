# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Options that several words of the command have in common."""

import argparse
from typing import TypeAlias

Words: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""Where a word adds its parser."""


def add_json(command: argparse.ArgumentParser) -> None:
    """Let the command print its result as JSON."""
    command.add_argument("--json", action="store_true", help="print the result as JSON")


def positive(text: str) -> float:
    """Return the number in an option's text, which must be above 0."""
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return value
