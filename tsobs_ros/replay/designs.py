# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Designs and parameters of recorded observers, as far as a bag has them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import CdrReader
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.design.file import PublishedDesign, Value, read_record
from tsobs_ros.errors import BagReadError, DesignFileError, MessageError, TsobsError
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.settings import changed, settings_of

STRING = "std_msgs/msg/String"

_MAX_RECORDS = 100


@dataclass(frozen=True)
class RecordedObserver:
    """The designs and parameters of a bag's observer, as far as the bag has them.

    Attributes:
        source: The topic that has them.
        designs: The designs of each joint in order; several if the observer was restarted.
        parameters: The parameters that decide the estimates, by their names at the node.
        measurements: Full name of the topic of its measurements.
        remarks: Notes for the user.
    """

    source: str = ""
    designs: Mapping[str, tuple[PublishedDesign, ...]] = field(default_factory=dict)
    parameters: Mapping[str, Value] = field(default_factory=dict)
    measurements: str | None = None
    remarks: tuple[str, ...] = ()

    def doubt(self, given: Sequence[str]) -> list[str]:
        """Return a warning if the bag has no design of its observer, and no file is given."""
        if self.designs or given:
            return []
        return [
            "warning: the bag does not show which design its observer ran; the shipped one is "
            "assumed, --design FILE names another"
        ]

    def settings(self) -> ObserverSettings:
        """Return the observer's settings, with defaults for those that are not recorded.

        Raises:
            BagReadError: A parameter is of the wrong type or out of range.
        """
        known = settings_of(ObserverSettings).keys() & self.parameters.keys()
        try:
            return changed(ObserverSettings(), {name: self.parameters[name] for name in known})
        except TsobsError as error:
            raise BagReadError(f"{self.source}: {error}") from error


def recorded_observers(reader: BagReader) -> dict[str, RecordedObserver]:
    """Return the designs and parameters of the observers of a bag, by the observers' full names.

    Raises:
        BagReadError: A topic `design` has other content.
    """
    end, found = f"/{topics.DESIGN}", dict[str, RecordedObserver]()
    for topic, info in reader.topics.items():
        if topic.endswith(end) and info.type == STRING and info.count:
            try:
                found[topic.removesuffix(end)] = _of_records(reader, topic)
            except (MessageError, DesignFileError) as error:
                raise BagReadError(f"{reader.path}: {topic}: {error}") from error
    return found


def _of_records(reader: BagReader, topic: str) -> RecordedObserver:
    texts: dict[str, None] = {}
    for message in reader.messages([topic]):
        texts[CdrReader(message.data).text("data")] = None
        if len(texts) > _MAX_RECORDS:
            raise DesignFileError(f"more than {_MAX_RECORDS} different messages")
    first, *others = map(read_record, texts)
    values = first.parameters.items()
    differing = sorted({name for one in others for name, _ in one.parameters.items() ^ values})
    remark = (
        "note: parameters of the observer were changed while it ran: "
        f"{', '.join(differing)}; the first values are used"
    )
    designs: dict[str, dict[str, PublishedDesign]] = {}
    for one in (design for record in (first, *others) for design in record.designs):
        for joint in one.joints:
            designs.setdefault(joint, {}).setdefault(one.text, one)
    by_joint = {joint: tuple(each.values()) for joint, each in designs.items()}
    remarks = (remark,) if differing else ()
    return RecordedObserver(topic, by_joint, first.parameters, first.measurements, remarks)
