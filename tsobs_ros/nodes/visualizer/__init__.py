# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `visualizer` node: arms as markers for RViz and Foxglove; needs no tf.

Each arm swings in its own vertical plane: what a sensor measures, what the observer estimates, as a
translucent ghost with its bound, and the truth of a simulator as a solid arm. The ghost has the
colour of the sensor's fault. Without an observer only the truth is drawn.

topics, sensor_msgs/msg/JointState without another type:
  ~/markers (out)                    visualization_msgs/msg/MarkerArray
  observer/joint_states (in)         estimates
  observer/error_bound (in)          their bounds
  observer/design (in)               std_msgs/msg/String: which sides have which encoders
  joint_measurements (in)            measured angles; the topic that the observer names
  ground_truth/joint_states (in)     the truth
  /diagnostics (in)                  diagnostic_msgs/msg/DiagnosticArray: the sensors' faults
"""

import math
from typing import Any

from rclpy.qos import QoSProfile
from visualization_msgs.msg import MarkerArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.errors import printable
from tsobs_ros.estimation.fault_shapes import FaultKind
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.runtime import Ticker
from tsobs_ros.nodes.visualizer.scene import LIFETIME, Angles, Arm, VisualizerParameters, scene
from tsobs_ros.nodes.watcher import MEASUREMENTS, ObserverFeed

_WANTED = (topics.STATES, topics.STATE_BOUNDS, topics.TRUE_STATES)
_LINK, _ = topics.sides("")
_SIGMAS = 3.0
"""Half width of the drawn bound, in 1σ bounds."""


class Visualizer(ManagedNode[VisualizerParameters]):
    """Draws what an observer publishes of arms, and the truth of a simulator."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("visualizer", VisualizerParameters, **node_kwargs)
        self.start()

    def configure(self) -> None:
        """Make everything."""
        self._feed = ObserverFeed(self, self.parameters.observer, _WANTED)
        self._markers = self.create_publisher(MarkerArray, "~/markers", QoSProfile(depth=10))
        self.ticker = self._ticker = Ticker(self, 1.0 / self.parameters.rate, self._draw)

    def activate(self) -> None:
        """Start to draw."""
        self._ticker.start()

    def deactivate(self) -> None:
        """Stop drawing; what is drawn goes when its lifetime is over."""
        self._ticker.stop()

    def _draw(self) -> None:
        self._feed.read()
        if not self._markers.get_subscription_count():
            return
        if arms := self.arms():
            self._markers.publish(scene(arms, self.parameters, self.get_clock().now().to_msg()))

    def arms(self) -> list[Arm]:
        """Return what is known of each arm that the observer or the simulator has, in order."""
        names = [
            name.removesuffix(_LINK)
            for topic in (topics.STATES, topics.TRUE_STATES)
            for name in self._positions(topic)
            if name.endswith(_LINK)
        ]
        return [self._arm(name) for name in dict.fromkeys(names)]

    def _arm(self, name: str) -> Arm:
        statuses = self._feed.status_of(name, "sensor fault")
        worst = max(statuses, key=lambda status: status.level, default=None)
        half = self._angles(topics.STATE_BOUNDS, name)
        return Arm(
            printable(name),
            self._angles(topics.TRUE_STATES, name),
            self._angles(topics.STATES, name),
            half and Angles(*(_SIGMAS * each for each in half)),
            self._measured(name),
            worst.level if worst else Level.STALE,
            printable(_words(worst)) if worst else "",
        )

    def _measured(self, joint: str) -> Angles | None:
        """Return the angles that are measured, of which the observer's design has the places."""
        positions = self._positions(MEASUREMENTS)
        if not positions or joint not in self._feed.requests:
            return None
        outputs = self._feed.requests[joint].output_names
        angles = {
            name: positions[place.name]
            for name, place in zip(outputs, self._feed.places(joint).outputs, strict=True)
            if place.field == "position" and place.name in positions
        }
        return Angles(angles.get("link_angle", math.nan), angles.get("motor_angle", math.nan))

    def _angles(self, topic: str, joint: str) -> Angles | None:
        """Return the positions of a joint's sides; None if they are not both known."""
        positions = self._positions(topic)
        sides = [positions.get(side, math.nan) for side in topics.sides(joint)]
        return Angles(*sides) if all(map(math.isfinite, sides)) else None

    def _positions(self, topic: str) -> dict[str, float]:
        return self._feed.values("position", topic, LIFETIME)


def _words(fault: Status) -> str:
    """Return a sensor's fault with its size, as the label shows it."""
    if fault.message == FaultKind.NONE.value:
        return "no fault"
    sizes = [
        f" {value} {key.partition(' ')[2].strip('[]')}"
        for key, value in fault.values.items()
        if key.startswith("magnitude")
    ]
    return fault.message + "".join(sizes)


Parameters, create = VisualizerParameters, Visualizer
