# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The container: records, chunks, indexes and messages of MCAP files, whoever wrote them."""
