# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which topic the messages of a damaged file's channels belong to."""

from collections.abc import Iterable
from typing import NamedTuple

from mcap.records import Channel

from tsobs_ros.bag.cdr import MessageLayout, UnknownLayoutError
from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.bag.metadata import TYPE_HASH, BagMetadata, QosProfile, TopicInfo, profiles_from_yaml
from tsobs_ros.bag.recovery.survey import Survey
from tsobs_ros.bag.writer import LIBRARY
from tsobs_ros.errors import BagWriteError


class Topic(NamedTuple):
    """A topic with all that a bag needs to know of it."""

    name: str
    definition: MessageDefinition
    qos: tuple[QosProfile, ...]


class Destinations(dict[int, tuple[str, str]]):
    """Topic and type by channel; for channels without, an empty topic and the reason."""

    def __missing__(self, channel: int) -> tuple[str, str]:
        """Return that nothing is known of a channel."""
        return "", f"of channel {channel}, whose topic is lost"


class KnownTopics:
    """Finds out about topics in all places that a bag repeats itself in.

    Args:
        surveys: What the bag's files tell.
        metadata: What its folder tells; None if that is lost.

    Attributes:
        topics: The topics found, by name, in the order in which they were asked for.
    """

    def __init__(self, surveys: Iterable[Survey], metadata: BagMetadata | None) -> None:
        self.topics: dict[str, Topic] = {}
        self._definitions: dict[tuple[str, str], MessageDefinition] = {}
        self._listed: tuple[TopicInfo, ...] = metadata.topics if metadata else ()
        for survey in surveys:
            if survey.metadata and len(survey.metadata.topics) > len(self._listed):
                self._listed = survey.metadata.topics
            for channel in survey.channels.values():
                if definition := _stored_definition(survey, channel):
                    key = (definition.type, definition.type_hash)
                    self._definitions.setdefault(key, definition)

    def destinations(self, survey: Survey) -> Destinations:
        """Return where the messages of a file's channels belong."""
        found = Destinations()
        for id_, channel in survey.channels.items():
            found[id_] = self._destination(survey, channel)
        if survey.library.startswith(f"{LIBRARY} "):
            # Our files number the channels in the order in which the metadata lists the topics.
            for id_, listed in enumerate(self._listed, start=1):
                if id_ not in found and (definition := self._definition_of(listed)):
                    qos = listed.qos_profiles
                    found[id_] = self._add(Topic(listed.name, definition, qos))
        return found

    def _destination(self, survey: Survey, channel: Channel) -> tuple[str, str]:
        if channel.message_encoding != "cdr":
            return "", f"of {channel.topic}, which is encoded in '{channel.message_encoding}'"
        definition = _stored_definition(survey, channel)
        if definition is None:
            named = (listed for listed in self._listed if listed.name == channel.topic)
            definition = next(filter(None, map(self._definition_of, named)), None)
        if definition is None:
            return "", f"of {channel.topic}, whose type is lost"
        try:
            qos = profiles_from_yaml(channel.metadata.get("offered_qos_profiles", ""))
        except ValueError:
            qos = ()
        return self._add(Topic(channel.topic, definition, qos))

    def _add(self, topic: Topic) -> tuple[str, str]:
        known = self.topics.setdefault(topic.name, topic)
        if known.definition.type != topic.definition.type:
            return "", f"of {topic.name} as {topic.definition.type}, which is two types"
        return topic.name, topic.definition.type

    def _definition_of(self, listed: TopicInfo) -> MessageDefinition | None:
        """Return a definition that is certainly the one the topic had: its hash agrees."""
        if not (hash_ := listed.type_hash):
            return None
        if known := self._definitions.get((listed.type, hash_)):
            return known
        try:
            installed = find_definition(listed.type)
        except BagWriteError:
            return None
        return installed if installed.type_hash == hash_ else None


def _stored_definition(survey: Survey, channel: Channel) -> MessageDefinition | None:
    """Return the definition a file has of a channel's type, if that is not damaged itself."""
    schema = survey.schemas.get(channel.schema_id)
    if schema is None:
        return None
    text = schema.data.decode(errors="replace")
    if schema.encoding == "ros2msg":
        try:
            MessageLayout(schema.name, text)
        except UnknownLayoutError:
            pass
        except ValueError:
            return None
    hash_ = channel.metadata.get("topic_type_hash", "")
    if not TYPE_HASH.fullmatch(hash_):
        hash_ = ""
    return MessageDefinition(schema.name, text, hash_, schema.encoding)
