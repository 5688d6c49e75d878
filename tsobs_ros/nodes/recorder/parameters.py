# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder's parameters, and the selection of topics by the rules of `ros2 bag record`."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tsobs_ros.bag.recording import Recording, SnapshotBuffer
from tsobs_ros.nodes.managed import ManagedParameters
from tsobs_ros.nodes.parameters import check_pattern
from tsobs_ros.settings import live_setting, setting

_MIB = 2**20
_SERVICE_EVENT = "/_service_event"


@dataclass(frozen=True)
class RecorderParameters(ManagedParameters):
    """The node's parameters; `config/recorder.yaml` shows them with their reasons."""

    topics: tuple[str, ...] = setting(
        (), "Topics to record, also hidden ones; '*' for all that are not"
    )
    services: tuple[str, ...] = setting((), "Services to record the events of; '*' for all")
    all: bool = setting(False, "Record all topics and services, as without any selection")
    all_services: bool = setting(False, "Record all services")
    regex: str = setting("", "Record topics and services that contain this")
    exclude_topics: tuple[str, ...] = setting((), "Topics not to record")
    exclude_services: tuple[str, ...] = setting((), "Services not to record")
    exclude_regex: str = setting("", "Do not record topics and services that contain this")
    include_hidden: bool = setting(False, "Let 'all' and 'regex' find hidden topics too")
    include_unpublished: bool = setting(
        False, "Subscribe to topics that others only subscribe to as well"
    )
    output: str = setting("", "Folder of the bag, which must not exist; empty for a dated name")
    compression: str = setting("zstd", "Compression of the chunks", choices=("none", "lz4", "zstd"))
    max_bag_size: int = setting(
        0, "Size at which a file is followed by another; 0: never", unit="bytes", minimum=0
    )
    max_bag_duration: float = setting(
        0.0, "Time after which a file is followed by another; 0: never", unit="s", minimum=0
    )
    repeat_latched: int = setting(
        1,
        "Messages of each latched publisher to repeat at the start of a file; 0: none",
        minimum=0,
        maximum=1000,
    )
    start_paused: bool = setting(False, "Wait for the service ~/resume")
    snapshot_mode: bool = setting(
        False, "Write only the last seconds, when the service ~/snapshot is called"
    )
    snapshot_duration: float = setting(
        30.0, "Time that a snapshot goes back", unit="s", minimum=0.001
    )
    snapshot_size: int = setting(100, "Memory that a snapshot may take", unit="MiB", minimum=1)
    flush_period: float = setting(
        0.5, "Age from which messages survive a kill", unit="s", minimum=0.01, maximum=10
    )
    sync_period: float = setting(
        5.0, "Age from which they survive a power cut", unit="s", minimum=0.1
    )
    drain_period: float = setting(
        0.01, "How often queues are emptied", unit="s", minimum=0.001, maximum=1
    )
    queue_depth: int = setting(
        5000, "Messages of a topic that may wait to be drained", minimum=1, maximum=5000
    )
    minimum_free_disk: int = live_setting(
        256, "Free disk space at which recording ends", unit="MiB", minimum=0
    )

    def __post_init__(self) -> None:
        """Check the patterns.

        Raises:
            ParameterError: A regular expression is malformed.
        """
        check_pattern("regex", self.regex)
        check_pattern("exclude_regex", self.exclude_regex)

    def recording(self, path: Path) -> Recording:
        """Return a recording into a folder.

        Raises:
            BagWriteError: The folder exists or cannot be created.
        """
        snapshot = SnapshotBuffer(round(self.snapshot_duration * 1e9), self.snapshot_size * _MIB)
        return Recording(
            path,
            compression=self.compression,
            max_size=self.max_bag_size,
            max_duration_ns=round(self.max_bag_duration * 1e9),
            repeat_latched=self.repeat_latched,
            sync_period=self.sync_period,
            snapshot=snapshot if self.snapshot_mode else None,
        )

    def resolved(
        self, topic_name: Callable[[str], str], service_name: Callable[[str], str]
    ) -> "RecorderParameters":
        """Return the parameters with full names of topics and services in place of those given."""
        return replace(
            self,
            topics=tuple(name if name == "*" else topic_name(name) for name in self.topics),
            services=tuple(name if name == "*" else service_name(name) for name in self.services),
            exclude_topics=tuple(map(topic_name, self.exclude_topics)),
            exclude_services=tuple(map(service_name, self.exclude_services)),
        )

    @property
    def wants_all_topics(self) -> bool:
        """Whether every topic is selected, as it is without any selection."""
        selected = self.topics or self.services or self.regex or self.all_services
        return self.all or "*" in self.topics or not selected

    @property
    def wants_all_services(self) -> bool:
        """Whether every service is selected, as it is without any selection."""
        selected = self.topics or self.services or self.regex
        return self.all or self.all_services or "*" in self.services or not selected

    @property
    def has_patterns(self) -> bool:
        """Whether topics are selected that are not listed."""
        return self.wants_all_topics or self.wants_all_services or bool(self.regex)

    def listed(self) -> list[str]:
        """Return the topics that are selected by name and awaited, also those of services."""
        topics: set[str] = set()
        if not self.wants_all_topics:
            topics |= {topic for topic in self.topics if self.wants(topic, ())}
        if not self.wants_all_services:
            topics |= {
                service + _SERVICE_EVENT
                for service in self.services
                if self._decide(service, True, service in self.exclude_services)
            }
        return sorted(topics)

    def wants(self, topic: str, types: Sequence[str]) -> bool:
        """Return whether to record a topic that has these types.

        A service is recorded by the topic of its events; patterns are compared with its name.
        """
        if topic.endswith(_SERVICE_EVENT) and any(
            "/srv/" in name and name.endswith("_Event") for name in types
        ):
            service = topic.removesuffix(_SERVICE_EVENT)
            wanted = self.wants_all_services or service in self.services or topic in self.topics
            excluded = service in self.exclude_services or topic in self.exclude_topics
            return self._decide(service, wanted, excluded)
        wanted = topic in self.topics
        if not wanted and not self.include_hidden and "/_" in topic:
            return False
        return self._decide(topic, wanted or self.wants_all_topics, topic in self.exclude_topics)

    def _decide(self, name: str, wanted: bool, excluded: bool) -> bool:
        if excluded or (self.exclude_regex and re.search(self.exclude_regex, name)):
            return False
        return wanted or bool(self.regex and re.search(self.regex, name))
