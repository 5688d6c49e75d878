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
from tsobs_ros.bag.estimate_topics import CONDITIONS
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.records import Basis, Hypothesis, Innovation, Measurement
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.replay.health import BASIS, CLAIMED, HYPOTHESIS
from tsobs_ros.report.run import RecordedRun
from tsobs_ros.series import Series
from tsobs_ros.simulation.plant import Scenario
from tsobs_ros.simulation.scenarios import simulate
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


def blank_run(measurements: Series, stamps: Any, **truth: Any) -> RecordedRun:
    """Return a run whose estimates are still to be made."""
    m = len(stamps)
    return RecordedRun(
        name="run",
        joint="elastic_joint",
        measurements=measurements,
        stamps=stamps,
        state=np.full((m, 4), np.nan),
        state_bound=np.full((m, 4), np.nan),
        disturbance=np.full((m, 1), np.nan),
        disturbance_bound=np.full((m, 1), np.nan),
        **truth,
    )


def observed(run: RecordedRun, tracker: Tracker) -> RecordedRun:
    """Return the run with estimates at its stamps, each from the measurements up to it."""
    stamps, values = run.measurements
    innovations, rows, place = [], [], 0
    for stamp in run.stamps.tolist():
        while place < len(stamps) and stamps[place] <= stamp:
            sample = Measurement(int(stamps[place]), values[place, :1], values[place, 1:])
            outcome = tracker.offer(sample, stamp)
            if isinstance(outcome, Innovation):
                innovations.append((outcome.stamp, outcome.value[0]))
            place += 1
        one = tracker.estimate(stamp)
        assert one is not None
        parts = (one.state, one.state_bound, one.disturbance, one.disturbance_bound)
        rows.append(np.concatenate(parts))
    table, used = np.array(rows), np.array([stamp for stamp, _ in innovations])
    return replace(
        run,
        state=table[:, :4],
        state_bound=table[:, 4:8],
        disturbance=table[:, 8:9],
        disturbance_bound=table[:, 9:10],
        innovation=Series(used, np.array([[value] for _, value in innovations])),
    )


@pytest.fixture(scope="session")
def unobserved() -> RecordedRun:
    """Twenty seconds of the arm with a bias step at 8 s, and stamps that ask for estimates."""
    scenario = Scenario(duration=20.0, disturbance=(BiasStep(0.1, 8.0),))
    runs = simulate(scenario, [1])
    stamps = START + np.round(runs.times * 1e9).astype(np.int64)
    return blank_run(
        Series(stamps, np.column_stack([runs.measurements[0, :, 0], runs.torques[0, :, 0]])),
        stamps[:-1] + TICK_LAG,
        true_state=Series(stamps, scenario.arm.to_physical(runs.states[0])),
        true_disturbance=Series(stamps, runs.disturbances[0]),
    )


@pytest.fixture(scope="session")
def simulated(unobserved: RecordedRun, design: Design) -> RecordedRun:
    """The same with the certified observer's estimates."""
    return observed(unobserved, Tracker(design.observer(), x_max=design.request.x_max))


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

    def motion(stamps: Any, values: Any) -> list[Row]:
        return [Row(s, arm, v[0::2], v[1::2]) for s, v in zip(stamps.tolist(), values, strict=True)]

    def scalar(stamps: Any, values: Any) -> list[Row]:
        return [Row(s, own, [v]) for s, v in zip(stamps.tolist(), values, strict=True)]

    measured = [
        Row(s, own, [y], effort=[u])
        for s, (y, u) in zip(run.measurements.stamps.tolist(), run.measurements.values, strict=True)
    ]
    topics = {
        "joint_measurements": measured,
        "observer/joint_states": motion(run.stamps, run.state),
        "observer/error_bound": motion(run.stamps, run.state_bound),
        "observer/disturbance": scalar(run.stamps, run.disturbance[:, 0]),
        "observer/disturbance_bound": scalar(run.stamps, run.disturbance_bound[:, 0]),
    }
    if run.innovation is not None:
        stamps, values = run.innovation
        topics["observer/innovation"] = scalar(stamps, values[:, 0])
    if run.true_state is not None:
        topics["ground_truth/joint_states"] = motion(*run.true_state[:2])
    if run.true_disturbance is not None:
        stamps, values = run.true_disturbance
        topics["ground_truth/disturbance"] = scalar(stamps, values[:, 0])
    if run.health is not None:
        topics["observer/health"] = [
            Row(s, CONDITIONS, v)
            for s, v in zip(run.health.stamps.tolist(), run.health.values, strict=True)
        ]
    return {f"{namespace}/{name}": rows for name, rows in topics.items()}


@pytest.fixture
def short(simulated: RecordedRun) -> RecordedRun:
    """The first second of the simulated run, for bags that are quick to write."""
    series = ("measurements", "innovation", "true_state", "true_disturbance")
    cut: dict[str, Any] = {name: getattr(simulated, name).take(slice(200)) for name in series}
    names = ("stamps", "state", "state_bound", "disturbance", "disturbance_bound")
    return replace(simulated, **cut, **{name: getattr(simulated, name)[:200] for name in names})


@pytest.fixture
def troubled(simulated: RecordedRun) -> RecordedRun:
    """The simulated run, with noise above the design's from 5 s to 12 s and a void bound at 8 s."""
    stamps = simulated.stamps[::20]
    health = np.tile([1.0, 0.1, Basis.CERTIFIED, 1.0, 0.0, 0.0, 0.002], (len(stamps), 1))
    times = (stamps - stamps[0]) * 1e-9
    health[(times > 5.0) & (times < 12.0), 0] = 1.8
    health[(times > 8.0) & (times < 10.0), BASIS : CLAIMED + 1] = Basis.CONTRADICTED, 0.0
    health[times > 15.0, HYPOTHESIS] = Hypothesis.FORCE
    return replace(simulated, health=Series(stamps, health))


@pytest.fixture
def messages_of() -> Callable[..., dict[str, list[Row]]]:
    """`topics_of` for tests, which cannot import this file."""
    return topics_of


@pytest.fixture
def new_run() -> Callable[..., RecordedRun]:
    """`blank_run` for tests."""
    return blank_run


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
