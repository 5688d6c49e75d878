# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags of measurements to estimate from, written without ROS."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsobs_ros.bag import BagWriter
from tsobs_ros.bag.cdr import TICK_LOG
from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.design.record import Design
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.replay.designs import STRING
from tsobs_ros.replay.estimate import Observer, Run, run_observers
from tsobs_ros.replay.source import BagSource
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

START = 1_700_000_000_000_000_000
PERIOD = 5_000_000
LATENCY = 300_000
JOINTS = ("elbow", "wrist")

TYPES = {"design": STRING, "ticks": TICK_LOG}

Message = tuple[str, bytes, int]
"""Topic, data and log time, which is the publish time too."""


@dataclass(frozen=True)
class Arms:
    """A simulated second and a half of two joints: angles and torques, shape (n, 2)."""

    y: np.ndarray
    u: np.ndarray

    def messages(self, count: int = 300, joints: int = 1, begin: int = 0) -> list[Message]:
        """Return the measurements of some joints in one message a sample."""
        encode = JointStateEncoder(JOINTS[:joints])
        stamps = [START + k * PERIOD for k in range(begin, begin + count)]
        return [
            (
                "/joint_measurements",
                encode(stamp, self.y[k, :joints].tolist(), (), self.u[k, :joints].tolist()),
                stamp + LATENCY,
            )
            for k, stamp in enumerate(stamps, begin)
        ]


@pytest.fixture(scope="session")
def arms() -> Arms:
    """Two joints, which move differently."""
    runs = simulate(SCENARIOS["bias_step"], [1, 2], 3.0)
    return Arms(runs.measurements[..., 0].T, runs.torques[..., 0].T)


@pytest.fixture
def write_bag(tmp_path: Path) -> Callable[..., Path]:
    """Write JointStates to `tmp_path/name`."""
    definition = MessageDefinition(JOINT_STATE, "float64[] position\n", "")

    def write(messages: Iterable[Message], name: str = "bag", **options: Any) -> Path:
        path = tmp_path / name
        with BagWriter(path, **options) as writer:
            for topic, data, time in messages:
                type_ = TYPES.get(topic.rpartition("/")[2], JOINT_STATE)
                writer.add_topic(topic, type_, definition=definition._replace(type=type_))
                writer.write(topic, data, time, time)
        return path

    return write


@pytest.fixture
def estimate(design: Design, tmp_path: Path) -> Callable[..., Run]:
    """Estimate over a bag as `tsobs estimate` does, into `tmp_path/output`."""

    def run(
        source: Path | BagSource,
        output: str | None = None,
        settings: ObserverSettings | None = None,
        **options: Any,
    ) -> Run:
        source = BagSource(source) if isinstance(source, Path) else source
        files = (design,) * len(source.joints)
        observer = Observer("observer", settings or ObserverSettings(), files)
        path = None if output is None else tmp_path / output
        (made,) = run_observers(source, [observer], path, **{"window": 2**31, **options})
        return made

    return run
