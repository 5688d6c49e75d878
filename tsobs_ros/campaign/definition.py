# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Campaign files: a design, scenarios for its arm, and ranges from which runs are drawn."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from os import PathLike
from pathlib import Path
from typing import Any

from tsobs_ros import __version__
from tsobs_ros.design.file import checksum, load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import DesignFileError, ModelError, TsobsError
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.schema import decode, encode, naming
from tsobs_ros.settings import changed
from tsobs_ros.simulation.plant import Friction, Mismatch, Payload
from tsobs_ros.yaml_files import read_yaml, yaml_text

FORMAT, VERSION = "tsobs_ros campaign", 1
CAMPAIGN = "campaign.yaml"
_MAX_WEIGHT = 10_000

_HEADER = "# The campaign of this folder's runs, written by `tsobs campaign`.\n"


class CampaignError(TsobsError, RuntimeError):
    """A campaign cannot run, go on or be shown."""


@dataclass(kw_only=True)
class OutputEntries:
    """One output: numbers of its sensor in addition to the design's noise, and its disturbance."""

    sensor: dict[str, float | bool] = field(default_factory=dict)
    disturbance: list[dict[str, Any]] = field(default_factory=list)


@dataclass(kw_only=True)
class ScenarioEntries(OutputEntries):
    """A drawn scenario; `config/campaign.yaml` describes the entries.

    Sensor and disturbance are the first output's. Entries replace the campaign's of the same name.
    """

    uncertainty: float
    initial_state: list[float]
    excitation: dict[str, Any]
    weight: int = 1
    as_designed: bool = False
    noise: float = 1.0
    process_noise: float = 1.0
    outputs: dict[str, OutputEntries] = field(default_factory=dict)
    motor_torque: list[dict[str, Any]] = field(default_factory=list)
    link_torque: list[dict[str, Any]] = field(default_factory=list)
    torque_error: list[dict[str, Any]] = field(default_factory=list)
    friction: Friction = field(default_factory=Friction)
    payload: Payload = field(default_factory=Payload)
    mismatch: Mismatch = field(default_factory=Mismatch)


@dataclass(kw_only=True)
class CampaignEntries:
    """The entries of a campaign file, which `config/campaign.yaml` describes.

    Entries that are drawn are still plain data here.
    """

    design: str = SHIPPED_DESIGN
    observer: dict[str, bool | int | float | str] = field(default_factory=dict)
    runs: int = 1000
    repeats: int = 1
    seed: int = 0
    duration: float = 30.0
    settle_time: float = 5.0
    uncertainty: float | list[float] = 1.0
    initial_state: list[float | list[float]] = field(
        default_factory=lambda: [[-0.3, 0.3], 0.0, [-0.3, 0.3], 0.0]
    )
    excitation: dict[str, Any] = field(default_factory=lambda: {"kind": "sine"})
    scenarios: dict[str, dict[str, Any]] = field(
        default_factory=lambda: {"as_designed": {"as_designed": True}}
    )


@dataclass
class _File:
    campaign: CampaignEntries
    format: str = FORMAT
    version: int = VERSION


@dataclass(frozen=True, eq=False)
class Campaign:
    """A campaign: its entries and its design.

    A run depends only on its number, the entries and the design.

    Raises:
        TsobsError: An entry is out of range, unknown, or does not fit the design.
    """

    entries: CampaignEntries
    design: Design

    def __post_init__(self) -> None:
        entries = self.entries
        _ = self.design.arm_request, self.settings
        for name, least in (("runs", 1), ("repeats", 1), ("seed", 0)):
            if getattr(entries, name) < least:
                raise ModelError(f"{name}: expected at least {least}, got {getattr(entries, name)}")
        if not 0.0 <= entries.settle_time < entries.duration:
            raise ModelError(
                f"duration: expected more than settle_time = {entries.settle_time!r} s, which is "
                f"at least 0 s, got {entries.duration!r}"
            )
        if not self.turns:
            raise ModelError("scenarios: expected at least one")

    @cached_property
    def settings(self) -> ObserverSettings:
        """The settings of the observer."""
        with naming("observer"):
            return changed(ObserverSettings(), self.entries.observer)

    @cached_property
    def estimator(self) -> Estimator:
        """The estimator that observes the runs."""
        return make_estimator(self.design, self.settings)

    @cached_property
    def turns(self) -> Sequence[str]:
        """The scenarios that runs use in turn; those of a larger weight come more often."""
        weights = {name: one.get("weight", 1) for name, one in self.entries.scenarios.items()}
        for name, weight in weights.items():
            if not isinstance(weight, int) or not 1 <= weight <= _MAX_WEIGHT:
                raise ModelError(
                    f"scenarios.{name}.weight: expected a whole number from 1 to {_MAX_WEIGHT}, "
                    f"got {weight!r}"
                )
        # Scenarios alternate, instead of coming in blocks, so that a few runs already cover most.
        rounds = range(max(weights.values(), default=0))
        return [name for turn in rounds for name, weight in weights.items() if weight > turn]

    @cached_property
    def identity(self) -> str:
        """Checksum of everything that decides the numbers of a run."""
        data = encode(self.entries)
        for name in ("runs", "design"):
            del data[name]
        return sha256(json.dumps([__version__, checksum(self.design), data]).encode()).hexdigest()

    def text(self, design: str) -> str:
        """Return the text of the campaign's file, with `design` as its entry `design`."""
        entries = {**encode(self.entries), "design": design}
        return yaml_text(_HEADER, {"format": FORMAT, "version": VERSION, "campaign": entries})

    def with_runs(self, runs: int) -> "Campaign":
        """Return the same campaign with another number of runs."""
        return Campaign(replace(self.entries, runs=runs), self.design)


def load_campaign(path: str | PathLike[str]) -> Campaign:
    """Read a campaign file and its design.

    Raises:
        DesignFileError: A file is missing or malformed; the text names the entry.
        TsobsError: An entry does not fit the design.
    """
    path = Path(path)
    data = read_yaml(path)
    with naming(path):
        file = decode(data, _File)
        if (file.format, file.version) != (FORMAT, VERSION):
            raise DesignFileError(
                f"expected format {FORMAT!r} of version {VERSION}, got {file.format!r} of version "
                f"{file.version!r}"
            )
        name = file.campaign.design
        near = path.parent / name
        return Campaign(file.campaign, load_design(near if near.is_file() else config_path(name)))
