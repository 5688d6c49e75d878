# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the design tests share: the shipped design, read once."""

from pathlib import Path

import pytest

from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.resources import SHIPPED_DESIGN, config_path


@pytest.fixture(scope="session")
def shipped_file() -> Path:
    """The design file in the package's config folder."""
    return config_path(SHIPPED_DESIGN)


@pytest.fixture(scope="session")
def shipped(shipped_file: Path) -> Design:
    """The design that file holds; loading it re-checks its certificate."""
    return load_design(shipped_file)
