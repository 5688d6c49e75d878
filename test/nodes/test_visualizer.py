# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the visualizer draws is where the messages say, in the colour of the sensor's fault."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState
from staging import start
from visualization_msgs.msg import Marker, MarkerArray

Scene = Mapping[tuple[str, int], Marker]
BLUE, ORANGE, RED, GREY = (0, 114, 178), (230, 159, 0), (213, 94, 0), (82, 96, 109)


class Publisher:
    """Publishes as an observer and a simulator do, and collects the markers."""

    def __init__(self, ros: Any) -> None:
        self._ros = ros
        self._node = ros.node("publisher")
        topics = ("observer/joint_states", "observer/error_bound", "ground_truth/joint_states")
        self._publishers = [self._node.create_publisher(JointState, each, 10) for each in topics]
        self._diagnostics = self._node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._scenes: list[MarkerArray] = []
        self._node.create_subscription(MarkerArray, "visualizer/markers", self._scenes.append, 10)

    def fault(self, name: str, level: bytes, message: str) -> None:
        """Publish the status of a sensor."""
        status = DiagnosticStatus(name=f"observer: {name}", level=level, message=message)
        self._diagnostics.publish(DiagnosticArray(status=[status]))

    def scene_of(self, done: Callable[[Scene], bool], *positions: Mapping[str, float]) -> Scene:
        """Publish estimates, bounds and truth until a scene is as wanted, and return it."""

        def published() -> bool:
            for publisher, values in zip(self._publishers, positions, strict=False):
                if values:
                    publisher.publish(JointState(name=list(values), position=list(values.values())))
            scenes, self._scenes[:] = self._scenes[:], []
            self.found = [each for each in map(indexed, scenes) if done(each)]
            return bool(self.found)

        self._ros.spin_until(published, what="the wanted scene")
        return self.found[-1]


def indexed(array: MarkerArray) -> Scene:
    found = {(each.ns, each.id): each for each in array.markers}
    assert len(found) == len(array.markers), "a view would draw only one of two equal ids"
    return found


def angle_of(point: Any, x: float = 0.0) -> float:
    return math.atan2(point.x - x, -point.z)


def colour_of(marker: Marker) -> tuple[int, ...]:
    colour = marker.color
    return tuple(round(255 * each) for each in (colour.r, colour.g, colour.b))


def has(*wanted: tuple[str, int]) -> Callable[[Scene], bool]:
    return lambda scene: set(wanted) <= set(scene)


@pytest.fixture
def publisher(ros: Any) -> Publisher:
    start(ros, "visualizer", rate=100.0, link_length=2.0)
    return Publisher(ros)


def test_arms_stand_where_the_messages_say(publisher: Publisher) -> None:
    publisher.fault("wrist: sensor fault of link_angle", DiagnosticStatus.ERROR, "bias")
    scene = publisher.scene_of(
        lambda each: has(("label", 100))(each) and colour_of(each["label", 100]) == RED,
        {"elbow_link": 0.5, "elbow_motor": 0.8, "wrist_link": -2.0, "wrist_motor": 4.0, "x": 3.0},
        {"elbow_link": 0.1, "elbow_motor": 0.02, "wrist_link": 9.0, "wrist_motor": 0.0},
        {"elbow_link": 0.4, "elbow_motor": 0.7},
    )
    # A link of 2 m at 0.5 rad, seen from -y: to the right and down, from the origin.
    for kind, angle in (("estimate", 0.5), ("truth", 0.4)):
        tip, pointer = (scene[kind, number].pose.position for number in (1, 2))
        assert (tip.x, tip.z) == pytest.approx((2.0 * math.sin(angle), -2.0 * math.cos(angle)))
        assert angle_of(pointer) == pytest.approx(angle + 0.3)
    # The wrist is 5.2 m further on.
    assert angle_of(scene["estimate", 101].pose.position, 5.2) == pytest.approx(-2.0)
    # Three bounds to both sides; the spring is wound up from the motor's angle to the link's.
    for number, ends in ((0, (0.2, 0.8)), (1, (0.74, 0.86))):
        angles = [angle_of(point) for point in scene["bound", number].points]
        assert (min(angles), max(angles)) == (pytest.approx(ends[0]), pytest.approx(ends[1]))
    spring = scene["spring", 0].points
    assert [angle_of(spring[end]) for end in (0, -1)] == pytest.approx([0.8, 0.5])
    # Colours and words of the wrist's fault; the elbow has no diagnostics.
    assert colour_of(scene["estimate", 100]) == RED
    assert scene["label", 100].text == "wrist\nsensor fault: bias\nspring +6.00 rad"
    assert colour_of(scene["estimate", 0]) == GREY
    assert scene["label", 0].text == "elbow\nsensor fault: ?\nspring +0.30 rad"
    assert {each.header.frame_id for each in scene.values()} == {"world"}
    assert all(each.lifetime.sec == 1 for each in scene.values())


def test_an_observer_of_one_arm_shows_the_level_of_its_fault(publisher: Publisher) -> None:
    levels = {
        "none": (DiagnosticStatus.OK, BLUE),
        "drift": (DiagnosticStatus.WARN, ORANGE),
        "odd": (b"\x07", GREY),
    }
    for message, (level, colour) in levels.items():
        publisher.fault("sensor fault", level, message)
        scene = publisher.scene_of(
            lambda each, message=message: message in each["label", 0].text,
            {"a_link": 0.0, "a_motor": 0.0},
        )
        assert colour_of(scene["estimate", 0]) == colour_of(scene["label", 0]) == colour
        assert not {"truth", "bound"} & {kind for kind, _ in scene}


def test_a_lost_estimate_leaves_the_truth_and_nothing_else(
    publisher: Publisher, hostile: str, check_shown: Callable[[str], None]
) -> None:
    """Names that command a terminal and NaN harm nobody."""
    name = hostile.replace("\0", "")
    both = {f"{name}_link": 1.0, f"{name}_motor": 1.0}
    scene = publisher.scene_of(has(("truth", 0), ("estimate", 0)), both, {}, both)
    check_shown(scene["label", 0].text)
    for unknown in (math.nan, 1.7e308):
        publisher.scene_of(has(("estimate", 0)), both, dict.fromkeys(both, -1e308), both)
        scene = publisher.scene_of(
            lambda each: ("estimate", 0) not in each, {**both, f"{name}_link": unknown}, {}, both
        )
        assert {kind for kind, _ in scene} == {"truth", "motor", "spring", "label"}
