# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `observer` node: measurements in, estimates with bounds out at a fixed rate."""

from tsobs_ros.nodes.observer.node import Observer, create

__all__ = ["Observer", "create"]
