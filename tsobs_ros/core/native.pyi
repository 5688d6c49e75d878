# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of the extension module; module.c and the python_*.c files have the functions."""

from typing import Any

class Memory:
    """An array's address, looked up once; the array must stay as it is."""

    def __init__(self, array: Any) -> None: ...

def messages_split(data: Any, found: Any, /) -> int:
    """Write the fields of each message in some records, and return their number or -1."""
