# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the command prints: text for people, or JSON for programs; and how far it is."""

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from tsobs_ros.errors import printable

Told = Callable[[int], None]
"""Told of how much more has been done."""


def show(mapping: dict[str, Any], text: str, as_json: bool) -> None:
    """Print a result, as JSON or as text."""
    print(json.dumps(_plain(mapping), indent=2, allow_nan=False) if as_json else printable(text))


def complain(problem: object) -> None:
    """Print what is wrong, to stderr."""
    print(f"error: {printable(str(problem))}", file=sys.stderr)


@contextmanager
def progress(total: int, unit: str, *, scale: bool = False, quiet: bool = False) -> Iterator[Told]:
    """Show how far it is while the block runs, if somebody looks and tqdm is there to show it.

    Args:
        total: How much there is to do.
        unit: Of that.
        scale: Whether to write large amounts with prefixes such as M.
        quiet: Whether to show nothing.

    Yields:
        What to tell of how much more has been done.
    """
    bar: Any = None
    if not quiet and sys.stderr.isatty():
        with suppress(ModuleNotFoundError):  # nothing depends on a bar
            from tqdm import tqdm

            bar = tqdm(total=total, unit=unit, unit_scale=scale, leave=False)
    if bar is None:
        yield lambda _: None
        return
    with bar:
        yield bar.update


def _plain(value: Any) -> Any:
    """Return the value with null for every number that JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
