# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Checking what a file of a bag holds: its topics, their definitions, and each message."""

from mcap.records import Channel, Metadata, Schema

from tsobs_ros.bag.cdr import MessageLayout, UnknownLayoutError
from tsobs_ros.bag.metadata import EMPTY_START_NS, TYPE_HASH, BagMetadata, profiles_from_yaml
from tsobs_ros.bag.verification.findings import Findings
from tsobs_ros.bag.verification.folder import TYPE_NAME
from tsobs_ros.errors import MessageError

_CHANNEL_KEYS = ("offered_qos_profiles", "topic_type_hash")


class ContentCheck:
    """Checks records as they come, in the order of the file.

    Args:
        file: The file's name.
        findings: Where to add what is wrong.

    Attributes:
        schemas: The schemas so far, by id.
        channels: The channels so far, by id.
        counts: The messages so far, by channel.
        start: The smallest log time so far, ns.
        end: The largest log time so far, ns.
    """

    def __init__(self, file: str, findings: Findings) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] = {}
        self.start = EMPTY_START_NS
        self.end = 0
        self._file = file
        self._findings = findings
        self._layouts: dict[int, MessageLayout | None] = {}

    @property
    def message_count(self) -> int:
        """The messages so far."""
        return sum(self.counts.values())

    def add_schema(self, schema: Schema) -> None:
        """Check a schema."""
        if known := self.schemas.get(schema.id):
            if known != schema:
                self._error("", f"two schemas have the id {schema.id}: {known.name}, {schema.name}")
            return
        self.schemas[schema.id] = schema
        if schema.id == 0:
            self._error("", f"the schema of {schema.name} has the id 0, which means none")
        if not TYPE_NAME.fullmatch(schema.name):
            self._error("", f"the schema '{schema.name}' is not named as package/msg/Type")
        if schema.encoding == "ros2idl":
            self._findings.remark(
                self._file, f"{schema.name} is defined in IDL: its messages are not looked into"
            )
        elif schema.encoding != "ros2msg":
            self._error("", f"{schema.name} is defined in '{schema.encoding}', not in ros2msg")
        else:
            self._layouts[schema.id] = self._layout(schema)

    def add_channel(self, channel: Channel) -> None:
        """Check a channel, after its schema."""
        topic = channel.topic
        if known := self.channels.get(channel.id):
            if known != channel:
                self._error("", f"two channels have the id {channel.id}: {known.topic}, {topic}")
            return
        if any(other.topic == topic for other in self.channels.values()):
            self._error(topic, "has more than one channel")
        self.channels[channel.id] = channel
        if channel.message_encoding != "cdr":
            self._error(topic, f"is encoded in '{channel.message_encoding}', not in cdr")
        if channel.schema_id not in self.schemas:
            self._error(topic, f"has the schema {channel.schema_id}, which is not there before it")
        for key in _CHANNEL_KEYS:
            if key not in channel.metadata:
                self._remark(topic, f"the channel's metadata has no '{key}'")
        for key in channel.metadata.keys() - set(_CHANNEL_KEYS):
            self._remark(topic, f"the channel's metadata has '{key}', which is none of rosbag2's")
        hash_ = channel.metadata.get("topic_type_hash", "")
        if hash_ and not TYPE_HASH.fullmatch(hash_):
            self._error(topic, f"topic_type_hash is '{hash_}', not RIHS01_<64 hex digits>")
        try:
            profiles_from_yaml(channel.metadata.get("offered_qos_profiles", ""))
        except ValueError as error:
            self._error(topic, str(error))

    def add_message(
        self, channel_id: int, sequence: int, log_time: int, publish_time: int, data: bytes
    ) -> None:
        """Check a message, after its channel."""
        channel = self.channels.get(channel_id)
        self.counts[channel_id] = self.counts.get(channel_id, 0) + 1
        if log_time < self.start:
            self.start = log_time
        if log_time > self.end:
            self.end = log_time
        if channel is None:
            text = f"a message is of channel {channel_id}, which is not there before it"
            self._error("", text, f"channel {channel_id}")
            return
        topic = channel.topic
        if max(log_time, publish_time) >= EMPTY_START_NS:
            text = f"a time does not fit 63 bits: log {log_time} ns, publish {publish_time} ns"
            self._error(topic, text, "time range")
        if not log_time:
            self._remark(topic, "a message has the log time 0", "zero")
        if sequence:
            self._remark(topic, f"a message has the sequence {sequence}, rosbag2 writes 0", "seq")
        if layout := self._layouts.get(channel.schema_id):
            try:
                layout.check(data)
            except MessageError as error:
                self._error(topic, f"the message at {log_time} ns is not whole: {error}", "cdr")

    def add_metadata(self, record: Metadata) -> BagMetadata | None:
        """Check a metadata record and return what it says of the bag, if it does."""
        if record.name != "rosbag2":
            self._findings.remark(self._file, f"has the metadata record '{record.name}'")
            return None
        if list(record.metadata) != ["serialized_metadata"]:
            keys = ", ".join(record.metadata)
            self._error("", f"the metadata record has the keys '{keys}', not 'serialized_metadata'")
            return None
        try:
            return BagMetadata.from_yaml(record.metadata["serialized_metadata"])
        except ValueError as error:
            self._error("", f"serialized_metadata cannot be read: {error}")
            return None

    def _layout(self, schema: Schema) -> MessageLayout | None:
        try:
            return MessageLayout(schema.name, schema.data.decode())
        except UnknownLayoutError as reason:
            self._findings.remark(self._file, f"{reason}: its messages are not looked into")
        except ValueError as error:  # not UTF-8 is a ValueError as well
            self._error("", f"the definition of {schema.name} is malformed: {error}")
        return None

    def _error(self, topic: str, text: str, rule: str = "") -> None:
        self._findings.error(f"{self._file}: {topic}" if topic else self._file, text, rule)

    def _remark(self, topic: str, text: str, rule: str = "") -> None:
        self._findings.remark(f"{self._file}: {topic}", text, rule)
