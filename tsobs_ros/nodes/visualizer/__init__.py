# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `visualizer` node: arms as markers for RViz and Foxglove; needs no tf.

Each arm swings in its own vertical plane: what the observer estimates, as a translucent ghost with
its bound, and the truth of a simulator as a solid arm. The ghost has the colour of the sensor's
fault. Without an observer only the truth is drawn.

topics, sensor_msgs/msg/JointState without another type:
  ~/markers (out)                    visualization_msgs/msg/MarkerArray
  observer/joint_states (in)         estimates
  observer/error_bound (in)          their bounds
  ground_truth/joint_states (in)     the truth
  /diagnostics (in)                  diagnostic_msgs/msg/DiagnosticArray: the sensors' faults
"""

import math
from functools import partial

from rclpy.qos import QoSProfile
from visualization_msgs.msg import MarkerArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.errors import printable
from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.runtime import Ticker
from tsobs_ros.nodes.visualizer.scene import LIFETIME, Angles, Arm, VisualizerParameters, scene
from tsobs_ros.nodes.watcher import ObserverFeed

_WANTED = (topics.TRUE_STATES, topics.STATES, topics.STATE_BOUNDS)
_LINK, _ = topics.sides("")


class Visualizer(ManagedNode[VisualizerParameters]):
    """Draws what an observer publishes of arms, and the truth of a simulator."""

    def configure(self) -> None:
        """Make everything."""
        self._feed = ObserverFeed(self, self.parameters.observer, _WANTED)
        self._markers = self.create_publisher(MarkerArray, "~/markers", QoSProfile(depth=10))
        self.ticker = Ticker(self, 1.0 / self.parameters.rate, self._draw)

    def _draw(self) -> None:
        self._feed.read()
        # What is drawn goes when its lifetime is over.
        wanted = self.active and self._markers.get_subscription_count()
        if wanted and (arms := self.arms()):
            self._markers.publish(scene(arms, self.parameters, self.get_clock().now().to_msg()))

    def arms(self) -> list[Arm]:
        """Return what is known of each arm that the observer or the simulator has, in order."""
        truth, states, bounds = (
            self._feed.values("position", topic, LIFETIME) for topic in _WANTED
        )
        found = []
        for joint in dict.fromkeys(
            name.removesuffix(_LINK) for name in (*states, *truth) if name.endswith(_LINK)
        ):
            statuses = (
                status
                for name, status in self._feed.statuses.items()
                if name.removeprefix(f"{joint}: ").startswith("sensor fault")
            )
            worst = max(statuses, key=lambda each: each.level, default=None)
            level, fault = (worst.level, worst.message) if worst else (Level.STALE, "?")
            true, estimate, bound = (_angles(each, joint) for each in (truth, states, bounds))
            found.append(Arm(printable(joint), true, estimate, bound, level, printable(fault)))
        return found


def _angles(positions: dict[str, float], joint: str) -> Angles | None:
    """Return the positions of a joint's sides; None if they are not both known."""
    sides = [positions.get(side, math.nan) for side in topics.sides(joint)]
    return Angles(*sides) if all(map(math.isfinite, sides)) else None


Parameters = VisualizerParameters
create = partial(Visualizer, "visualizer", Parameters)
