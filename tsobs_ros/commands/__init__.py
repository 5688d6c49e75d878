# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The words of the `tsobs` command: one module each, with its options and what it does."""
