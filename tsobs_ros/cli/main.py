# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `tsobs` command: parser and exit codes; each sub-command has a module.

Exit codes: 0 done, 1 it failed or was interrupted (stderr says why), 2 wrong usage.
"""

import argparse
import os
import sys
import threading
from collections.abc import Sequence

from tsobs_ros import __version__
from tsobs_ros.cli import bag, campaign, compare, demo, design, estimate, export, fit, report, watch
from tsobs_ros.cli.common import note
from tsobs_ros.errors import TsobsError, complain, complain_of_missing, printable
from tsobs_ros.stop import interrupt

_COMMANDS = (demo, fit, design, estimate, compare, campaign, export, report, watch, bag)
"""The modules in the order of the help."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run `tsobs` with the given arguments, `sys.argv` by default; return the exit code."""
    if threading.current_thread() is threading.main_thread():
        interrupt()
    try:
        parser = argparse.ArgumentParser(
            prog="tsobs",
            description="State and sensor-disturbance estimation for an arm with an elastic joint.",
        )
        parser.add_argument("--version", action="version", version=f"tsobs {__version__}")
        commands = parser.add_subparsers(required=True, metavar="COMMAND")
        for module in _COMMANDS:
            module.add_parser(commands)
        options, unknown = parser.parse_known_args(argv)
        if unknown:  # as parse_args, but a shell pattern may give any file name
            parser.error(printable(f"unrecognized arguments: {' '.join(unknown)}"))
        exit_code: int = options.command(options)
        return exit_code
    except TsobsError as error:
        complain(error)
    except ModuleNotFoundError as error:
        complain_of_missing(error)
    except UnicodeEncodeError as error:  # from a file name, which may be any bytes
        complain(f"expected names in UTF-8: {error}")
    except KeyboardInterrupt:
        note("interrupted")
    except OSError as error:
        if not isinstance(error, BrokenPipeError):  # the reader of the output has gone
            complain(error)
        try:
            sys.stdout.flush()
        except OSError:  # the flush at exit would fail again
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 1


if __name__ == "__main__":
    sys.exit(main())
