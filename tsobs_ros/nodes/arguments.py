# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line of a node's executable: its `--help`, and the refusal of unknown arguments."""

import argparse
import inspect
from collections.abc import Sequence
from types import ModuleType

from rclpy.utilities import remove_ros_args

from tsobs_ros.errors import printable
from tsobs_ros.settings import describe
from tsobs_ros.streams import Parser

_HELP = {"-h", "--help"}


def check_arguments(module: ModuleType, arguments: Sequence[str]) -> None:
    """Print the help if it is asked for, and refuse what neither the node nor ROS understands.

    Args:
        module: The node's module: its docstring describes the node and its topics, its
            `Parameters` are the dataclass of its parameters.
        arguments: Command line including the program's name.

    Raises:
        SystemExit: With 0 after the help, with 2 after an error.
    """
    name, listed = module.__name__.rpartition(".")[2], ["parameters:"]
    for setting, kind, default, accepted, description in describe(module.Parameters):
        facts = "; ".join(filter(None, (kind, f"default {default}", accepted)))
        listed += [f"  {setting} ({facts})", f"      {description}"]
    parser = Parser(
        prog=name,
        usage=f"{name} [--help] [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r OLD:=NEW] …]",
        description=inspect.getdoc(module),
        epilog="\n".join(listed),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    try:
        # ROS does not know --help, and it may come after --ros-args.
        own = ["--help"] if _HELP & {*arguments} else remove_ros_args(arguments)[1:]
    except RuntimeError as error:
        # rclpy does not export the type. What is malformed is for rclpy.init to report.
        if type(error).__name__ == "UnknownROSArgsError":
            parser.error(printable(f"unrecognized ROS arguments: {error}"))
        return
    parser.parse_args(list(map(printable, own)))
