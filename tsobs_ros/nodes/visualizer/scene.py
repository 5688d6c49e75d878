# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Arms as markers.

An arm swings about −y at its place on the x axis: its angle is 0 hanging down, and positive towards
+x, so that it is seen as in a textbook from −y. The motor's disc is behind the link, the spring
between them.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from tsobs_ros.estimation.health import Level
from tsobs_ros.style import BLUE, GREEN, GRID, MUTED, ORANGE, PURPLE, RED

_COLOUR_OF = {Level.OK: BLUE, Level.WARN: ORANGE, Level.ERROR: RED, Level.STALE: MUTED}
_TRUTH, _MEASURED, _SPRING, _STRAINED = "#9AA5B1", PURPLE, GREEN, RED

# All lengths are shares of the link's.
_MOTOR_RADIUS, _SHAFT_RADIUS = 0.24, 0.05
_LINK_DIAL, _MOTOR_DIAL = (1.10, 1.18), (0.27, 0.33)
_TURNS = 3.0
_STRAIN = 1.0
"""Wind-up at which the spring has its last colour [rad]."""


class Angles(NamedTuple):
    """Angles of an arm's sides, or half widths of their bounds [rad]; NaN if they are not known."""

    link: float
    motor: float


class Arm(NamedTuple):
    """What is known of an arm.

    Attributes:
        name: Of the joint.
        truth: The true angles.
        estimate: The estimated ones.
        bound: Half widths of what is drawn about the estimate.
        measured: The measured angles.
        level: Of the sensor's fault.
        fault: The fault in words.
    """

    name: str
    truth: Angles | None = None
    estimate: Angles | None = None
    bound: Angles | None = None
    measured: Angles | None = None
    level: Level = Level.STALE
    fault: str = ""


class Look(NamedTuple):
    """How arms are drawn; see the parameters of the node."""

    frame_id: str
    link_length: float
    spacing: float
    opacity: float
    lifetime: float


def scene(arms: Sequence[Arm], look: Look, stamp: Any) -> MarkerArray:
    """Return the markers of arms beside each other.

    Markers of the same kind have a namespace, which views can hide, and a number an arm.

    Args:
        arms: From left to right.
        look: How they are drawn.
        stamp: Of the markers, a builtin_interfaces Time.
    """
    array = MarkerArray()
    for place, arm in enumerate(arms):
        for marker in _Arm(place * look.spacing, look).markers(arm):
            marker.header.frame_id, marker.header.stamp = look.frame_id, stamp
            marker.id += 100 * place
            marker.lifetime.sec = int(look.lifetime)
            marker.lifetime.nanosec = int(look.lifetime % 1.0 * 1e9)
            array.markers.append(marker)
    return array


class _Arm:
    """Draws an arm at a place on the x axis [m]."""

    def __init__(self, x: float, look: Look) -> None:
        self._x, self._look, self._unit = x, look, look.link_length

    def markers(self, arm: Arm) -> Iterator[Marker]:
        colour = _COLOUR_OF[arm.level]
        if arm.truth is not None:
            yield from self._sides("truth", arm.truth, _colour(_TRUTH), 1.0)
        if arm.estimate is not None:
            ghost = _colour(colour, self._look.opacity)
            yield from self._sides("estimate", arm.estimate, ghost, 1.4)
            if arm.bound is not None:
                yield from self._bounds(arm.estimate, arm.bound, _colour(colour, 0.7))
        if arm.measured is not None:
            for number, (angle, dial) in enumerate(
                zip(arm.measured, (_LINK_DIAL, _MOTOR_DIAL), strict=True)
            ):
                if math.isfinite(angle):
                    at = self._point(angle, sum(dial) / 2, -0.02)
                    size = (0.06 * self._unit,) * 3
                    yield _marker(
                        "measurement", number, Marker.SPHERE, _colour(_MEASURED), size, at
                    )
        moving = arm.estimate or arm.truth
        if moving is not None:
            yield self._motor()
            yield self._spring(moving)
        yield self._label(arm, colour)

    def _sides(
        self, kind: str, angles: Angles, colour: ColorRGBA, width: float
    ) -> Iterator[Marker]:
        """Draw link, its tip and the motor's pointer; `width` is that of what is thin."""
        unit = self._unit
        link, motor = (_turned(angle) for angle in angles)
        bar = (0.05 * width * unit, 0.05 * width * unit, unit)
        middle, tip = self._point(angles.link, 0.5), self._point(angles.link, 1.0)
        yield _marker(kind, 0, Marker.CUBE, colour, bar, middle, link)
        ball = (0.13 * width**0.5 * unit,) * 3
        yield _marker(kind, 1, Marker.SPHERE, colour, ball, tip)
        pointer = (0.035 * width * unit, 0.03 * width * unit, _MOTOR_RADIUS * unit)
        half = self._point(angles.motor, _MOTOR_RADIUS / 2, 0.12)
        yield _marker(kind, 2, Marker.CUBE, colour, pointer, half, motor)

    def _bounds(self, estimate: Angles, bound: Angles, colour: ColorRGBA) -> Iterator[Marker]:
        dials = zip(estimate, bound, (_LINK_DIAL, _MOTOR_DIAL), strict=True)
        for number, (angle, half, (inner, outer)) in enumerate(dials):
            if math.isfinite(half):
                ends = angle + min(half, math.pi) * np.linspace(-1.0, 1.0, 17)
                rims = [[self._point(each, r) for each in ends.tolist()] for r in (inner, outer)]
                points = [
                    rims[rim][place + step]
                    for place in range(len(ends) - 1)
                    for rim, step in ((0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1))
                ]
                marker = _marker("bound", number, Marker.TRIANGLE_LIST, colour, (1.0, 1.0, 1.0))
                marker.points = points
                yield marker

    def _motor(self) -> Marker:
        size = (2.0 * _MOTOR_RADIUS * self._unit,) * 2 + (0.04 * self._unit,)
        lying = Quaternion(x=math.sqrt(0.5), w=math.sqrt(0.5))
        centre = self._point(0.0, 0.0, 0.16)
        return _marker("motor", 0, Marker.CYLINDER, _colour(GRID), size, centre, lying)

    def _spring(self, angles: Angles) -> Marker:
        """Draw a spiral from the motor's rim to the link's shaft, which its wind-up tightens."""
        wind_up = angles.motor - angles.link
        turned = np.linspace(angles.motor, angles.link + 2.0 * math.pi * _TURNS, 73)
        radii = np.linspace(0.9 * _MOTOR_RADIUS, _SHAFT_RADIUS, len(turned))
        share = min(1.0, abs(wind_up) / _STRAIN)
        colour = _between(_colour(_SPRING), _colour(_STRAINED), share)
        marker = _marker("spring", 0, Marker.LINE_STRIP, colour, (0.016 * self._unit, 0.0, 0.0))
        marker.points = [
            self._point(angle, radius, 0.07)
            for angle, radius in zip(turned.tolist(), radii.tolist(), strict=True)
        ]
        return marker

    def _label(self, arm: Arm, colour: str) -> Marker:
        lines = [arm.name, arm.fault or "no diagnostics"]
        moving = arm.estimate or arm.truth
        if moving is not None:
            lines.append(f"spring {moving.motor - moving.link:+.2f} rad")
        size = (0.0, 0.0, 0.11 * self._unit)
        at = Point(x=self._x, y=0.0, z=0.65 * self._unit)
        marker = _marker("label", 0, Marker.TEXT_VIEW_FACING, _colour(colour), size, at)
        marker.text = "\n".join(lines)
        return marker

    def _point(self, angle: float, radius: float, y: float = 0.0) -> Point:
        """Return the point at an angle [rad] and a radius and depth [link lengths]."""
        unit = self._unit
        return Point(
            x=self._x + radius * unit * math.sin(angle),
            y=y * unit,
            z=-radius * unit * math.cos(angle),
        )


def _marker(
    namespace: str,
    number: int,
    kind: int,
    colour: ColorRGBA,
    scale: Iterable[float],
    at: Point | None = None,
    turned: Quaternion | None = None,
) -> Marker:
    x, y, z = scale
    pose = Pose(position=at or Point(), orientation=turned or Quaternion(w=1.0))
    return Marker(
        ns=namespace, id=number, type=kind, action=Marker.ADD, pose=pose,
        scale=Vector3(x=x, y=y, z=z), color=colour,
    )  # fmt: skip


def _turned(angle: float) -> Quaternion:
    """Return the rotation by an angle about −y."""
    return Quaternion(y=-math.sin(angle / 2), w=math.cos(angle / 2))


def _colour(text: str, opacity: float = 1.0) -> ColorRGBA:
    r, g, b = (int(text[place : place + 2], 16) / 255.0 for place in (1, 3, 5))
    return ColorRGBA(r=r, g=g, b=b, a=opacity)


def _between(first: ColorRGBA, last: ColorRGBA, share: float) -> ColorRGBA:
    ends = [np.array([each.r, each.g, each.b]) for each in (first, last)]
    r, g, b = (ends[0] + share * (ends[1] - ends[0])).tolist()
    return ColorRGBA(r=r, g=g, b=b, a=1.0)
