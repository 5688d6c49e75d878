# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a bag is, to the last record, what ROS 2 Jazzy's rosbag2 writes and reads.

An error is what makes a reader of such bags fail or lose something; a remark is what rosbag2 would
have written differently. All of them are told, not only the first.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tsobs_ros.bag.metadata import FILE_NAME, BagMetadata, FileMetadata, profiles_from_yaml
from tsobs_ros.bag.verification.content import ContentCheck
from tsobs_ros.bag.verification.file import FileFacts, verify_file
from tsobs_ros.bag.verification.findings import Finding, Findings
from tsobs_ros.bag.verification.folder import verify_folder
from tsobs_ros.errors import BagReadError


@dataclass(frozen=True)
class Verification:
    """What a check found.

    Attributes:
        path: The bag.
        files: How many files were checked.
        messages: How many messages were checked.
        errors: What makes readers fail or lose something.
        remarks: What rosbag2 would have written differently.
    """

    path: Path
    files: int
    messages: int
    errors: tuple[Finding, ...]
    remarks: tuple[Finding, ...]

    @property
    def holds(self) -> bool:
        """Whether there are no errors."""
        return not self.errors

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "bag": str(self.path),
            "holds": self.holds,
            "files": self.files,
            "messages": self.messages,
            "errors": [finding._asdict() for finding in self.errors],
            "remarks": [finding._asdict() for finding in self.remarks],
        }

    def text(self) -> str:
        """Return the same for people to read."""
        lines = [f"error: {finding}" for finding in self.errors]
        lines += [f"remark: {finding}" for finding in self.remarks]
        verdict = "OK" if self.holds else f"NOT sound, {_number(len(self.errors), 'error')}"
        count = f"{_number(self.messages, 'message')} in {_number(self.files, 'file')}"
        return "\n".join([*lines, f"{self.path}: {verdict}, {count}"])


def verify(bag: str | Path, progress: Callable[[int], object] = lambda _: None) -> Verification:
    """Check a bag: its folder, the structure of its files, and each message.

    Args:
        bag: A bag folder, or one MCAP file.
        progress: Called with the number of bytes that were checked since the last call.

    Raises:
        BagReadError: There is no such folder or file.
    """
    path = Path(bag)
    findings = Findings()
    if path.is_dir():
        metadata = verify_folder(path, findings)
        listed = _listed(path, metadata) if metadata else []
        paths = listed or sorted(path.glob("*.mcap"))
    elif path.is_file():
        metadata, paths = None, [path]
    else:
        raise BagReadError(f"{path}: there is no such bag")
    facts = {file.name: verify_file(file, findings, progress) for file in paths}
    if metadata:
        _compare(metadata, facts, findings)
    messages = sum(found.content.message_count for found in facts.values() if found)
    return Verification(path, len(paths), messages, findings.errors, findings.remarks)


def _listed(bag: Path, metadata: BagMetadata) -> list[Path]:
    """Return the files in the bag's folder that metadata.yaml names, each once.

    Nothing outside of the folder is opened: readers, too, take a path's last part for its name.
    """
    present = {file.name: file for file in bag.iterdir() if file.is_file()}
    names = dict.fromkeys(Path(file.path).name for file in metadata.files)
    return [present[name] for name in names if name in present]


def _compare(metadata: BagMetadata, facts: dict[str, FileFacts | None], findings: Findings) -> None:
    """Compare what metadata.yaml says with what the files hold."""
    # Files that are there may be others than are listed, and paths may be more than a name.
    listed = [(file, facts.get(Path(file.path).name)) for file in metadata.files]
    for file, found in listed:
        if found:
            if not found.is_damaged:
                _compare_file(file, found.content, findings)
            _compare_topics(metadata, file.path, found.content, findings)
    contents = [found.content for _, found in listed if found and not found.is_damaged]
    if len(contents) < len(listed):
        return
    for topic in metadata.topics:
        count = sum(_count(content, topic.name) for content in contents)
        findings.expect(FILE_NAME, f"message_count of {topic.name}", topic.count, count)
    for file, found in listed[-1:]:
        if found and found.stated and found.stated != metadata:
            findings.remark(file.path, f"its last record of {FILE_NAME} is another one")


def _compare_file(file: FileMetadata, content: ContentCheck, findings: Findings) -> None:
    actual = FileMetadata(file.path)
    if count := content.message_count:
        actual = FileMetadata(file.path, content.start, content.end - content.start, count)
    for what in ("starting_time_ns", "duration_ns", "message_count"):
        stated = getattr(file, what)
        findings.expect(FILE_NAME, f"{what} of {file.path}", stated, getattr(actual, what))


def _compare_topics(
    metadata: BagMetadata, file: str, content: ContentCheck, findings: Findings
) -> None:
    listed = {topic.name: topic for topic in metadata.topics}
    for channel in content.channels.values():
        place = f"{file}: {channel.topic}"
        topic = listed.get(channel.topic)
        if topic is None:
            findings.error(place, f"is not in {FILE_NAME}")
            continue
        if schema := content.schemas.get(channel.schema_id):
            findings.expect(FILE_NAME, f"type of {topic.name}", topic.type, schema.name)
        hash_ = channel.metadata.get("topic_type_hash", topic.type_hash)
        if hash_ != topic.type_hash:
            findings.error(place, f"its type's hash is not the one in {FILE_NAME}")
        try:
            qos = profiles_from_yaml(channel.metadata.get("offered_qos_profiles", ""))
        except ValueError:
            continue
        if qos != topic.qos_profiles:
            findings.error(
                place, f"its QoS is not the one in {FILE_NAME}: some readers give no messages then"
            )


def _count(content: ContentCheck, topic: str) -> int:
    ids: Sequence[int] = [id_ for id_, c in content.channels.items() if c.topic == topic]
    return sum(content.counts.get(id_, 0) for id_ in ids)


def _number(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
