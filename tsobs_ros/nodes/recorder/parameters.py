# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder's parameters."""

from dataclasses import dataclass

from tsobs_ros.nodes.parameters import SelectingParameters
from tsobs_ros.settings import live_setting, setting


@dataclass(frozen=True)
class RecorderParameters(SelectingParameters):
    """The node's parameters; `config/recorder.yaml` shows them with their reasons."""

    topics: tuple[str, ...] = setting(
        (), "Topics to record; without any selection all that are not hidden"
    )
    output: str = setting("", "Folder of the bag, which must not exist; empty for a dated name")
    compression: str = setting("zstd", "Compression of the chunks", choices=("none", "lz4", "zstd"))
    max_bag_size: int = setting(
        0, "Size at which a file is followed by another; 0: never", unit="bytes", minimum=0
    )
    max_bag_duration: float = setting(
        0.0, "Time after which a file is followed by another; 0: never", unit="s", minimum=0
    )
    flush_period: float = setting(
        0.5, "Age from which messages survive a kill", unit="s", minimum=0.01, maximum=10
    )
    sync_period: float = setting(
        5.0, "Age from which they survive a power cut", unit="s", minimum=0.1
    )
    queue_depth: int = setting(
        5000, "Messages of a topic that may wait to be drained", minimum=1, maximum=5000
    )
    minimum_free_disk: int = live_setting(
        256, "Free disk space at which recording ends", unit="MiB", minimum=0
    )

    def wants(self, topic: str) -> bool:
        """Return whether to record a topic by its full name."""
        return self.takes(topic, by_default="/_" not in topic)
