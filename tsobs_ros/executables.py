# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Entry points of the node executables; light, so that signals are caught before heavy imports.

Importing numpy and rclpy takes a second on a busy machine, and a signal in that time would end the
process with a traceback or a failure. So each entry point first lets signals end the process with
exit code 0, and only then imports its node module ``tsobs_ros.nodes.<name>``, whose ``create()``
makes the node. From then on, a signal sets a flag.
"""

import os
import sys

from tsobs_ros.stop import end_at_once, end_with_parent, ignore_signals

# Before anything else is imported, which takes a tenth of a second on a busy machine.
_NAMES = ("observer", "plant_simulator", "recorder", "player", "visualizer", "tsobs")
_PROCESS = sys.argv[0].rpartition("/")[2]
if _PROCESS in _NAMES:
    end_at_once(_PROCESS == "tsobs")

from functools import partial
from importlib import import_module
from io import TextIOWrapper

from tsobs_ros.errors import complain_of_missing

# Time for the interpreter's own shutdown, which may still destroy a participant.
_FINALISE_TIMEOUT = 5.0


def run(name: str) -> int:
    """Run a node by its name until it is finished or a signal comes; return the exit code.

    Raises:
        SystemExit: With 0 after `--help`, with 2 after arguments that are not understood.
    """
    end_at_once()
    _keep_standard_streams()
    end_with_parent()
    try:
        module = import_module(f"tsobs_ros.nodes.{name}")
        runtime = import_module("tsobs_ros.nodes.runtime")
        runtime.check_arguments(module, sys.argv)
    except ModuleNotFoundError as error:
        return complain_of_missing(error)
    exit_code: int = runtime.run(module.create)
    ignore_signals()
    runtime.limit_time_left(_FINALISE_TIMEOUT)
    return exit_code


def tsobs() -> int:
    """Run the command `tsobs`, which a signal ends with exit code 1; return the exit code."""
    end_at_once(1)
    _keep_standard_streams()
    if isinstance(sys.stdout, TextIOWrapper):  # which may not be in UTF-8
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        exit_code: int = import_module("tsobs_ros.cli.main").main()
    except ModuleNotFoundError as error:  # of a module that every command imports
        exit_code = complain_of_missing(error)
    except KeyboardInterrupt:  # a second signal, while the first was reported
        exit_code = 1
    finally:
        ignore_signals()
    return exit_code


def _keep_standard_streams() -> None:
    """Open /dev/null for each closed standard stream, whose number a file would get otherwise."""
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


observer = partial(run, "observer")
plant_simulator = partial(run, "plant_simulator")
recorder = partial(run, "recorder")
player = partial(run, "player")
visualizer = partial(run, "visualizer")

if __name__ == "__main__":
    # `python -m tsobs_ros.executables observer …` if no script has been installed.
    if len(sys.argv) < 2 or sys.argv[1] not in _NAMES:
        print(f"usage: python -m tsobs_ros.executables {'|'.join(_NAMES)} …", file=sys.stderr)
        sys.exit(2)
    name = sys.argv.pop(1)
    sys.exit(tsobs() if name == "tsobs" else run(name))
