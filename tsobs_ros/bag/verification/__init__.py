# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Checking a bag against the format, rule by rule: folder, files, content, summary."""

from tsobs_ros.bag.verification.bag import Verification, verify
from tsobs_ros.bag.verification.findings import Finding

__all__ = ["Finding", "Verification", "verify"]
