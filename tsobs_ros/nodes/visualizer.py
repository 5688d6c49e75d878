# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `visualizer` node: arms as markers for RViz and Foxglove; needs no tf.

Each arm swings in its own vertical plane: the estimate of the observer as a translucent ghost with
its bound, and the truth of a simulator as a solid arm. The colour of the ghost shows the level of
the sensor's fault. Without an observer, only the truth is drawn.

topics, sensor_msgs/msg/JointState without another type:
  ~/markers (out)                    visualization_msgs/msg/MarkerArray
  observer/joint_states (in)         estimates
  observer/error_bound (in)          their bounds
  ground_truth/joint_states (in)     the truth
  /diagnostics (in)                  diagnostic_msgs/msg/DiagnosticArray: the sensors' faults
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from rclpy.qos import QoSProfile
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.errors import printable
from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.parameters import ManagedParameters
from tsobs_ros.nodes.runtime import Ticker
from tsobs_ros.nodes.watcher import ObserverFeed
from tsobs_ros.settings import live_setting, setting
from tsobs_ros.style import BLUE, GREEN, GRID, MUTED, ORANGE, RED

_WANTED = (topics.TRUE_STATES, topics.STATES, topics.STATE_BOUNDS)
_LINK, _ = topics.sides("")
_MAX_ANGLE = 1e6  # drawn, of which a point on a circle says something [rad]
_LIFETIME = 1  # time for which markers are drawn, and messages are used [s]

_COLOUR_OF = {Level.OK: BLUE, Level.WARN: ORANGE, Level.ERROR: RED, Level.STALE: MUTED}
_TRUTH = "#9AA5B1"
_GHOST, _SIGMAS = 0.45, 3.0
"""Opacity of the estimate; half width of its bound, in 1σ bounds."""

# An arm swings about −y at its place on the x axis: its angle is 0 hanging down, and positive
# towards +x, so the view from −y is that of a textbook. The motor's disc is behind the link, and an
# arc from the motor's angle to the link's shows how far the spring between them is wound up.
# All lengths are in units of the link's length.
_SPACING, _MOTOR_RADIUS = 2.6, 0.24
_DIALS = ((1.10, 1.18), (0.27, 0.33))  # inner and outer radius, of link and motor


@dataclass(frozen=True)
class VisualizerParameters(ManagedParameters):
    """All parameters of the visualizer node."""

    observer: str = setting("observer", "Name of the observer")
    rate: float = setting(
        20.0, "Rate at which markers are published", unit="Hz", minimum=1.0, maximum=100.0
    )
    frame_id: str = live_setting("world", "Frame of the markers: the fixed frame of the view")
    link_length: float = live_setting(
        1.0, "Length of a drawn link", unit="m", minimum=0.1, maximum=100.0
    )


class Angles(NamedTuple):
    """Angles of an arm's sides, or their 1σ bounds [rad]."""

    link: float
    motor: float


class Arm(NamedTuple):
    """The data on an arm: angles, bounds, level and description of the sensor's fault."""

    name: str
    truth: Angles | None = None
    estimate: Angles | None = None
    bound: Angles | None = None
    level: Level = Level.STALE
    fault: str = "?"


def scene(arms: Sequence[Arm], look: VisualizerParameters, stamp: Any) -> MarkerArray:
    """Return the markers of arms beside each other, stamped with a builtin_interfaces Time.

    Markers of the same kind share a namespace, which views can hide, with a number per arm.
    """
    array = MarkerArray()
    for place, arm in enumerate(arms):
        pen = _Pen(place * _SPACING * look.link_length, look.link_length)
        for marker in _markers(arm, pen):
            marker.header.frame_id, marker.header.stamp = look.frame_id, stamp
            marker.id += 100 * place
            marker.lifetime.sec = _LIFETIME
            array.markers.append(marker)
    return array


class _Pen(NamedTuple):
    """Draws at a place on the x axis [m], in units of the link's length [m]."""

    x: float
    unit: float

    def point(self, angle: float, radius: float, y: float = 0.0) -> Point:
        """Return the point at an angle [rad], a radius and a depth."""
        x, z = radius * math.sin(angle), -radius * math.cos(angle)
        return Point(x=self.x + x * self.unit, y=y * self.unit, z=z * self.unit)

    def draw(
        self,
        what: tuple[str, int, int],
        colour: ColorRGBA,
        size: tuple[float, float, float],
        at: Point | None = None,
        turned: Quaternion | None = None,
        **own: Any,
    ) -> Marker:
        """Return a marker of a namespace, number and type."""
        namespace, number, kind = what
        x, y, z = (each * self.unit for each in size)
        return Marker(
            ns=namespace,
            id=number,
            type=kind,
            action=Marker.ADD,
            pose=Pose(position=at or Point(), orientation=turned or Quaternion(w=1.0)),
            scale=Vector3(x=x, y=y, z=z),
            color=colour,
            **own,
        )


def _markers(arm: Arm, pen: _Pen) -> Iterator[Marker]:
    colour = _COLOUR_OF[arm.level]
    if arm.truth is not None:
        yield from _sides("truth", arm.truth, pen, _colour(_TRUTH), 1.0)
    if arm.estimate is not None:
        yield from _sides("estimate", arm.estimate, pen, _colour(colour, _GHOST), 1.4)
        for number, bound in enumerate(arm.bound or ()):
            what, area = ("bound", number, Marker.TRIANGLE_LIST), (1.0 / pen.unit,) * 3
            half = min(_SIGMAS * abs(bound), math.pi)
            points = _sector(arm.estimate[number], half, _DIALS[number], pen)
            yield pen.draw(what, _colour(colour, 0.7), area, points=points)
    lines = [arm.name, f"sensor fault: {arm.fault}"]
    moving = arm.estimate or arm.truth
    if moving is not None:
        lying = Quaternion(x=math.sqrt(0.5), w=math.sqrt(0.5))
        size = (2.0 * _MOTOR_RADIUS, 2.0 * _MOTOR_RADIUS, 0.04)
        centre = pen.point(0.0, 0.0, 0.16)
        yield pen.draw(("motor", 0, Marker.CYLINDER), _colour(GRID), size, centre, lying)
        arc = np.linspace(moving.motor, moving.link, 25).tolist()
        points = [pen.point(each, 0.8 * _MOTOR_RADIUS, 0.07) for each in arc]
        what = ("spring", 0, Marker.LINE_STRIP)
        yield pen.draw(what, _colour(GREEN), (0.03, 0.0, 0.0), points=points)
        lines.append(f"spring {moving.motor - moving.link:+.2f} rad")
    above, text = pen.point(math.pi, 0.65), "\n".join(lines)
    what = ("label", 0, Marker.TEXT_VIEW_FACING)
    yield pen.draw(what, _colour(colour), (0.0, 0.0, 0.11), above, text=text)


def _sides(
    kind: str, angles: Angles, pen: _Pen, colour: ColorRGBA, width: float
) -> Iterator[Marker]:
    """Draw the link, its tip and the motor's pointer; `width` scales the thin parts."""
    link, motor = (Quaternion(y=-math.sin(each / 2), w=math.cos(each / 2)) for each in angles)
    bar, ball = (0.05 * width, 0.05 * width, 1.0), (0.13 * width**0.5,) * 3
    pointer = (0.035 * width, 0.03 * width, _MOTOR_RADIUS)
    half = pen.point(angles.motor, _MOTOR_RADIUS / 2, 0.12)
    yield pen.draw((kind, 0, Marker.CUBE), colour, bar, pen.point(angles.link, 0.5), link)
    yield pen.draw((kind, 1, Marker.SPHERE), colour, ball, pen.point(angles.link, 1.0))
    yield pen.draw((kind, 2, Marker.CUBE), colour, pointer, half, motor)


def _sector(angle: float, half: float, radii: tuple[float, float], pen: _Pen) -> list[Point]:
    """Return the triangles of a part of a ring."""
    ends = angle + half * np.linspace(-1.0, 1.0, 17)
    rims = [[pen.point(each, radius) for each in ends.tolist()] for radius in radii]
    corners = ((0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1))
    return [rims[rim][k + step] for k in range(len(ends) - 1) for rim, step in corners]


def _colour(text: str, opacity: float = 1.0) -> ColorRGBA:
    r, g, b = (int(text[place : place + 2], 16) / 255.0 for place in (1, 3, 5))
    return ColorRGBA(r=r, g=g, b=b, a=opacity)


class Visualizer(ManagedNode[VisualizerParameters]):
    """Draws an observer's estimates of arms, and the truth of a simulator."""

    def configure(self) -> None:
        """Create the feed, the publisher and the ticker."""
        self._feed = ObserverFeed(self, self.parameters.observer, _WANTED)
        self._markers = self.create_publisher(MarkerArray, "~/markers", QoSProfile(depth=10))
        self.ticker = Ticker(self, 1.0 / self.parameters.rate, self._draw)

    def _draw(self) -> None:
        self._feed.read()
        # Markers disappear when their lifetime is over.
        wanted = self.active and self._markers.get_subscription_count()
        if wanted and (arms := self.arms()):
            self._markers.publish(scene(arms, self.parameters, self.get_clock().now().to_msg()))

    def arms(self) -> list[Arm]:
        """Return the data on each arm of the observer or the simulator, in order."""
        truth, states, bounds = (
            self._feed.values("position", topic, _LIFETIME) for topic in _WANTED
        )
        found = []
        for joint in dict.fromkeys(
            name.removesuffix(_LINK) for name in (*states, *truth) if name.endswith(_LINK)
        ):
            faults = (
                (status.level, printable(status.message))
                for name, status in self._feed.statuses.items()
                if name.removeprefix(f"{joint}: ").startswith("sensor fault")
            )
            worst = max(faults, key=itemgetter(0), default=(Level.STALE, "?"))
            true, estimate, bound = (_angles(each, joint) for each in (truth, states, bounds))
            found.append(Arm(printable(joint), true, estimate, bound, *worst))
        return found


def _angles(positions: dict[str, float], joint: str) -> Angles | None:
    """Return the positions of a joint's sides; None if they are not both known, or absurd."""
    sides = [positions.get(side, math.nan) for side in topics.sides(joint)]
    return Angles(*sides) if all(abs(each) <= _MAX_ANGLE for each in sides) else None


Parameters = VisualizerParameters
create = partial(Visualizer, "visualizer", Parameters)
