# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder's parameters, and the selection of topics by the rules of `ros2 bag record`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tsobs_ros.bag.recording import Recording, SnapshotBuffer
from tsobs_ros.nodes.parameters import SelectingParameters
from tsobs_ros.settings import live_setting, setting

_MIB = 2**20
_SERVICE_EVENT = "/_service_event"


@dataclass(frozen=True)
class RecorderParameters(SelectingParameters):
    """The node's parameters; `config/recorder.yaml` shows them with their reasons."""

    topics: tuple[str, ...] = setting(
        (), "Topics to record, also hidden ones; '*' for all that are not"
    )
    services: tuple[str, ...] = setting((), "Services to record the events of; '*' for all")
    exclude_services: tuple[str, ...] = setting((), "Services not to record")
    include_hidden: bool = setting(False, "Let 'regex' and no selection find hidden topics too")
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
    def has_patterns(self) -> bool:
        """Whether topics are selected that are not listed."""
        return self._all_topics or self._all_services or bool(self.regex)

    def listed(self) -> list[str]:
        """Return the topics that are selected by name and awaited, also those of services."""
        topics: set[str] = set()
        if not self._all_topics:
            topics |= {topic for topic in self.topics if self.wants(topic, ())}
        if not self._all_services:
            topics |= {
                service + _SERVICE_EVENT
                for service in self.services
                if self.takes(service, True, service in self.exclude_services)
            }
        return sorted(topics)

    def wants(self, topic: str, types: Sequence[str]) -> bool:
        """Return whether to record a topic that has these types.

        A service is recorded by the topic of its events; patterns are compared with its name.
        """
        is_listed, is_excluded = topic in self.topics, topic in self.exclude_topics
        if topic.endswith(_SERVICE_EVENT) and any(
            "/srv/" in name and name.endswith("_Event") for name in types
        ):
            service = topic.removesuffix(_SERVICE_EVENT)
            is_listed |= self._all_services or service in self.services
            return self.takes(service, is_listed, is_excluded or service in self.exclude_services)
        if not is_listed and not self.include_hidden and "/_" in topic:
            return False
        return self.takes(topic, is_listed or self._all_topics, is_excluded)

    @property
    def _all_topics(self) -> bool:
        return "*" in self.topics or self._selects_nothing

    @property
    def _all_services(self) -> bool:
        return "*" in self.services or self._selects_nothing

    @property
    def _selects_nothing(self) -> bool:
        return not (self.topics or self.services or self.regex)
