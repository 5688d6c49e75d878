# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Campaigns in folders: the campaign's file, and a Parquet file for each part that is done.

A file appears once it is complete. So a campaign goes on from whatever is there. Parts are computed
by threads, or by the workers of a Dask cluster.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet

from tsobs_ros import __version__
from tsobs_ros.campaign.batches import Columns, compute
from tsobs_ros.campaign.definition import (
    CAMPAIGN,
    Campaign,
    CampaignError,
    load_campaign,
    parse_campaign,
)
from tsobs_ros.campaign.drawing import check
from tsobs_ros.design.file import design_text, load_design
from tsobs_ros.files import write_whole, written_whole

PART = 100
"""Runs in a part: what is computed, sent and written at a time."""

Part: TypeAlias = tuple[int, int]
"""A part's first run, and the run after its last."""

DESIGN, RUNS = "campaign.design.yaml", "runs"
SUMMARY = ("summary.json", "summary.txt")
_IDENTITY = b"tsobs_ros campaign"
_CONNECT_TIMEOUT = 30


def run_campaign(
    campaign: Campaign,
    output: Path,
    *,
    threads: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> Columns:
    """Run a campaign, or what is missing of it, in a folder, and return the columns of its runs.

    The numbers depend neither on where runs are computed, nor by how many, nor on what was done
    before. Runs are computed by threads, as many as cores by default, or by a Dask scheduler's
    workers; `progress` is called with the number of runs that are done since.

    Raises:
        CampaignError: The folder has something else, or the cluster cannot do it.
        TsobsError: A scenario does not fit the design.
    """
    check(campaign)
    if (output / CAMPAIGN).exists():
        if load_campaign(output / CAMPAIGN).identity != campaign.identity:
            raise CampaignError(
                f"{output}: has another campaign, of another design, version or entry; choose "
                "another folder"
            )
    elif there := [output / name for name in (RUNS, *SUMMARY) if (output / name).exists()]:
        raise CampaignError(f"{there[0]}: exists already; choose another folder")
    write_whole(output / DESIGN, design_text(campaign.design), CampaignError)
    write_whole(output / CAMPAIGN, campaign.text(DESIGN), CampaignError)
    runs, folder = campaign.entries.runs, output / RUNS
    parts = [(begin, min(begin + PART, runs)) for begin in range(0, runs, PART)]
    paths = {part: folder / f"{part[0]:08d}.parquet" for part in parts}
    missing = [part for part in parts if _rows(campaign, paths[part]) < part[1] - part[0]]
    progress(runs - sum(end - begin for begin, end in missing))
    if scheduler is None:
        done = _on_threads(campaign, missing, threads or os.cpu_count() or 1)
    else:
        done = _on_cluster(campaign, missing, scheduler)
    for part, columns in done:
        table = pa.table(columns).replace_schema_metadata({_IDENTITY: campaign.identity})
        with written_whole(folder, CampaignError, force=True) as made:
            parquet.write_table(table, made / paths[part].name)
        progress(part[1] - part[0])
    try:
        table = pa.concat_tables(map(parquet.read_table, paths.values())).slice(0, runs)
    except (OSError, pa.ArrowInvalid) as error:
        raise CampaignError(f"{output}: a part cannot be read: {error}") from error
    return {
        name: np.array(column.to_pylist() if pa.types.is_string(column.type) else column)
        for name, column in zip(table.column_names, table.columns, strict=True)
    }


def _rows(campaign: Campaign, part: Path) -> int:
    """Return the number of rows of a part, 0 if it is not there, damaged or another's."""
    try:
        metadata = parquet.read_metadata(part)
    except (OSError, pa.ArrowInvalid):
        return 0
    is_own = (metadata.metadata or {}).get(_IDENTITY) == campaign.identity.encode()
    return int(metadata.num_rows) if is_own else 0


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
    texts = __version__, campaign.text("design"), design_text(campaign.design)
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
    except (dask.KilledWorker, CancelledError, OSError) as error:
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise CampaignError(
            f"{where}: workers or connection were lost: {reason}; the same command goes on with "
            "the runs that are missing"
        ) from error


def _on_worker(version: str, campaign: str, design: str, begin: int, end: int) -> Columns:
    """Return the columns of a part, by a worker that has the package and the texts of files."""
    if version != __version__:
        raise CampaignError(f"a worker has tsobs_ros {__version__}, expected {version}")
    return compute(_campaign(campaign, design), begin, end)


@lru_cache(maxsize=2)
def _campaign(campaign: str, design: str) -> Campaign:
    return Campaign(parse_campaign(campaign, "campaign"), load_design("design", design))
