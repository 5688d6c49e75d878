# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Campaigns of short runs, with all that scenarios may have."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tsobs_ros.campaign.definition import Campaign, load_campaign

SHORT: dict[str, Any] = {
    "runs": 250,
    "repeats": 3,
    "seed": 3,
    "duration": 1.0,
    "settle_time": 0.3,
    "scenarios": {
        "as_designed": {"as_designed": True, "weight": 2},
        "bias": {
            "disturbance": [{"kind": "bias_step", "amplitude": [-0.3, 0.3], "start": [0.2, 0.8]}]
        },
        "dropouts": {"sensor": {"dropout_interval": 0.3, "dropout_duration": [0.1, 0.2]}},
        "contact": {"link_torque": [{"kind": "bias_step", "amplitude": [0.5, 2.0]}]},
    },
}


Write = Callable[..., Path]


@pytest.fixture(scope="session")
def write(tmp_path_factory: pytest.TempPathFactory) -> Write:
    """Write a file of a campaign of three parts, with some other entries."""

    def write(**entries: Any) -> Path:
        data = {"format": "tsobs_ros campaign", "version": 1, "campaign": {**SHORT, **entries}}
        path = tmp_path_factory.mktemp("file") / "campaign.yaml"
        path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
        return path

    return write


@pytest.fixture(scope="session")
def both_encoders() -> Path:
    """A design file of an arm with an encoder on each side, and a contact."""
    return Path(__file__).resolve().parents[1] / "estimation/data/both_encoders.design.yaml"


@pytest.fixture(scope="session")
def short_file(write: Write) -> Path:
    """The file of a campaign of three parts."""
    return write()


@pytest.fixture(scope="session")
def short(short_file: Path) -> Campaign:
    """That campaign."""
    return load_campaign(short_file)
