# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hostile files are read or refused with an error; `benchmarks/fuzz.py` tries many more."""

import sys
from pathlib import Path
from types import ModuleType

import pytest

INPUTS = 150


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    """Return the benchmark, which is no package and not installed."""
    folder = str(Path(__file__).resolve().parents[1] / "benchmarks")
    sys.path.insert(0, folder)
    try:
        import fuzz
    finally:
        sys.path.remove(folder)
    return fuzz


@pytest.fixture(scope="module")
def targets(bench: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> dict:
    return bench.targets(tmp_path_factory.mktemp("good"))


@pytest.mark.parametrize(
    "name", ["design", "request", "ts", "metadata", "bag", "recovery", "message", "log"]
)
def test_hostile_files_are_read_or_refused(
    name: str, bench: ModuleType, targets: dict, tmp_path: Path
) -> None:
    outcome = bench.fuzz(name, targets[name], INPUTS, 1, tmp_path, tmp_path / "failed")

    assert set(outcome.results) == {"read", "refused"}, outcome.failures
