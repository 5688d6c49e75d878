# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification: the numbers of a request from recordings, by maximum likelihood."""
