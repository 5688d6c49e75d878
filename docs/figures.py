# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The figures of this site: `make figures`, or `python docs/figures.py NAME …` for some of them.

Diagrams in SVG are drawn by hand and not made here.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import tsobs_ros as ts

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
BLUE, ORANGE = "#0072b2", "#e69f00"
"""Of the estimate and of the truth, as in reports; distinguishable by the colour-blind."""


def bands(axis: Any, time: Any, estimate: Any, bound: Any, truth: Any) -> None:
    """Draw an estimate with its 1σ and 3σ bounds, and the truth."""
    axis.fill_between(
        time, estimate - 3 * bound, estimate + 3 * bound, color=BLUE, alpha=0.15, lw=0
    )
    axis.fill_between(time, estimate - bound, estimate + bound, color=BLUE, alpha=0.25, lw=0)
    axis.plot(time, truth, color=ORANGE, lw=2.5, label="true")
    axis.plot(time, estimate, color=BLUE, lw=1, label="estimated, with 1σ and 3σ bounds")
    axis.grid(alpha=0.3)


def bias_step(path: Path) -> None:
    """The jump of a sensor's bias: what is given to the sensor, and what is left on the arm."""
    design = ts.load_design()
    bias = {"bias_step": {"amplitude": 0.1, "start": 8}}
    run = ts.simulate(design, duration=20.0, disturbance=bias, seed=1)
    found = ts.estimate(design, run.time, run.angle, run.torque)
    figure, (top, bottom) = plt.subplots(2, sharex=True, layout="constrained", figsize=(8, 5))
    bands(top, run.time, found.disturbance, found.disturbance_bound, run.disturbance)
    top.set(ylabel="sensor's bias [rad]", ylim=(-0.1, 0.2))
    top.legend(loc="upper left")
    error = found.state[:, 0] - run.state[:, 0]
    bands(bottom, run.time, error, found.state_bound[:, 0], np.zeros_like(error))
    bottom.set(xlabel="time [s]", ylabel="error of the link angle [rad]", ylim=(-0.08, 0.08))
    save(figure, path)


_STATES_HEIGHT = 1330
"""Height of the report's panels of states and disturbance [pixels]."""


def demo(path: Path) -> None:
    """The upper part of the report of `tsobs demo`, whose nodes run for 20 s."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "demo")
        tsobs("demo", "--output", str(report))
        with Image.open(report / "report.png") as whole:
            whole.crop((0, 0, whole.width, _STATES_HEIGHT)).save(path)


def example(path: Path) -> None:
    """The figure of the example of the same name."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, ROOT / "examples" / f"{path.stem}.py", folder], check=True)
        (made,) = Path(folder).glob("*.png")
        shutil.copy(made, path)


def rivals(path: Path) -> None:
    """The table of docs/acceptance.md as a figure: our error over the better Kalman filter's."""
    page = (ROOT / "docs" / "acceptance.md").read_text(encoding="utf-8")
    table = page.partition("## Ours and its rivals")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| ([\w.]+) \|[^|]*\| \**(\d+\.\d+)[^|]*\|", table, re.MULTILINE)
    names, ratios = zip(*sorted(rows, key=lambda row: -float(row[1])), strict=True)
    values = np.array(ratios, float)
    figure, axis = plt.subplots(layout="constrained", figsize=(7, 1 + 0.18 * len(names)))
    for better, colour in ((True, BLUE), (False, ORANGE)):
        chosen = np.flatnonzero((values <= 1.0) == better)
        label = "more accurate" if better else "less accurate"
        axis.barh(chosen, values[chosen] - 1.0, left=1.0, color=colour, label=label)
    axis.set(
        xscale="log", yticks=range(len(names)), xlabel="error / error of the better gated EKF",
        ylim=(-0.8, len(names) - 0.2),
    )  # fmt: skip
    axis.set_xticks([0.03, 0.1, 0.3, 1.0, 2.0], labels=["1/30", "1/10", "1/3", "1", "2"])
    axis.set_yticklabels([name.replace("_", " ") for name in names], fontsize=8)
    axis.minorticks_off()
    axis.grid(axis="x", alpha=0.3)
    axis.legend(loc="lower left")
    save(figure, path)


def learning(path: Path) -> None:
    """An arm that is stiffer and heavier than designed: what is learnt, and when it is used."""
    design = ts.load_design()
    changes = {"stiffness": 0.2, "gravity_torque": 0.1}
    run = ts.simulate(design, duration=25.0, mismatch=changes, seed=1)
    found = ts.estimate(design, run.time, run.angle, run.torque)
    figure, axes = plt.subplots(2, sharex=True, layout="constrained", figsize=(8, 5))
    for place, (axis, name) in enumerate(zip(axes, ("stiffness", "gravity"), strict=True)):
        truth = np.full_like(run.time, tuple(changes.values())[place])
        bands(axis, run.time, found.parameters[:, place], found.parameter_bound[:, place], truth)
        axis.set(ylabel=f"change of {name}", ylim=(-0.15, 0.45))
    axes[0].legend(loc="lower right")
    axes[1].set(xlabel="time [s]")
    save(figure, path)


def markers(path: Path) -> None:
    """What the visualizer draws: an arm without a fault, with a warning, with an error."""
    from builtin_interfaces.msg import Time

    from tsobs_ros.estimation.health import Level
    from tsobs_ros.nodes.visualizer import Angles, Arm, VisualizerParameters, scene

    def arm(level: Level, fault: str, link: float, motor: float) -> Arm:
        truth, estimate = Angles(link, motor), Angles(link + 0.01, motor - 0.02)
        return Arm("elastic_joint", truth, estimate, Angles(0.017, 0.023), level, fault)

    arms = [
        arm(Level.OK, "none", 0.35, 0.15),
        arm(Level.WARN, "bias", -0.3, 0.4),
        arm(Level.ERROR, "drift", 0.6, 1.5),
    ]
    figure, axis = plt.subplots(layout="constrained", figsize=(8, 2.6))
    for marker in scene(arms, VisualizerParameters(), Time()).markers:
        draw(axis, marker)
    axis.set_aspect("equal")
    axis.set(xlim=(-1.1, 6.3), ylim=(-1.3, 0.95))
    axis.axis("off")
    save(figure, path)


def draw(axis: Any, marker: Any) -> None:
    """Draw a marker as it is seen from -y."""
    at, turn, size = marker.pose.position, marker.pose.orientation, marker.scale
    colour = (marker.color.r, marker.color.g, marker.color.b)
    look = {"color": colour, "alpha": marker.color.a, "lw": 0}
    points = [(point.x, point.z) for point in marker.points]
    if marker.type == marker.CUBE:
        bar = plt.Rectangle(
            (at.x - size.x / 2, at.z - size.z / 2), size.x, size.z,
            angle=-2.0 * np.degrees(np.arctan2(turn.y, turn.w)), rotation_point="center", **look,
        )  # fmt: skip
        axis.add_patch(bar)
    elif marker.type in (marker.SPHERE, marker.CYLINDER):
        behind = {"zorder": 0.5} if marker.type == marker.CYLINDER else {}
        axis.add_patch(plt.Circle((at.x, at.z), size.x / 2, **look, **behind))
    elif marker.type == marker.TRIANGLE_LIST:
        for corner in range(0, len(points), 3):
            axis.add_patch(plt.Polygon(points[corner : corner + 3], **look))
    elif marker.type == marker.LINE_STRIP:
        axis.plot(*zip(*points, strict=True), color=colour, lw=1.5)
    else:
        axis.text(at.x, at.z, marker.text, color=colour, ha="center", va="center")


def watch(path: Path) -> None:
    """`tsobs watch` on the nodes of `tsobs demo`, once their sensor's bias is known."""
    from playwright.sync_api import sync_playwright
    from rich.console import Console
    from rich.text import Text

    domain = "90"
    environment = {
        **os.environ, "ROS_DOMAIN_ID": domain, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FORCE_COLOR": "1", "COLUMNS": "92", "COLORTERM": "truecolor",
    }  # fmt: skip
    command = [sys.executable, "-m", "tsobs_ros.cli.main"]
    with tempfile.TemporaryDirectory() as folder:
        arguments = ["--output", f"{folder}/demo", "--domain-id", domain, "--duration", "40"]
        bias = ["--bias", "0.3", "--bias-at", "5"]
        running = subprocess.Popen([*command, "demo", *arguments, *bias])
        try:
            shown = ""
            while (
                not re.search(r"TRACKING.*sensor fault +bias", shown, re.DOTALL)
                and running.poll() is None
            ):
                looked = [*command, "watch", "--once", "--timeout", "60"]
                shown = subprocess.run(
                    looked, env=environment, capture_output=True, text=True, check=False
                ).stdout
        finally:
            running.send_signal(signal.SIGINT)
            running.wait()
        console = Console(record=True, width=92, file=StringIO())
        console.print(Text.from_ansi(shown))
        picture = Path(folder, "watch.svg")
        console.save_svg(str(picture), title="tsobs watch")
        with sync_playwright() as playwright:
            chromium = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))))
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            page = browser.new_page()
            page.goto(picture.as_uri())
            page.locator("svg").first.screenshot(path=path)
            browser.close()


def tsobs(*arguments: str) -> None:
    """Run a command of `tsobs`."""
    subprocess.run([sys.executable, "-m", "tsobs_ros.cli.main", *arguments], check=True)


def save(figure: Any, path: Path) -> None:
    """Write a figure, small, and without what differs from day to day."""
    figure.savefig(path, dpi=120, metadata={"Software": None})
    plt.close(figure)


FIGURES: dict[str, Callable[[Path], None]] = {
    "bias_step": bias_step,
    "contact_torque": example,
    "demo": demo,
    "learning": learning,
    "markers": markers,
    "own_arm": example,
    "rivals": rivals,
    "watch": watch,
}
"""What makes each figure of docs/images."""


def main() -> None:
    """Make the figures named on the command line, or all of them."""
    for name in sys.argv[1:] or FIGURES:
        FIGURES[name](IMAGES / f"{name}.png")
        print(f"wrote docs/images/{name}.png")


if __name__ == "__main__":
    main()
