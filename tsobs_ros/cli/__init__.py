# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `tsobs` command: `main` has the parser, and one module holds each sub-command."""
