# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs demo`: plant, observer and recorder, then a report on their bag."""

import argparse
import os
import sys
from datetime import datetime
from pathlib import Path

from tsobs_ros.cli.options import Words, add_json, positive
from tsobs_ros.cli.report import report_on
from tsobs_ros.resources import SHIPPED_ADAPTIVE_DESIGN, SHIPPED_DESIGN, config_path


def add_parser(words: Words) -> None:
    """Add the word `demo`."""
    demo = words.add_parser("demo", help="simulate, observe, record and report, over ROS")
    demo.add_argument("--output", type=Path, help="folder to make (default: demo/<date and time>)")
    demo.add_argument("--duration", type=positive, default=20.0, metavar="S")
    demo.add_argument("--seed", type=int, default=1)
    demo.add_argument("--bias", type=float, default=0.1, metavar="RAD", help="size of the step")
    demo.add_argument("--bias-at", type=positive, default=8.0, metavar="S")
    demo.add_argument(
        "--stiffness", type=float, default=0.0, metavar="X", help="true stiffness is 1 + X nominal"
    )
    demo.add_argument(
        "--gravity", type=float, default=0.0, metavar="X", help="true gravity is 1 + X nominal"
    )
    demo.add_argument("--design", type=Path, metavar="FILE", help="design of the observer")
    demo.add_argument(
        "--domain-id",
        type=int,
        metavar="N",
        help="ROS domain (default: one of its own, so that nothing else is disturbed)",
    )
    add_json(demo)
    demo.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Run plant, observer and recorder, then report on their bag."""
    from tqdm import tqdm

    from tsobs_ros.cli.demo_run import DemoOptions, run_demo

    output = options.output or Path("demo") / datetime.now().strftime("%Y_%m_%d-%H_%M_%S")
    # Any domain from 1 to 101 keeps clear of the ports that outgoing connections use.
    domain = 1 + os.getpid() % 101 if options.domain_id is None else options.domain_id
    differs = options.stiffness != 0.0 or options.gravity != 0.0
    design_path = options.design or config_path(
        SHIPPED_ADAPTIVE_DESIGN if differs else SHIPPED_DESIGN
    )
    settings = DemoOptions(
        duration=options.duration,
        seed=options.seed,
        bias=options.bias,
        bias_at=options.bias_at,
        stiffness=options.stiffness,
        gravity=options.gravity,
        domain_id=domain,
        design=design_path,
    )
    print(
        f"plant, observer and recorder on ROS_DOMAIN_ID={domain} for {options.duration:g} s",
        file=sys.stderr,
    )
    with tqdm(
        total=options.duration, unit="s", bar_format="{l_bar}{bar}| {n:.1f}/{total:.1f} s"
    ) as bar:

        def show(seconds: float) -> None:
            bar.update(seconds - bar.n)

        bag = run_demo(output, settings, show)
    exit_code = report_on(bag, output, design_path, ekf=True, as_json=options.json)
    if not options.json:
        print(
            f"\nthe bag is {bag}: ros2 bag play, Foxglove and PlotJuggler open it\n"
            f"the figure is {output / 'report.png'}; {output / 'report.html'} can be zoomed into, "
            "in any browser"
        )
    return exit_code
