# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the visualizer draws is where the messages say, in the colour of the sensor's fault."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from staging import start
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from tsobs_ros.design.file import load_design_file
from tsobs_ros.design.published import record_text
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

DATA = Path(__file__).resolve().parents[1] / "estimation" / "data"
BOTH = DATA / "both_encoders.design.yaml"
MEASUREMENTS = "/sensors/joints"
Scene = Mapping[tuple[str, int], Marker]
BLUE, ORANGE, RED, GREY = (0, 114, 178), (230, 159, 0), (213, 94, 0), (82, 96, 109)


class Publisher:
    """Publishes as an observer, its sensor and a simulator do, and collects the markers."""

    def __init__(self, ros: Any) -> None:
        self._ros = ros
        self._node = ros.node("publisher")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publishers = {
            topic: self._node.create_publisher(JointState, topic, 10)
            for topic in (
                MEASUREMENTS, "observer/joint_states", "observer/error_bound",
                "ground_truth/joint_states",
            )
        }  # fmt: skip
        self._design = self._node.create_publisher(String, "observer/design", latched)
        self._diagnostics = self._node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._scenes: list[MarkerArray] = []
        self._node.create_subscription(MarkerArray, "visualizer/markers", self._scenes.append, 10)

    def record(self, text: str = "", **designs: Path) -> None:
        """Publish which joint has which design, or a text that says otherwise."""
        files = [load_design_file(path) for path in designs.values()]
        text = text or record_text(MEASUREMENTS, list(designs), files, {})
        self._design.publish(String(data=text))

    def fault(self, name: str, level: bytes, message: str, magnitude: str) -> None:
        """Publish the status of a sensor."""
        values, name = [KeyValue(key="magnitude [rad]", value=magnitude)], f"observer: {name}"
        status = DiagnosticStatus(name=name, level=level, message=message, values=values)
        self._diagnostics.publish(DiagnosticArray(status=[status]))

    def scene_of(self, done: Callable[[Scene], bool], **positions: Mapping[str, float]) -> Scene:
        """Publish positions until a scene is as wanted, and return it."""
        topics = {
            "measured": MEASUREMENTS, "estimate": "observer/joint_states",
            "bound": "observer/error_bound", "truth": "ground_truth/joint_states",
        }  # fmt: skip

        def published() -> bool:
            for what, values in positions.items():
                message = JointState(name=list(values), position=list(values.values()))
                self._publishers[topics[what]].publish(message)
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
    publisher.record(elbow=Path(config_path(SHIPPED_DESIGN)), wrist=BOTH)
    publisher.fault("wrist: sensor fault of link_angle", DiagnosticStatus.ERROR, "bias", "0.61")

    scene = publisher.scene_of(
        lambda each: colour_of(each["label", 100]) == RED and has(("measurement", 101))(each),
        estimate={
            "elbow_link": 0.5, "elbow_motor": 0.8, "wrist_link": -2.0, "wrist_motor": 4.0,
            "level": 3.0,
        },
        bound={"elbow_link": 0.1, "elbow_motor": 0.02, "wrist_link": 9.0, "wrist_motor": 0.0},
        truth={"elbow_link": 0.4, "elbow_motor": 0.7},
        measured={"wrist_motor": 1.0, "wrist": -1.5, "elbow": 0.45, "other": 1.0},
    )  # fmt: skip

    # A link of 2 m at 0.5 rad, seen from -y: to the right and down, from the origin.
    for kind, angle in (("estimate", 0.5), ("truth", 0.4)):
        tip, pointer = (scene[kind, number].pose.position for number in (1, 2))
        assert (tip.x, tip.z) == pytest.approx((2.0 * math.sin(angle), -2.0 * math.cos(angle)))
        assert angle_of(pointer) == pytest.approx(angle + 0.3)
    assert scene["estimate", 0].color.a == pytest.approx(0.45)
    assert scene["truth", 0].color.a == 1.0
    # Three bounds to both sides; the spring winds from the motor's angle to the link's.
    for number, ends in ((0, (0.2, 0.8)), (1, (0.74, 0.86))):
        angles = [angle_of(point) for point in scene["bound", number].points]
        assert (min(angles), max(angles)) == (pytest.approx(ends[0]), pytest.approx(ends[1]))
    spring = scene["spring", 0].points
    assert [angle_of(spring[end]) for end in (0, -1)] == pytest.approx([0.8, 0.5])
    # The elbow has an encoder on its link, the wrist on both sides, 5.2 m further on.
    dots = {key: each.pose.position for key, each in scene.items() if key[0] == "measurement"}
    assert set(dots) == {("measurement", 0), ("measurement", 100), ("measurement", 101)}
    assert angle_of(dots["measurement", 0]) == pytest.approx(0.45)
    assert angle_of(dots["measurement", 100], x=5.2) == pytest.approx(-1.5)
    assert angle_of(dots["measurement", 101], x=5.2) == pytest.approx(1.0)
    # Colours and words of the wrist's fault; the elbow has no diagnostics.
    assert colour_of(scene["estimate", 100]) == RED
    assert scene["label", 100].text == "wrist\nbias 0.61 rad\nspring +6.00 rad"
    assert colour_of(scene["estimate", 0]) == GREY
    assert scene["label", 0].text == "elbow\nno diagnostics\nspring +0.30 rad"
    assert {each.header.frame_id for each in scene.values()} == {"world"}
    assert all(each.lifetime.sec == 1 for each in scene.values())


@pytest.mark.parametrize(
    ("level", "message", "colour", "words"),
    [
        (DiagnosticStatus.OK, "none", BLUE, "no fault"),
        (DiagnosticStatus.WARN, "drift", ORANGE, "drift 0.2 rad"),
        (b"\x07", "?", GREY, "? 0.2 rad"),
    ],
)
def test_an_observer_of_one_arm_shows_the_level_of_its_fault(
    publisher: Publisher, level: bytes, message: str, colour: tuple[int, ...], words: str
) -> None:
    publisher.fault("sensor fault", level, message, "0.2")

    scene = publisher.scene_of(
        lambda each: words in each["label", 0].text, estimate={"a_link": 0.0, "a_motor": 0.0}
    )

    assert colour_of(scene["estimate", 0]) == colour_of(scene["label", 0]) == colour
    assert not {"truth", "bound", "measurement"} & {kind for kind, _ in scene}


def test_a_lost_estimate_leaves_the_truth_and_nothing_else(
    publisher: Publisher, hostile: str, check_shown: Callable[[str], None]
) -> None:
    """A text that is no record, names that command a terminal and NaN harm nobody."""
    publisher.record(f"{{{hostile}")
    publisher.record(record_text("no topic.csv", [], [], {}))
    name = hostile.replace("\0", "")
    both = {f"{name}_link": 1.0, f"{name}_motor": 1.0}
    scene = publisher.scene_of(has(("truth", 0), ("estimate", 0)), truth=both, estimate=both)
    check_shown(scene["label", 0].text)

    unknown = {f"{name}_link": math.nan, f"{name}_motor": 1.0}
    scene = publisher.scene_of(
        lambda each: ("estimate", 0) not in each, truth=both, estimate=unknown
    )

    assert {kind for kind, _ in scene} == {"truth", "motor", "spring", "label"}
