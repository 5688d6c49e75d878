# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hostile files are read or refused with an error; `benchmarks/fuzz.py` tries many more.

And bags that are made to cost much stay in the bounds of docs/security.md;
`benchmarks/fuzz_bounds.py` runs all commands on all of them.
"""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

INPUTS = 60


@pytest.fixture(scope="module")
def bench(benchmark: Callable[[str], ModuleType]) -> ModuleType:
    return benchmark("fuzz")


@pytest.mark.parametrize(
    "name", ["design", "request", "ts", "metadata", "bag", "recovery", "message", "log"]
)
def test_hostile_files_are_read_or_refused(name: str, bench: ModuleType, tmp_path: Path) -> None:
    (good := tmp_path / "good").mkdir()
    (folder := tmp_path / "read").mkdir()

    outcome = bench.fuzz(name, bench.TARGETS[name](good), INPUTS, 1, folder, tmp_path / "failed")

    assert set(outcome.results) == {"read", "refused"}, outcome.failures


def test_hostile_samples_and_exports_are_refused_or_stepped(
    benchmark: Callable[[str], ModuleType],
) -> None:
    results, _ = benchmark("fuzz_core").fuzz(150, 1, lambda text: None)

    assert {"refused", "opened", "stepped", "stepped, refused in part"} == set(results)


@pytest.mark.parametrize(
    ("name", "command"),
    [
        pytest.param("metadata: 80 MB", "read", marks=pytest.mark.slow),
        ("metadata: base 60", "verify"),
        ("metadata: pipe", "info"),
        ("metadata: device", "recover"),
        pytest.param("alikes: wrapped chunks", "recover", marks=pytest.mark.slow),
        pytest.param("bombs: zstd, messages", "verify", marks=pytest.mark.slow),
        ("bombs: lz4, states little", "recover"),
        ("sparse: 20 GB, chunk", "recover"),
        ("summary: one chunk", "read"),
        pytest.param("summary: channels", "read", marks=pytest.mark.slow),
        pytest.param("many chunks that overlap", "read", marks=pytest.mark.slow),
        ("pipe", "info"),
        ("pipe", "recover"),
        ("device", "read"),
        ("loop of links", "verify"),
    ],
)
def test_no_bag_costs_more_than_is_stated(
    name: str, command: str, benchmark: Callable[[str], ModuleType], tmp_path: Path
) -> None:
    bounds, bags = benchmark("fuzz_bounds"), benchmark("fuzz_bags")
    bags.BAGS[name](tmp_path)
    (file,) = tmp_path.iterdir()
    bag = tmp_path if file.name == "metadata.yaml" else file

    # A process with more processor time is killed; other processes may slow it down threefold.
    _, memory, code, text = bounds.run(command, bag, patience=3.0 * bounds.seconds_of(file))

    assert code in (0, 1), text
    assert memory < bounds.MAX_MEMORY
