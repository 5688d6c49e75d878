# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hostile files are read or refused with an error; `benchmarks/fuzz.py` tries many more."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

INPUTS = 150


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
