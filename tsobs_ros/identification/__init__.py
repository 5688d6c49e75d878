# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification of the numbers of a request from recordings, by maximum likelihood."""
