# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The folder of a campaign: what it is, a Parquet file for each part that is done, the summary.

A file appears once it is complete. So a campaign goes on from whatever is there.
"""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet

from tsobs_ros.campaign.definition import Campaign, CampaignError, load_campaign
from tsobs_ros.campaign.drawing import check
from tsobs_ros.campaign.execution import Columns, Part, on_cluster, on_threads
from tsobs_ros.errors import DesignFileError
from tsobs_ros.files import written_whole

PART = 100
"""Runs in a part: what is computed, sent and written at a time."""

CAMPAIGN, DESIGN, RUNS = "campaign.yaml", "campaign.design.yaml", "runs"
SUMMARY = ("summary.json", "summary.txt")
_IDENTITY = b"tsobs_ros campaign"


def run_campaign(
    campaign: Campaign,
    output: Path,
    *,
    threads: int | None = None,
    scheduler: str | None = None,
    force: bool = False,
    progress: Callable[[int], object] = lambda _: None,
) -> "CampaignFolder":
    """Run a campaign, or what is missing of it, and return its folder.

    The numbers depend neither on where runs are computed, nor by how many, nor on what was done
    before.

    Args:
        campaign: The campaign.
        output: Its folder; see `CampaignFolder.make`.
        threads: Of this machine; the number of its cores if None.
        scheduler: Address of a Dask scheduler, to compute there.
        force: Whether to replace another campaign's files.
        progress: Called with the number of runs that are done since.

    Raises:
        CampaignError: The folder has something else, or the cluster cannot do it.
        TsobsError: A scenario does not fit the design.
    """
    check(campaign)
    folder = CampaignFolder.make(output, campaign, force=force)
    missing = folder.missing()
    progress(campaign.entries.runs - sum(end - begin for begin, end in missing))
    if scheduler is None:
        done = on_threads(campaign, missing, threads or os.cpu_count() or 1)
    else:
        done = on_cluster(campaign, missing, scheduler)
    for (begin, end), columns in done:
        folder.write(begin, columns)
        progress(end - begin)
    return folder


@dataclass(frozen=True)
class CampaignFolder:
    """The folder of a campaign; what is in it already is kept.

    Attributes:
        path: The folder.
        campaign: The campaign.
    """

    path: Path
    campaign: Campaign

    @classmethod
    def open(cls, path: Path) -> "CampaignFolder":
        """Return a folder that has a campaign.

        Raises:
            CampaignError: It has none.
            DesignFileError: One of its files is malformed.
        """
        if not (path / CAMPAIGN).is_file():
            raise CampaignError(f"{path}: no campaign, expected {CAMPAIGN} in it")
        return cls(path, load_campaign(path / CAMPAIGN))

    @classmethod
    def make(cls, path: Path, campaign: Campaign, *, force: bool = False) -> "CampaignFolder":
        """Return a folder for a campaign: a new one, or one that has the same campaign.

        Args:
            path: The folder.
            campaign: The campaign; it may have more runs than the folder.
            force: Whether to replace another campaign's files.

        Raises:
            CampaignError: The folder has another campaign, other files, or more runs.
        """
        folder = cls(path, campaign)
        if path.exists() and not path.is_dir():
            raise CampaignError(f"{path}: expected a folder")
        begun = (path / CAMPAIGN).exists()
        if not begun and path.is_dir() and any(map(_is_foreign, path.iterdir())):
            raise CampaignError(f"{path}: has other files than a campaign's; choose another folder")
        if force:
            for own in [*(path / RUNS).glob("*.parquet"), *map(path.joinpath, SUMMARY)]:
                own.unlink(missing_ok=True)
        elif begun:
            folder._require_same()
        (path / RUNS).mkdir(parents=True, exist_ok=True)
        _write(path / DESIGN, campaign.file.text.encode())
        _write(path / CAMPAIGN, campaign.text(DESIGN).encode())
        return folder

    def missing(self) -> list[Part]:
        """Return the parts that are not done, each as its first run and the one after its last."""
        runs = self.campaign.entries.runs
        parts = [(begin, min(begin + PART, runs)) for begin in range(0, runs, PART)]
        return [part for part in parts if self._rows(part[0]) < part[1] - part[0]]

    def write(self, begin: int, columns: Columns) -> None:
        """Write a part.

        Raises:
            CampaignError: It cannot be written.
        """
        sink, table = pa.BufferOutputStream(), pa.table(columns)
        parquet.write_table(table.replace_schema_metadata({_IDENTITY: self._identity}), sink)
        _write(self._part(begin), sink.getvalue().to_pybytes())

    def read(self) -> Columns:
        """Return the columns of all runs that are there, in the order of their numbers.

        Raises:
            CampaignError: There are none, or a file cannot be read.
        """
        parts = map(self._part, range(0, self.campaign.entries.runs, PART))
        paths = [path for path in parts if path.exists()]
        if not paths:
            raise CampaignError(f"{self.path}: no runs yet")
        try:
            table = pa.concat_tables([parquet.read_table(path) for path in paths])
        except (OSError, pa.ArrowInvalid) as error:
            raise CampaignError(f"{self.path}: a part cannot be read: {error}") from error
        return {
            name: np.array(column.to_pylist() if pa.types.is_string(column.type) else column)
            for name, column in zip(table.column_names, table.columns, strict=True)
        }

    def write_summary(self, texts: Iterable[str]) -> None:
        """Write the summary's files, in the order of `SUMMARY`."""
        for name, text in zip(SUMMARY, texts, strict=True):
            _write(self.path / name, text.encode())

    @property
    def _identity(self) -> bytes:
        return self.campaign.identity.encode()

    def _part(self, begin: int) -> Path:
        return self.path / RUNS / f"{begin:08d}.parquet"

    def _rows(self, begin: int) -> int:
        """Return the number of rows of a part, 0 if it is not there or damaged."""
        try:
            metadata = parquet.read_metadata(self._part(begin))
        except (OSError, pa.ArrowInvalid):
            return 0
        is_own = (metadata.metadata or {}).get(_IDENTITY) == self._identity
        return int(metadata.num_rows) if is_own else 0

    def _require_same(self) -> None:
        try:
            there = load_campaign(self.path / CAMPAIGN)
        except DesignFileError as error:
            raise CampaignError(f"{error}; --force replaces the campaign") from error
        if there.identity != self.campaign.identity:
            raise CampaignError(
                f"{self.path}: has another campaign, of another design, version or entry; --force "
                "replaces it"
            )
        begins = range(0, there.entries.runs, PART)
        done = max((begin + rows for begin in begins if (rows := self._rows(begin))), default=0)
        if self.campaign.entries.runs < done:
            raise CampaignError(
                f"{self.path}: has {done} runs already, expected at least as many, "
                f"got {self.campaign.entries.runs}"
            )


def _is_foreign(path: Path) -> bool:
    """Return whether a file or folder is none of what a campaign writes before it is begun."""
    return path.name not in (DESIGN, RUNS) and path.suffix != ".partial"


def _write(path: Path, content: bytes) -> None:
    with written_whole(path.parent, CampaignError, force=True) as folder:
        (folder / path.name).write_bytes(content)
