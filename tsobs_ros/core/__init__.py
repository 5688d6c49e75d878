# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The compiled core: a C library that knows no ROS, no solver, no clock and no file."""

from importlib import import_module

from tsobs_ros.errors import CORE, missing_library

try:
    import_module(CORE)
except ModuleNotFoundError:
    raise ModuleNotFoundError(missing_library(CORE), name=CORE) from None
