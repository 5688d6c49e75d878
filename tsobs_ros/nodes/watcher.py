# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node of `tsobs watch`: what an observer publishes, summed up a few times a second."""

import math
import os
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rclpy.node import Node

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import NodeError
from tsobs_ros.estimation.health import Status
from tsobs_ros.nodes.feed import ObserverFeed
from tsobs_ros.nodes.ticker import Ticker

_DEPTH = 5000


class Quantity(NamedTuple):
    """An estimated number.

    Attributes:
        value: The estimate.
        bound: 1σ of it; NaN if there is none.
        truth: The true value; NaN if it is not known.
    """

    value: float
    bound: float = math.nan
    truth: float = math.nan


class Snapshot(NamedTuple):
    """What is known of an observer at an instant.

    Attributes:
        observer: Its full name.
        age: Time since its last estimate [s]; NaN if there was none.
        in_radians: Whether all joints are known to be arms.
        positions: Of each entry of the estimates.
        velocities: The same; of a T–S system there are none.
        disturbances: Of each output.
        disturbance_rates: Of each output, if its disturbance has one.
        innovations: Of each output in use.
        torques: Torque disturbances [N m].
        parameters: Learnt changes.
        health: Numbers of the topic `health` by their names.
        statuses: Its diagnostics by name.
        rates: Messages a second of each topic that had any.
        problem: What keeps the view from being complete.
    """

    observer: str
    age: float
    in_radians: bool
    positions: dict[str, Quantity]
    velocities: dict[str, Quantity]
    disturbances: dict[str, Quantity]
    disturbance_rates: dict[str, Quantity]
    innovations: dict[str, float]
    torques: dict[str, Quantity]
    parameters: dict[str, Quantity]
    health: dict[str, float]
    statuses: Mapping[str, Status]
    rates: dict[str, float]
    problem: str

    @property
    def is_known(self) -> bool:
        """Whether anything has come from the observer."""
        return bool(self.statuses or self.positions)


class Watcher(Node):
    """Shows an observer until it is told to stop.

    Args:
        observer: Full name of the observer, or relative to the root.
        period: Time between two snapshots [s].
        show: Takes a snapshot; returns whether there shall be another.

    Attributes:
        finished: Whether the process may end.
        ticker: Ticks for `runtime.run`.

    Raises:
        NodeError: The observer's name is not one of a node.
    """

    def __init__(
        self, observer: str, period: float, show: Callable[[Snapshot], bool], **node_kwargs: Any
    ) -> None:
        namespace, _, name = observer.rpartition("/")
        if not name:
            raise NodeError(f"'{observer}' is not the name of an observer")
        # There is nothing to set, and requests of an unknown type would end it in rclpy.
        super().__init__(
            f"tsobs_watch_{os.getpid()}",
            namespace=namespace,
            start_parameter_services=False,
            **node_kwargs,
        )
        self.finished = False
        self._show = show
        own = (*topics.TOPICS, *topics.PARAMETER_TOPICS, *topics.TORQUE_TOPICS)
        wanted = [key for key in own if key != topics.RESTARTS]
        self._feed = ObserverFeed(self, name, (*wanted, *topics.TRUTH), depth=_DEPTH)
        self.ticker = Ticker(self, period, self._tick)
        self.ticker.start()

    def snapshot(self) -> Snapshot:
        """Return what is known now."""
        feed = self._feed
        feed.read()
        arms = [isinstance(each, ArmRequest) for each in feed.requests.values()]
        states = topics.STATES, topics.STATE_BOUNDS, topics.TRUE_STATES
        disturbance = topics.DISTURBANCE, topics.DISTURBANCE_BOUND, topics.TRUE_DISTURBANCE
        torque = topics.TORQUE_DISTURBANCE, topics.TORQUE_DISTURBANCE_BOUND, topics.TRUE_TORQUE
        return Snapshot(
            observer=feed.name,
            age=time.monotonic() - feed.arrived.get(topics.STATES, math.nan),
            in_radians=bool(arms) and all(arms),
            positions=self._quantities("position", *states),
            velocities=self._quantities("velocity", *states),
            disturbances=self._quantities("position", *disturbance),
            disturbance_rates=self._quantities("velocity", *disturbance[:2]),
            innovations=feed.values("position", topics.INNOVATION),
            torques=self._quantities("effort", *torque),
            parameters=self._quantities("position", *topics.PARAMETER_TOPICS),
            health=feed.values("position", topics.HEALTH),
            statuses=feed.statuses,
            rates=feed.rates(),
            problem=feed.problem,
        )

    def _tick(self) -> None:
        self.finished = not self._show(self.snapshot())

    def _quantities(
        self, field: str, topic: str, bound: str, truth: str = ""
    ) -> dict[str, Quantity]:
        """Return the numbers of a topic with those of the same names on two others."""
        feed = self._feed
        bounds, truths = feed.values(field, bound), feed.values(field, truth)
        return {
            name: Quantity(value, bounds.get(name, math.nan), truths.get(name, math.nan))
            for name, value in feed.values(field, topic).items()
        }
