# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The folder of a campaign: its file, a Parquet file for each part that is done, the summary.

A file appears once it is complete. So a campaign goes on from whatever is there. Parts are computed
by threads, or by the workers of a Dask cluster.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet

from tsobs_ros import __version__
from tsobs_ros.campaign.batches import Columns, compute
from tsobs_ros.campaign.definition import Campaign, CampaignError, load_campaign, parse_campaign
from tsobs_ros.campaign.drawing import check
from tsobs_ros.design.file import load_design_file
from tsobs_ros.errors import DesignFileError
from tsobs_ros.files import written_whole

PART = 100
"""Runs in a part: what is computed, sent and written at a time."""

Part: TypeAlias = tuple[int, int]
"""A part's first run, and the run after its last."""

CAMPAIGN, DESIGN, RUNS = "campaign.yaml", "campaign.design.yaml", "runs"
SUMMARY = ("summary.json", "summary.txt")
_IDENTITY = b"tsobs_ros campaign"
_CONNECT_TIMEOUT = 30


@dataclass(frozen=True)
class CampaignFolder:
    """The folder of a campaign."""

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

    def begin(self, *, force: bool) -> None:
        """Write what the campaign is, and go on if that is there already.

        Raises:
            CampaignError: The folder has another campaign, files of a campaign's names, or more
                runs.
        """
        runs, summary = self.path / RUNS, [self.path / name for name in SUMMARY]
        if force:
            for own in [*runs.glob("*.parquet"), *summary]:
                own.unlink(missing_ok=True)
        elif (self.path / CAMPAIGN).exists():
            self._require_same()
        elif there := [str(path) for path in (runs, *summary) if path.exists()]:
            raise CampaignError(f"{there[0]}: exists already; choose another folder")
        with written_whole(self.path, CampaignError, force=True) as folder:
            (folder / DESIGN).write_text(self.campaign.file.text, encoding="utf-8")
            (folder / CAMPAIGN).write_text(self.campaign.text(DESIGN), encoding="utf-8")

    def missing(self) -> list[Part]:
        """Return the parts that are not done."""
        runs = self.campaign.entries.runs
        parts = [(begin, min(begin + PART, runs)) for begin in range(0, runs, PART)]
        return [part for part in parts if self._rows(part[0]) < part[1] - part[0]]

    def write(self, begin: int, columns: Columns) -> None:
        """Write a part.

        Raises:
            CampaignError: It cannot be written.
        """
        table = pa.table(columns).replace_schema_metadata({_IDENTITY: self.campaign.identity})
        with written_whole(self.path / RUNS, CampaignError, force=True) as folder:
            parquet.write_table(table, folder / self._part(begin).name)

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
        with written_whole(self.path, CampaignError, force=True) as folder:
            for name, text in zip(SUMMARY, texts, strict=True):
                (folder / name).write_text(text, encoding="utf-8")

    def _part(self, begin: int) -> Path:
        return self.path / RUNS / f"{begin:08d}.parquet"

    def _rows(self, begin: int) -> int:
        """Return the number of rows of a part, 0 if it is not there, damaged or another's."""
        try:
            metadata = parquet.read_metadata(self._part(begin))
        except (OSError, pa.ArrowInvalid):
            return 0
        is_own = (metadata.metadata or {}).get(_IDENTITY) == self.campaign.identity.encode()
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


def run_campaign(
    campaign: Campaign,
    output: Path,
    *,
    threads: int | None = None,
    scheduler: str | None = None,
    force: bool = False,
    progress: Callable[[int], object] = lambda _: None,
) -> CampaignFolder:
    """Run a campaign, or what is missing of it, and return its folder.

    The numbers depend neither on where runs are computed, nor by how many, nor on what was done
    before. Runs are computed by threads, as many as cores by default, or by a Dask scheduler's
    workers; `progress` is called with the number of runs that are done since.

    Raises:
        CampaignError: The folder has something else, or the cluster cannot do it.
        TsobsError: A scenario does not fit the design.
    """
    check(campaign)
    folder = CampaignFolder(output, campaign)
    folder.begin(force=force)
    missing = folder.missing()
    progress(campaign.entries.runs - sum(end - begin for begin, end in missing))
    if scheduler is None:
        done = _on_threads(campaign, missing, threads or os.cpu_count() or 1)
    else:
        done = _on_cluster(campaign, missing, scheduler)
    for (begin, end), columns in done:
        folder.write(begin, columns)
        progress(end - begin)
    return folder


def _on_threads(
    campaign: Campaign, parts: list[Part], count: int
) -> Iterator[tuple[Part, Columns]]:
    pool = ThreadPoolExecutor(count)
    try:
        yield from zip(parts, pool.map(lambda part: compute(campaign, *part), parts), strict=True)
    finally:
        pool.shutdown(cancel_futures=True)


def _on_cluster(
    campaign: Campaign, parts: list[Part], scheduler: str
) -> Iterator[tuple[Part, Columns]]:
    # Slow to import, and for clusters only.
    import distributed

    dask: Any = distributed  # without types
    texts = __version__, campaign.text("design"), campaign.file.text
    where = f"scheduler {scheduler}"
    try:
        client = dask.Client(scheduler, timeout=_CONNECT_TIMEOUT)
    except (OSError, ValueError) as error:
        raise CampaignError(f"{where}: cannot be reached: {error}") from error
    try:
        with client:
            futures = {
                client.submit(_on_worker, *texts, *part, pure=False, retries=0): part
                for part in parts
            }
            for future in dask.as_completed(futures):
                yield futures[future], future.result()
                future.release()
    except dask.KilledWorker as error:
        raise CampaignError(f"{where}: workers died again and again: {error}") from error
    except (CancelledError, OSError) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise CampaignError(
            f"{where}: the connection was lost: {reason}; the same command goes on with the runs "
            "that are missing"
        ) from error


def _on_worker(version: str, campaign: str, design: str, begin: int, end: int) -> Columns:
    """Return the columns of a part, by a worker that has the package and the texts of files."""
    if version != __version__:
        raise CampaignError(f"a worker has tsobs_ros {__version__}, expected {version}")
    return compute(_campaign(campaign, design), begin, end)


@lru_cache(maxsize=2)
def _campaign(campaign: str, design: str) -> Campaign:
    return Campaign(parse_campaign(campaign, "campaign"), load_design_file("design", design))
