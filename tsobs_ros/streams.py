# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Standard streams that are closed, full or gone."""

import argparse
import os
import sys
from typing import IO


def keep_standard_streams() -> None:
    """Put /dev/null where a standard stream is closed.

    A file would get its number else, and what is printed to stderr would come to stdout.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)
            if null != number:
                os.dup2(null, number)
                os.close(null)
            os.set_inheritable(number, True)
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115


class Parser(argparse.ArgumentParser):
    """One whose help raises an OSError if it cannot be printed, as on a disk that is full."""

    def _print_message(self, message: str, file: IO[str] | None = None) -> None:  # type: ignore[override]
        try:
            print(message, end="", file=file or sys.stderr, flush=True)
        except OSError:
            if file is sys.stdout:
                raise
