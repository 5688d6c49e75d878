# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs compare`: all observers on the same data, simulated or recorded, in one table."""

import argparse
import time
from pathlib import Path

from tsobs_ros.cli.common import (
    Commands,
    add_command,
    at_least_one,
    json_text,
    positive,
    progress,
    show,
)
from tsobs_ros.cli.estimate import METHODS, add_observer_options, estimate, given_parameters
from tsobs_ros.errors import ParameterError, printable

FILE = "compare.json"
"""Name of the file with the result of a comparison on scenarios."""

_OF_RECORDINGS = (
    "joints", "topic", "at", "rate", "columns", "units", "other_design", "held_out", "held_out_std",
)  # fmt: skip
_OF_SCENARIOS = ("scenario", "seeds", "duration", "force")


def add_parser(commands: Commands) -> None:
    """Add the command `compare`."""
    text = "all observers on simulated scenarios, or on a bag or log, in a table"
    compare = add_command(commands, "compare", run, text)
    add_observer_options(compare, METHODS, bag_required=False)
    compare.add_argument(
        "--output", type=Path, metavar="PATH",
        help="of a recording: new bag of all their estimates; of scenarios: folder for "
        + FILE,
    )  # fmt: skip
    add = compare.add_argument_group("for recordings").add_argument
    add(
        "--held-out", metavar="QUANTITY[=PLACE]",
        help="check estimates against a sensor that the observers do not get: link_angle, "
        "link_velocity, motor_angle or motor_velocity; its column in a log, or in a bag its "
        "/TOPIC, /TOPIC:ENTRY or :ENTRY (default: found by its name)",
    )  # fmt: skip
    add(
        "--held-out-std", type=positive, metavar="STD",
        help="1 sigma of that sensor's noise in rad or rad/s (default: estimated)",
    )  # fmt: skip
    add = compare.add_argument_group("for scenarios", "without a recording").add_argument
    add(
        "--scenario", action="append", default=[], metavar="NAME",
        help="a scenario of the simulator, can be repeated (default: eight of them)",
    )  # fmt: skip
    add("--seeds", type=at_least_one, metavar="N", help="runs of each scenario (default: 20)")
    add("--duration", type=positive, metavar="S", help="length of a run (default: 60 s)")
    add("--force", action="store_true", help="replace existing files")


def run(options: argparse.Namespace) -> int:
    """Run observers over scenarios or a recording, and compare them."""
    given, what = (
        (_OF_SCENARIOS, "scenarios, not for a recording")
        if options.bag
        else (_OF_RECORDINGS, "a recording")
    )
    for name in given:
        if getattr(options, name):
            raise ParameterError(f"--{name.replace('_', '-')}: is for {what}")
    if options.bag:
        if options.held_out_std is not None and options.held_out is None:
            raise ParameterError("--held-out-std: is for --held-out")
        return estimate(options, options.output, skip_misfits=True)
    return _on_scenarios(options)


def _on_scenarios(options: argparse.Namespace) -> int:
    from tsobs_ros.campaign.comparison import DEFAULT_SCENARIOS, compare_scenarios, render_scenarios
    from tsobs_ros.design.file import load_design
    from tsobs_ros.files import require_new, write_whole
    from tsobs_ros.methods import ObserverSettings
    from tsobs_ros.settings import changed

    begin = time.monotonic()
    if len(options.design) > 1:
        raise ParameterError(f"--design: expected one file, got {len(options.design)}")
    if options.output:
        require_new([options.output / FILE], force=options.force)
    settings = changed(ObserverSettings(), given_parameters(options))
    design = load_design(*options.design)
    scenarios, methods = options.scenario or DEFAULT_SCENARIOS, options.method or METHODS
    seeds, more = options.seeds or 20, {"settings": settings, "duration": options.duration}
    runs = len(scenarios) * seeds
    with progress(runs * len(methods), " runs", quiet=options.json) as advance:
        found = compare_scenarios(design, scenarios, seeds, methods, **more, advance=advance)
    text = render_scenarios(found)
    if options.output:
        write_whole(options.output / FILE, json_text(found) + "\n", force=options.force)
        text += f"\n\nwrote {printable(str(options.output / FILE))}"
    seconds = time.monotonic() - begin
    show(found, f"{text}\n{runs} runs in {seconds:.0f} s", options.json)
    return 0
