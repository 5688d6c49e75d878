# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the command prints: text for people, or JSON for programs."""

import json
import math
import sys
from typing import Any

from tsobs_ros.errors import printable


def show(mapping: dict[str, Any], text: str, as_json: bool) -> None:
    """Print a result, as JSON or as text."""
    print(json.dumps(_plain(mapping), indent=2, allow_nan=False) if as_json else printable(text))


def complain(problem: object) -> None:
    """Print what is wrong, to stderr."""
    print(f"error: {printable(str(problem))}", file=sys.stderr)


def _plain(value: Any) -> Any:
    """Return the value with null for every number that JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
