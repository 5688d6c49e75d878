# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Options that say what to estimate from and which observers to run."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from tsobs_ros.cli.options import positive
from tsobs_ros.errors import DesignFileError
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

if TYPE_CHECKING:
    from tsobs_ros.design.record import Design
    from tsobs_ros.methods import ObserverSettings
    from tsobs_ros.replay.estimate import Observer
    from tsobs_ros.replay.source import Source

METHODS = ("certified", "ekf", "high_gain", "proportional_integral", "paper")


def add_observer_options(command: argparse.ArgumentParser, methods: Sequence[str]) -> None:
    """Let a command run observers over a bag or a log.

    Args:
        command: The command.
        methods: What it runs unless told otherwise; empty for what the parameters say.
    """
    command.add_argument("bag", type=Path, metavar="BAG", help="bag folder, MCAP file or CSV log")
    command.add_argument(
        "--design",
        nargs="+",
        default=[],
        metavar="FILE",
        help="design files, each run; JOINT=FILE for joints with designs of their own "
        "(default: the shipped design)",
    )
    said = " ".join(methods) or "certified"
    command.add_argument(
        "--method",
        nargs="+",
        choices=METHODS,
        metavar="METHOD",
        help=f"observers to run, of {', '.join(METHODS)} (default: {said})",
    )
    command.set_defaults(default_methods=methods)
    command.add_argument("--joints", nargs="+", default=[], metavar="NAME", help="default: all")
    command.add_argument("--topic", help="the measurements (default: …/joint_measurements)")
    command.add_argument(
        "--at",
        choices=("recorded", "measurements"),
        help="when to estimate (default: when the recorded observer did, if there is one)",
    )
    command.add_argument("--rate", type=positive, metavar="HZ", help="estimate at a fixed rate")
    as_log = command.add_argument_group("for CSV logs", "where the names of columns do not tell")
    as_log.add_argument(
        "--columns",
        type=pairs,
        default={},
        metavar="WHAT=COLUMN,...",
        help="time=t,angle=q,torque=tau; angle.JOINT=… and torque.JOINT=… for several joints",
    )
    as_log.add_argument(
        "--units",
        type=pairs,
        default={},
        metavar="WHAT=UNIT,...",
        help="time=ms,angle=deg,torque=Nm, for columns that are not called such as 'q [deg]'",
    )
    as_run = command.add_argument_group("parameters", "named as those of the observer node")
    as_run.add_argument("--params-file", type=Path, metavar="FILE", help="YAML as for the node")
    as_run.add_argument(
        "--param",
        type=pairs,
        action="append",
        default=[],
        metavar="NAME=VALUE,...",
        help="such as settle_time=2.0,adapt=false,supervision.gate=6",
    )


def pairs(text: str) -> dict[str, str]:
    """Return the pairs in an option's text, such as `time=t,angle=q`."""
    items = [item.partition("=") for item in text.split(",")]
    for name, sign, value in items:
        if not (name.strip() and sign and value.strip()):
            raise argparse.ArgumentTypeError(f"expected NAME=VALUE,…, got {text!r}")
    return {name.strip(): value.strip() for name, _, value in items}


def source_of(options: argparse.Namespace) -> "Source":
    """Open the bag or the log that the options name."""
    _read_params_file(options)
    assume_zero_torque = _settings(options).assume_zero_torque
    if options.bag.is_file() and options.bag.suffix.lower() in (".csv", ".tsv", ".txt"):
        from tsobs_ros.replay.csv_log import CsvSource

        return CsvSource(
            options.bag,
            columns=options.columns,
            units=options.units,
            joints=options.joints,
            assume_zero_torque=assume_zero_torque,
        )
    from tsobs_ros.replay.source import BagSource

    return BagSource(
        options.bag,
        topic=options.topic,
        joints=options.joints,
        assume_zero_torque=assume_zero_torque,
    )


def observers_of(options: argparse.Namespace, joints: Sequence[str]) -> "list[Observer]":
    """Return the observers that the options name, one for each design and method."""
    from tsobs_ros.replay.estimate import Observer

    settings, designs = _settings(options), _designs(options.design, joints)
    methods = options.method or options.default_methods or (settings.method,)
    observers = []
    for stem, own in designs.items():
        for method in methods:
            parts = [stem] * (len(designs) > 1) + [method] * (len(methods) > 1)
            name = "_".join(parts) or "observer"
            observers.append(Observer(name, replace(settings, method=method), own))
    return observers


def _read_params_file(options: argparse.Namespace) -> None:
    """Let a parameter file say what the options leave open: parameters, joints and designs."""
    options.from_file = {}
    if options.params_file is None:
        return
    from tsobs_ros.replay.parameters import NAMES, read_parameters

    found = read_parameters(options.params_file)
    # Whatever else there is does not decide what is estimated, but when and where it is published.
    options.from_file = {name: value for name, value in found.items() if name in NAMES}
    options.joints = options.joints or list(found.get("joints") or [])
    own = zip(options.joints, found.get("joint_designs") or [], strict=False)
    shared = found.get("design")
    options.design = options.design or [
        *([shared] if shared else []),
        *(f"{joint}={path}" for joint, path in own if path),
    ]


def _settings(options: argparse.Namespace) -> "ObserverSettings":
    """Return the settings that the parameters give, those of the command line above the file's."""
    from tsobs_ros.methods import ObserverSettings
    from tsobs_ros.replay.parameters import with_parameters

    given = {name: value for one in options.param for name, value in one.items()}
    return with_parameters(ObserverSettings(), {**options.from_file, **given})


def _designs(arguments: Sequence[str], joints: Sequence[str]) -> "dict[str, tuple[Design, ...]]":
    """Return the designs to compare by the names of their files, each with one design a joint."""
    from tsobs_ros.design.file import load_design

    own = dict(argument.split("=", 1) for argument in arguments if "=" in argument)
    shared = [Path(argument) for argument in arguments if "=" not in argument]
    if unknown := sorted(set(own) - set(joints)):
        raise DesignFileError(
            f"--design {unknown[0]}={own[unknown[0]]}: no such joint; joints: {', '.join(joints)}"
        )
    if own:
        if len(shared) > 1:
            raise DesignFileError(
                "--design: expected one file at most for the joints without their own, got "
                + ", ".join(map(str, shared))
            )
        rest = shared[0] if shared else config_path(SHIPPED_DESIGN)
        return {"own": tuple(load_design(Path(own.get(joint, rest))) for joint in joints)}
    found: dict[str, tuple[Design, ...]] = {}
    for path in shared or [config_path(SHIPPED_DESIGN)]:
        stem = path.name.split(".")[0].replace("-", "_").replace(" ", "_")
        name = stem if stem not in found else f"{stem}_{len(found) + 1}"
        found[name] = (load_design(path),) * len(joints)
    return found
