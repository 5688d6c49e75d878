# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Campaigns in folders: the campaign's file, and a Parquet file for each part that is done.

A file appears only once it is complete, so that a campaign can continue from the existing files.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet

from tsobs_ros.campaign.batches import Columns, compute
from tsobs_ros.campaign.definition import CAMPAIGN, Campaign, CampaignError, load_campaign
from tsobs_ros.campaign.drawing import check
from tsobs_ros.design.file import design_text
from tsobs_ros.files import write_whole, written_whole

PART = 100
"""Number of runs in a part, which is computed and written as a whole."""

DESIGN, RUNS = "campaign.design.yaml", "runs"
SUMMARY = ("summary.json", "summary.txt")
_IDENTITY = b"tsobs_ros campaign"


def run_campaign(
    campaign: Campaign,
    output: Path,
    *,
    threads: int | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> Columns:
    """Run a campaign, or its missing runs, in a folder, and return the columns of its runs.

    The numbers depend neither on the number of threads, by default that of the cores, nor on runs
    that were done before. `progress` is called with the number of runs that were done since its
    last call.

    Raises:
        CampaignError: The folder has other content, or a part cannot be read.
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
    pool, stop = ThreadPoolExecutor(threads or os.cpu_count()), Event()
    try:
        done = pool.map(lambda part: compute(campaign, part[0], part[1], stop.is_set), missing)
        for part, columns in zip(missing, done, strict=True):
            table = pa.table(columns).replace_schema_metadata({_IDENTITY: campaign.identity})
            with written_whole(folder, CampaignError, force=True) as made:
                parquet.write_table(table, made / paths[part].name)
            progress(part[1] - part[0])
    finally:
        stop.set()  # parts that run would take long to their ends
        pool.shutdown(cancel_futures=True)
    try:
        table = pa.concat_tables(map(parquet.read_table, paths.values())).slice(0, runs)
    except (OSError, pa.ArrowInvalid) as error:
        raise CampaignError(f"{output}: a part cannot be read: {error}") from error
    return {
        name: np.array(column.to_pylist() if pa.types.is_string(column.type) else column)
        for name, column in zip(table.column_names, table.columns, strict=True)
    }


def _rows(campaign: Campaign, part: Path) -> int:
    """Return the number of rows of a part, 0 if it is missing, damaged or another campaign's."""
    try:
        metadata = parquet.read_metadata(part)
    except (OSError, pa.ArrowInvalid):
        return 0
    is_own = (metadata.metadata or {}).get(_IDENTITY) == campaign.identity.encode()
    return int(metadata.num_rows) if is_own else 0
