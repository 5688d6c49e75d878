# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the design tests share."""

import pytest

from tsobs_ros.design.record import Design


@pytest.fixture(scope="session")
def shipped(design: Design) -> Design:
    """The shipped design, by what distinguishes it here."""
    return design
