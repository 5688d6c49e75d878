# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The compiled core: a C library that uses no ROS, no solver, no clock and no file."""

from importlib import import_module
from pathlib import Path

from tsobs_ros.core.sources import digest
from tsobs_ros.errors import CORE, missing_library

try:
    _built = getattr(import_module(CORE), "SOURCES", None)
except ModuleNotFoundError:
    raise ModuleNotFoundError(missing_library(CORE), name=CORE) from None
_sources = digest(Path(__file__).parent)
# Empty: a core that was built without setup.py, or an installation without sources.
if _built != _sources and _built != "" and _sources:
    raise ModuleNotFoundError(missing_library(CORE), name=CORE)
