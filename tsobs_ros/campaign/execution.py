# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the parts of a campaign are computed: threads of this machine, or a Dask cluster."""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tsobs_ros import __version__
from tsobs_ros.campaign.definition import Campaign, CampaignError
from tsobs_ros.campaign.drawing import check
from tsobs_ros.campaign.folder import CampaignFolder
from tsobs_ros.campaign.runs import Columns, carry_out, compute

Part = tuple[int, int]
"""A part's first run, and the run after its last."""

_CONNECT_TIMEOUT = 30


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
    done: Iterator[tuple[Part, Columns]]
    if scheduler is None:
        done = _on_threads(campaign, missing, threads or os.cpu_count() or 1)
    else:
        done = _on_cluster(campaign, missing, scheduler)
    for (begin, end), columns in done:
        folder.write(begin, columns)
        progress(end - begin)
    return folder


def _on_threads(
    campaign: Campaign, parts: Sequence[Part], count: int
) -> Iterator[tuple[Part, Columns]]:
    pool = ThreadPoolExecutor(count)
    waiting: deque[tuple[Part, Future[Columns]]] = deque()
    try:
        for part in parts:
            waiting.append((part, pool.submit(compute, campaign, *part)))
            while len(waiting) > 2 * count or (part is parts[-1] and waiting):
                first, future = waiting.popleft()
                yield first, future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _on_cluster(
    campaign: Campaign, parts: Sequence[Part], scheduler: str
) -> Iterator[tuple[Part, Columns]]:
    # Slow to import, and for clusters only.
    import distributed

    dask: Any = distributed  # without types
    try:
        client = dask.Client(scheduler, timeout=_CONNECT_TIMEOUT)
    except (OSError, ValueError) as error:
        raise CampaignError(f"scheduler {scheduler}: cannot be reached: {error}") from error
    texts = __version__, campaign.text("design"), campaign.file.text
    try:
        with client:
            futures = {
                client.submit(carry_out, *texts, *part, pure=False, retries=0): part
                for part in parts
            }
            for future in dask.as_completed(futures):
                try:
                    columns = future.result()
                except dask.KilledWorker as error:
                    raise CampaignError(
                        f"scheduler {scheduler}: workers died again and again at runs from "
                        f"{futures[future][0]}: {error}"
                    ) from error
                yield futures[future], columns
                future.release()
    except (CancelledError, OSError) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise CampaignError(
            f"scheduler {scheduler}: the connection was lost: {reason}; the same command goes on "
            "with the runs that are missing"
        ) from error
