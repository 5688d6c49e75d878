# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Getting back what a damaged bag still holds: scan, survey, destinations, harvest, new bag."""

from tsobs_ros.bag.recovery.bag import recover
from tsobs_ros.bag.recovery.report import DamagedPart, FileRecovery, Recovery

__all__ = ["DamagedPart", "FileRecovery", "Recovery", "recover"]
