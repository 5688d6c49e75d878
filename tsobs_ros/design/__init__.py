# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Certified gains: the request, its synthesis, the proof and the file. cvxpy is used only here."""
