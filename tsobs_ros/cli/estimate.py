# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs estimate`: observers over a recording, and a new bag of their estimates."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tsobs_ros.cli.common import (
    Commands,
    add_command,
    add_log_options,
    joined,
    keywords,
    note,
    pairs,
    positive,
    progress,
    show,
)
from tsobs_ros.errors import BagWriteError, complain, printable

if TYPE_CHECKING:
    from tsobs_ros.replay.estimate import Observer, Run
    from tsobs_ros.replay.source import BagSource
    from tsobs_ros.report.comparison import ObserverErrors

# Repeated here, so that the parser needs no numpy.
_ZERO = "assume_zero_torque"
METHODS = (
    "certified", "certified_fixed", "ekf_plain", "ekf", "ekf_augmented", "high_gain",
    "proportional_integral", "paper",
)  # fmt: skip


def add_parser(commands: Commands) -> None:
    """Add the command `estimate`."""
    text = "run observers over a bag or a log, and write a bag of their estimates"
    command = add_command(commands, "estimate", run, text)
    add_observer_options(command, ())
    add = command.add_argument
    add("--output", type=Path, metavar="NEWBAG", help="folder to make (default: BAG_estimates)")
    add("--estimates-only", action="store_true", help="leave measurements and truth out of it")


def add_observer_options(
    command: argparse.ArgumentParser, methods: Sequence[str], *, bag_required: bool = True
) -> None:
    """Add the options to run observers over a bag or a log; `methods` are the default ones."""
    add = command.add_argument
    add(
        "bag", type=Path, metavar="BAG", nargs=None if bag_required else "?",
        help="bag folder, MCAP file or CSV log",
    )  # fmt: skip
    add(
        "--design", nargs="+", default=[], metavar="FILE",
        help="design files, each run; JOINT=FILE for a joint with its own design (default: what "
        "the bag's observer ran, else the shipped design)",
    )  # fmt: skip
    add(
        "--other-design", action="store_true",
        help="let --design name another design than the bag's observer ran",
    )  # fmt: skip
    add(
        "--method", nargs="+", choices=METHODS, metavar="METHOD",
        help=f"observers to run, of {', '.join(METHODS)} "
        f"(default: {' '.join(methods) or 'certified'})",
    )  # fmt: skip
    command.set_defaults(default_methods=methods)
    add("--joints", nargs="+", default=[], metavar="NAME", help="default: all")
    add("--topic", help="the measurements (default: …/joint_measurements)")
    add(
        "--at", choices=("recorded", "measurements"),
        help="when to estimate (default: when the recorded observer did, if there is one)",
    )  # fmt: skip
    add("--rate", type=positive, metavar="HZ", help="estimate at a fixed rate")
    add_log_options(command)
    add = command.add_argument_group("parameters", "named as those of the node").add_argument
    add("--params-file", type=Path, metavar="FILE", help="YAML as for the node")
    add(
        "--param", type=pairs, action="append", default=[], metavar="NAME=VALUE,...",
        help="such as settle_time=2.0,adapt=false,supervision.gate=6",
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Run observers over a recording."""
    bag = options.bag.absolute()
    stem = bag.stem if bag.is_file() else bag.name
    output = options.output or bag.with_name(f"{stem}_estimates")
    if output.exists():
        raise BagWriteError(f"{output}: exists already, bags are not overwritten")
    return estimate(options, output, estimates_only=options.estimates_only)


def estimate(
    options: argparse.Namespace,
    output: Path | None,
    *,
    estimates_only: bool = False,
    skip_misfits: bool = False,
) -> int:
    """Run the observers that the options name, show the result, and return the exit code.

    With `skip_misfits`, observers that do not fit the arm are left out, with a remark.
    """
    from tsobs_ros.methods import ObserverSettings
    from tsobs_ros.replay.estimate import (
        make_observers,
        open_source,
        run_observers,
        without_misfits,
    )
    from tsobs_ros.report.comparison import measure_runs
    from tsobs_ros.report.held_out import read_held_out
    from tsobs_ros.settings import changed

    begin = time.monotonic()
    parameters = given_parameters(options)
    given = changed(ObserverSettings(), parameters)
    source = open_source(
        options.bag,
        **keywords(options, open_source),
        assume_zero_torque=given.assume_zero_torque if _ZERO in parameters else None,
    )
    settings = changed(source.ran.settings(), parameters)
    designs = source.choose_designs(options.design, others_allowed=options.other_design)
    methods = options.method or options.default_methods or (settings.method,)
    observers = make_observers(designs, methods, settings)
    for one in observers:
        source.observe([design.request for design in one.designs])
    remarks = [*_about(source, observers), *source.remarks, *source.ran.remarks]
    if source.was_observed:
        remarks += source.ran.doubt(options.design)
    if skip_misfits:
        observers, misfits = without_misfits(observers)
        remarks += misfits
    as_live = options.rate is None and options.at != "measurements"
    keep = len(observers) > 1 or source.held_out is not None
    sensors = read_held_out(source, getattr(options, "held_out_std", None))
    with progress(source.count * len(observers), " samples", quiet=options.json) as advance:
        runs = run_observers(
            source,
            observers,
            output,
            rate=options.rate,
            as_live=as_live,
            keep=keep,
            estimates_only=estimates_only,
            progress=advance,
        )
    errors = [one for one, _ in measure_runs(source, runs, sensors)] if keep else []
    remarks += dict.fromkeys(f"warning: {text}" for run in runs for text in run.warnings())
    mapping, text = _result(source, runs, errors, output, time.monotonic() - begin, remarks)
    show(mapping, text, options.json)
    if source.damage is not None:
        complain(f"{source.damage}; estimated up to there")
    if not any(run.estimates for run in runs):
        reasons = {reason.text for run in runs for reason in run.rejected}
        complain(f"no estimate was made; rejected: {', '.join(sorted(reasons)) or 'none'}")
        return 1
    return 0 if source.damage is None else 1


def given_parameters(options: argparse.Namespace) -> dict[str, Any]:
    """Return the given parameters; those of the command line override those of the file."""
    from tsobs_ros.methods import ObserverSettings, read_parameters
    from tsobs_ros.resources import config_path
    from tsobs_ros.settings import about_unknown, settings_of

    found = {} if options.params_file is None else read_parameters(options.params_file)
    known = settings_of(ObserverSettings)
    # The other ones only decide when and where estimates are published.
    of_node = {*read_parameters(config_path("observer.yaml")), "use_sim_time"} if found else found
    for name in found:
        if name not in of_node and not name.startswith("qos_overrides."):
            note(printable(f"warning: {options.params_file}: {about_unknown(name, of_node)}"))
    in_file = {name: value for name, value in found.items() if name in known}
    return {**in_file, **joined(options.param)}


def _about(source: "BagSource", observers: "Sequence[Observer]") -> list[str]:
    """Return a line on each design."""
    from tsobs_ros.design.file import identity

    joints: dict[str, dict[str, None]] = {}
    for observer in observers:
        for joint, design in zip(source.joints, observer.designs, strict=True):
            joints.setdefault(f"design {design.file} ({identity(design)})", {})[joint] = None
    several = len(joints) > 1 and len(source.joints) > 1
    return [f"{text} for {', '.join(own)}" if several else text for text, own in joints.items()]


def _mapping_of(run: "Run", begin: int) -> dict[str, Any]:
    from tsobs_ros.replay.health import map_events

    return {
        "name": run.observer.name,
        "method": run.observer.settings.method,
        "estimates": run.estimates,
        "used": run.used,
        "rejected": {reason.text: number for reason, number in run.rejected.items()},
        "outputs": run.outputs(),
        "rewinds": run.rewinds,
        "failures": sum(tracker.failures for tracker in run.trackers),
        "health": {joint: one.as_mapping() for joint, one in run.health().items()},
        **map_events(run.events, begin),
    }


def _lines_of(run: "Run", width: int) -> list[str]:
    """Return a run's counts and health as lines; its name takes `width` columns."""
    rejected = ", ".join(f"{number:,} {reason.text}" for reason, number in run.rejected.items())
    lines = [
        f"{run.observer.name:<{width}}  {run.estimates:,} estimates from {run.used:,} "
        f"measurements; rejected: {rejected or 'none'}"
    ]
    about = [
        (joint, f"{name}: {number:,} {what}")
        for joint, outputs in run.outputs().items()
        for name, counts in outputs.items()
        for what, number in counts.items()
        if number
    ]
    if run.observer.settings.method.startswith("certified"):
        about += [(joint, line) for joint, one in run.health().items() for line in one.lines()]
    several = len(run.observer.designs) > 1
    lines += [f"{'':<{width}}  {f'{joint}: ' if several else ''}{line}" for joint, line in about]
    return lines


def _result(
    source: "BagSource",
    runs: "list[Run]",
    errors: "list[ObserverErrors]",
    output: Path | None,
    seconds: float,
    remarks: Sequence[str],
) -> tuple[dict[str, Any], str]:
    """Return the result for programs and for people."""
    from tsobs_ros.replay.health import list_events
    from tsobs_ros.report.comparison import render_comparison

    begin, end = source.span
    duration = float(end - begin) * 1e-9
    # At most one of several observers was the live one.
    agreements = filter(None, (run.agreement() for run in runs))
    agreement = max(agreements, key=lambda one: one.reproduced, default=None)
    width = max(len(run.observer.name) for run in runs)
    lines = [
        f"{source.path}: {source.count:,} measurements of {', '.join(source.joints)} "
        f"over {duration:.1f} s, in {seconds:.1f} s",
        *(line for run in runs for line in _lines_of(run, width)),
        *remarks,
        *([] if agreement is None else [agreement.text()]),
        *(list_events(runs[0].events, begin) if len(runs) == 1 else []),
        *(["", *render_comparison(errors).split("\n")] if errors else []),
        *([] if output is None else [f"wrote {output}"]),
    ]
    mapping = {
        "source": str(source.path),
        "output": None if output is None else str(output),
        "joints": list(source.joints),
        "measurements": source.count,
        "duration": duration,
        "seconds": seconds,
        "observers": [_mapping_of(run, begin) for run in runs],
        "live": None if agreement is None else asdict(agreement),
        "errors": [one.as_mapping() for one in errors],
        "remarks": list(remarks),
        "damage": None if source.damage is None else str(source.damage),
    }
    return mapping, "\n".join(map(printable, lines))
