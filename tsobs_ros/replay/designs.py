# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The designs of a recorded observer, and the choice between them and those that are named."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import CdrReader
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.design.file import IDENTITY_LENGTH, DesignFile, checksum, load_design_file
from tsobs_ros.design.published import Value, read_record
from tsobs_ros.errors import BagReadError, DesignFileError, MessageError, TsobsError
from tsobs_ros.methods import SETTING_NAMES, ObserverSettings
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

STRING = "std_msgs/msg/String"

_MAX_RECORDS = 100


class RanDesign(NamedTuple):
    """A design that a recorded observer ran.

    Attributes:
        file: Its path where it ran.
        sha256: Its checksum.
        text: Its content.
    """

    file: str
    sha256: str
    text: str

    def __str__(self) -> str:
        return f"{self.file:.200} (SHA-256 {self.sha256:.{IDENTITY_LENGTH}})"


@dataclass(frozen=True)
class RecordedObserver:
    """What the observer of a bag ran, as far as the bag has it.

    Attributes:
        source: The topic that has it.
        designs: Those of each joint, one after the other; there are several if it was restarted.
        parameters: Those that decide estimates, by the node's names.
        measurements: Full name of the topic of its measurements.
        remarks: Notes for the user.
    """

    source: str = ""
    designs: Mapping[str, tuple[RanDesign, ...]] = field(default_factory=dict)
    parameters: Mapping[str, Value] = field(default_factory=dict)
    measurements: str | None = None
    remarks: tuple[str, ...] = ()

    def doubt(self, given: Sequence[str]) -> list[str]:
        """Return a warning if nothing shows what a recorded observer ran, and no file is given."""
        if self.designs or given:
            return []
        return [
            "warning: the bag does not show which design its observer ran; the shipped one is "
            "assumed, --design FILE names another"
        ]

    def settings(self) -> ObserverSettings:
        """Return the settings that it ran with; the defaults as far as they are not recorded.

        Raises:
            BagReadError: A parameter is of the wrong type or out of range.
        """
        known = {name: value for name, value in self.parameters.items() if name in SETTING_NAMES}
        try:
            return ObserverSettings().with_parameters(known)
        except TsobsError as error:
            raise BagReadError(f"{self.source}: {error}") from error


def recorded_observer(reader: BagReader, name: str) -> RecordedObserver:
    """Return what an observer ran; as good as nothing of it may be in the bag.

    Args:
        reader: The bag.
        name: The node's full name.

    Raises:
        BagReadError: Its topic `design` has something else.
    """
    topic = f"{name}/{topics.DESIGN}"
    info = reader.topics.get(topic)
    if info is None or info.type != STRING or not info.count:
        return RecordedObserver()
    try:
        return _of_records(reader, topic)
    except (MessageError, DesignFileError) as error:
        raise BagReadError(f"{reader.path}: {topic}: {error}") from error


def choose_designs(
    bag: str | Path,
    ran: RecordedObserver,
    joints: Sequence[str],
    given: Sequence[str] = (),
    others_allowed: bool = False,
) -> dict[str, tuple[DesignFile, ...]]:
    """Return the designs to estimate with by the names of their files, each with one a joint.

    Args:
        bag: For errors.
        ran: What the recorded observer ran.
        joints: Names of the joints.
        given: Files that the user names, each for all joints, or `JOINT=FILE` for one of them; if
            empty, those that the observer ran, else the one that is shipped.
        others_allowed: Whether the files that are given may be others than those that it ran.

    Raises:
        DesignFileError: A file is no design, is not the one that the observer ran.
        BagReadError: The bag's own design is none.
    """
    own = dict(argument.split("=", 1) for argument in given if "=" in argument)
    shared: list[str | None] = [argument for argument in given if "=" not in argument]
    if unknown := sorted(set(own) - set(joints)):
        raise DesignFileError(
            f"--design {unknown[0]}={own[unknown[0]]}: no such joint; joints: {', '.join(joints)}"
        )
    if own and len(shared) > 1:
        raise DesignFileError(
            "--design: expected at most one file for the joints without their own, got "
            f"{', '.join(map(str, shared))}"
        )
    loaded: dict[str, DesignFile] = {}

    def load(joint: str, path: str | None) -> DesignFile:
        if path is None:
            return _recorded(bag, ran, joint, loaded)
        if path not in loaded:
            loaded[path] = load_design_file(path)
        file = loaded[path]
        for each in ran.designs.get(joint, ()):
            if not (others_allowed or each.sha256 == file.sha256):
                raise DesignFileError(
                    f"--design {path} (SHA-256 {file.identity}): the observer of {bag} ran {each} "
                    f"for {joint}; leave --design out to use that one, or add --other-design to "
                    f"use this one all the same"
                )
        return file

    found: dict[str, tuple[DesignFile, ...]] = {}
    for path in shared or [None]:
        name = "own"
        if path is not None and not own:
            stem = Path(path).name.split(".")[0].replace("-", "_").replace(" ", "_")
            name = stem if stem not in found else f"{stem}_{len(found) + 1}"
        found[name] = tuple(load(joint, own.get(joint, path)) for joint in joints)
    return found


def _recorded(
    bag: str | Path, ran: RecordedObserver, joint: str, loaded: dict[str, DesignFile]
) -> DesignFile:
    """Return the design that the observer ran for a joint; the shipped one if nothing is known."""
    if not ran.designs:
        return load_design_file(config_path(SHIPPED_DESIGN))
    designs = ran.designs.get(joint, ())
    if len(designs) != 1:
        which = f"no design for {joint}, but for {', '.join(ran.designs)}"
        option = f"--design {joint}=FILE"
        if designs:
            which = f"{' and then '.join(map(str, designs))} for {joint}"
            option = "--design FILE --other-design"
        raise DesignFileError(f"{bag}: its observer ran {which}; name one with {option}")
    (one,) = designs
    if one.text not in loaded:
        try:
            loaded[one.text] = load_design_file(f"{one.file:.200}", one.text)
        except DesignFileError as error:
            raise BagReadError(f"{bag}: {ran.source}: {error}") from error
    return loaded[one.text]


def _of_records(reader: BagReader, topic: str) -> RecordedObserver:
    texts: dict[str, None] = {}
    for message in reader.messages([topic]):
        texts[CdrReader(message.data).text("data")] = None
        if len(texts) > _MAX_RECORDS:
            raise DesignFileError(f"more than {_MAX_RECORDS} different messages")
    first, *others = map(read_record, texts)
    changed = sorted(
        name
        for other in others
        for name in first.parameters.keys() | other.parameters.keys()
        if first.parameters.get(name) != other.parameters.get(name)
    )
    remarks = []
    if changed:
        remarks.append(
            f"note: parameters of the observer were changed while it ran: "
            f"{', '.join(dict.fromkeys(changed))}; the first values are used"
        )
    designs: dict[str, dict[str, RanDesign]] = {}
    for record in (first, *others):
        for one in record.designs:
            design = RanDesign(one.file, checksum(one.text), one.text)
            for joint in one.joints:
                designs.setdefault(joint, {}).setdefault(design.sha256, design)
    by_joint = {joint: tuple(each.values()) for joint, each in designs.items()}
    return RecordedObserver(topic, by_joint, first.parameters, first.measurements, tuple(remarks))
