# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Runs to report on: a simulated one, and bags written without ROS."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.records import Basis, Hypothesis
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.replay.health import BASIS, CLAIMED, HYPOTHESIS
from tsobs_ros.replay.places import CONDITIONS
from tsobs_ros.report.run import RecordedRun
from tsobs_ros.series import Series
from tsobs_ros.simulation.scenarios import arm_with, simulate
from tsobs_ros.simulation.signals import BiasStep

START = 1_700_000_000_000_000_000
TICK_LAG = 1_300_000


class Row(NamedTuple):
    """One JointState: stamp [ns], names, and what it says of them."""

    stamp: int
    names: Sequence[str]
    position: Sequence[float] = ()
    velocity: Sequence[float] = ()
    effort: Sequence[float] = ()


@pytest.fixture(scope="session")
def simulated(design: Design) -> RecordedRun:
    """Twenty seconds of the arm with a bias step at 8 s, estimated between its samples."""
    scenario = arm_with(BiasStep(0.1, 8.0), duration=20.0)
    (times, states, biases, y, u, *_) = simulate(scenario, [1])
    stamps = START + np.round(times * 1e9).astype(np.int64)
    ticks, known = stamps[:-1] + TICK_LAG, 1 + np.arange(len(stamps) - 1)
    tracker = Tracker(design.observer(), x_max=design.request.x_max)
    found = tracker.run(stamps, y[0], u[0], (ticks, ticks, known))
    names = ("state", "state_bound", "disturbance", "disturbance_bound")
    return RecordedRun(
        name="run",
        joint="elastic_joint",
        parts={
            "measurements": Series(stamps, np.hstack([y[0], u[0]])),
            **{name: Series(ticks, np.array(found.rows[name])) for name in names},
            "innovation": Series(stamps[:-1], found.outcomes.innovations[:-1]),
            "true_state": Series(stamps, scenario.arm.to_physical(states[0])),
            "true_disturbance": Series(stamps, biases[0]),
        },
    )


@pytest.fixture
def write_bag(tmp_path: Path) -> Callable[..., Path]:
    """Write topics of JointStates to `tmp_path/bag`, logged in the order of `log_times`."""

    def write(
        topics: dict[str, Iterable[Row]], log_times: dict[str, Sequence[int]] | None = None
    ) -> Path:
        path = tmp_path / "bag"
        with BagWriter(path) as writer:
            for topic, rows in topics.items():
                writer.add_topic(
                    topic, JOINT_STATE, definition=MessageDefinition(JOINT_STATE, "", "")
                )
                for place, (stamp, names, *numbers) in enumerate(rows):
                    log = log_times[topic][place] if log_times else stamp + 100_000
                    data = JointStateEncoder(list(names))(stamp, *map(list, numbers))
                    writer.write(topic, data, log, log)
        return path

    return write


def topics_of(run: RecordedRun, namespace: str = "") -> dict[str, list[Row]]:
    """Return the messages that the nodes publish in a run."""
    own, arm = [run.joint], [f"{run.joint}_link", f"{run.joint}_motor"]

    def rows(series: Any, row: Callable[..., Row]) -> list[Row]:
        return [row(*each) for each in zip(series[0].tolist(), series[1], strict=True)]

    def motion(stamp: int, x: Any) -> Row:
        return Row(stamp, arm, x[0::2], x[1::2])

    def scalar(stamp: int, x: Any) -> Row:
        return Row(stamp, own, x)

    kinds = {
        "joint_measurements": ("measurements", lambda stamp, x: Row(stamp, own, x[:1], (), x[1:])),
        "observer/joint_states": ("state", motion),
        "observer/error_bound": ("state_bound", motion),
        "observer/disturbance": ("disturbance", scalar),
        "observer/disturbance_bound": ("disturbance_bound", scalar),
        "observer/innovation": ("innovation", scalar),
        "ground_truth/joint_states": ("true_state", motion),
        "ground_truth/disturbance": ("true_disturbance", scalar),
        "observer/health": ("health", lambda stamp, x: Row(stamp, CONDITIONS, x)),
    }
    topics = {
        name: rows(run.parts[part], row) for name, (part, row) in kinds.items() if part in run.parts
    }
    return {f"{namespace}/{name}": each for name, each in topics.items()}


@pytest.fixture
def short(simulated: RecordedRun) -> RecordedRun:
    """The first second of the simulated run, for bags that are quick to write."""
    parts = {name: part.take(slice(200)) for name, part in simulated.parts.items()}
    return replace(simulated, parts=parts)


@pytest.fixture
def troubled(simulated: RecordedRun) -> RecordedRun:
    """The simulated run, with noise above the design's from 5 s to 12 s and a void bound at 8 s."""
    stamps = simulated.stamps[::20]
    health = np.tile([1.0, 0.1, Basis.CERTIFIED, 1.0, 0.0, 0.0, 0.002], (len(stamps), 1))
    times = (stamps - stamps[0]) * 1e-9
    health[(times > 5.0) & (times < 12.0), 0] = 1.8
    health[(times > 8.0) & (times < 10.0), BASIS : CLAIMED + 1] = Basis.CONTRADICTED, 0.0
    health[times > 15.0, HYPOTHESIS] = Hypothesis.FORCE
    return replace(simulated, parts={**simulated.parts, "health": Series(stamps, health)})


@pytest.fixture
def messages_of() -> Callable[..., dict[str, list[Row]]]:
    """`topics_of` for tests, which cannot import this file."""
    return topics_of


@pytest.fixture
def wait_for() -> Callable[[Any, str], None]:
    """Wait until a condition holds in a page, which allows no `eval` for Playwright's own."""

    def wait(tab: Any, condition: str) -> None:
        for _ in range(600):
            if tab.evaluate(condition):
                return
            tab.wait_for_timeout(50)
        raise AssertionError(f"never true: {condition}")

    return wait
