# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The visualizer node's ROS parameters."""

from dataclasses import dataclass

from tsobs_ros.nodes.managed import ManagedParameters
from tsobs_ros.settings import live_setting, setting


@dataclass(frozen=True)
class VisualizerParameters(ManagedParameters):
    """All parameters of the visualizer node."""

    observer: str = setting("observer", "Name of the observer")
    rate: float = setting(
        20.0, "Rate at which markers are published", unit="Hz", minimum=1.0, maximum=100.0
    )
    frame_id: str = live_setting("world", "Frame of the markers: the fixed frame of the view")
    link_length: float = live_setting(
        1.0, "Length of a drawn link", unit="m", minimum=0.1, maximum=100.0
    )
    spacing: float = live_setting(
        3.0, "Distance between arms, which stand along x", unit="m", minimum=0.0, maximum=1e3
    )
    sigmas: float = live_setting(
        3.0, "Half width of the drawn bound, in 1 sigma bounds", minimum=0.1, maximum=100.0
    )
    opacity: float = live_setting(0.45, "Opacity of the estimate", minimum=0.05, maximum=1.0)
    max_age: float = live_setting(
        1.0, "Age of messages from which on they are not drawn", unit="s", minimum=0.1, maximum=60.0
    )
