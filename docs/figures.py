# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The figures of this site: `make figures`, or `python docs/figures.py NAME …` for some of them.

Diagrams in SVG are drawn by hand and not made here.
"""

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import tsobs_ros as ts

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
BLUE, ORANGE = "#0072b2", "#e69f00"
"""Of the estimate and of the truth, as in reports; two that everybody can tell apart."""


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


def demo(path: Path) -> None:
    """The report of `tsobs demo`, whose nodes run for 20 s."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "bag")
        tsobs("demo", "--output", str(report))
        shutil.copy(report / "report.png", path)


def example(path: Path) -> None:
    """The figure of the example of the same name."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, ROOT / "examples" / f"{path.stem}.py", folder], check=True)
        (made,) = Path(folder).glob("*.png")
        shutil.copy(made, path)


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
    "own_arm": example,
}
"""What makes each figure of docs/images."""


def main() -> None:
    """Make the figures named on the command line, or all of them."""
    for name in sys.argv[1:] or FIGURES:
        FIGURES[name](IMAGES / f"{name}.png")
        print(f"wrote docs/images/{name}.png")


if __name__ == "__main__":
    main()
