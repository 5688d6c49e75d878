# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which topics to record, by the rules of `ros2 bag record`."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

_SERVICE_EVENT = "/_service_event"


@dataclass(frozen=True)
class TopicSelection:
    """What is wanted of all topics and services, by full names and patterns.

    A service is recorded by the topic of its events, which it publishes where introspection is
    switched on for it; patterns are held against the name of the service.

    Attributes:
        topics: Topics to record, hidden ones among them.
        services: Services to record.
        all_topics: Whether to record every topic.
        all_services: Whether to record every service.
        regex: Record what contains this; nothing if empty.
        exclude_topics: Topics not to record after all.
        exclude_services: Services not to record after all.
        exclude_regex: Do not record what contains this; nothing if empty.
        include_hidden: Whether hidden topics, with a name part that begins with `_`, count as
            topics where they are not listed.
    """

    topics: frozenset[str] = frozenset()
    services: frozenset[str] = frozenset()
    all_topics: bool = False
    all_services: bool = False
    regex: str = ""
    exclude_topics: frozenset[str] = frozenset()
    exclude_services: frozenset[str] = frozenset()
    exclude_regex: str = ""
    include_hidden: bool = False

    @property
    def listed(self) -> list[str]:
        """The topics that are wanted by name and awaited, those of services among them."""
        topics = set() if self.all_topics else {t for t in self.topics if self.wants(t, ())}
        if not self.all_services:
            topics |= {
                service + _SERVICE_EVENT
                for service in self.services
                if self._decide(service, True, service in self.exclude_services)
            }
        return sorted(topics)

    @property
    def has_patterns(self) -> bool:
        """Whether topics are wanted that are not listed."""
        return self.all_topics or self.all_services or bool(self.regex)

    def wants(self, topic: str, types: Sequence[str]) -> bool:
        """Return whether to record a topic that has these types."""
        if is_service_event(topic, types):
            service = topic.removesuffix(_SERVICE_EVENT)
            wanted = self.all_services or service in self.services or topic in self.topics
            excluded = service in self.exclude_services or topic in self.exclude_topics
            return self._decide(service, wanted, excluded)
        wanted = topic in self.topics
        if not wanted and not self.include_hidden and "/_" in topic:
            return False
        return self._decide(topic, wanted or self.all_topics, topic in self.exclude_topics)

    def _decide(self, name: str, wanted: bool, excluded: bool) -> bool:
        if excluded or (self.exclude_regex and re.search(self.exclude_regex, name)):
            return False
        return wanted or bool(self.regex and re.search(self.regex, name))


def is_service_event(topic: str, types: Sequence[str]) -> bool:
    """Return whether a topic of these types carries the events of a service."""
    return topic.endswith(_SERVICE_EVENT) and any(
        "/srv/" in name and name.endswith("_Event") for name in types
    )
