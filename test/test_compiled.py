# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiled functions and their cache: found again, never out of date, never in the way."""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "tsobs_ros"
INNER = """
from tsobs_ros.compiled import compiled

@compiled
def total(values):
    total = 0.0
    for value in values:
        total += value
    return total
"""
OUTER = """
import resource, sys
import numpy as np
import inner
from tsobs_ros.compiled import compiled, compiled_nogil, inlined

@inlined
def between(values):
    return inner.total(values)

@compiled_nogil
def doubled(values):
    return 2.0 * between(values)

if "full" in sys.argv:
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
answer = doubled(np.arange(5.0))
found = sum(sum(each.stats.cache_hits.values()) for each in (inner.total, doubled))
print(answer, found, inner.total(np.arange(3, dtype=np.int64)))
"""


class Answer(NamedTuple):
    """What a process has computed, and how many functions it found in the cache."""

    value: float
    found: int


class Program:
    """A copy of what compiles, with a module whose compiled function calls into another one."""

    def __init__(self, folder: Path) -> None:
        self.package = folder / "tsobs_ros"
        self.package.mkdir()
        for name in ("__init__.py", "compiled.py"):
            shutil.copy(PACKAGE / name, self.package)
        self.inner, self.outer = folder / "inner.py", folder / "outer.py"
        self.inner.write_text(INNER)
        self.outer.write_text(OUTER)
        self.home = folder / "home"
        self.home.mkdir()

    @property
    def beside(self) -> Path:
        """Where the cache is if it can be."""
        return self.package / "__pycache__" / "compiled"

    def start(
        self, *arguments: str, environment: Mapping[str, str] | None = None
    ) -> subprocess.Popen[str]:
        """Start it in a process of its own."""
        clean = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "PYTHONPATH")}
        return subprocess.Popen(
            [sys.executable, self.outer, *arguments],
            env={**clean, "HOME": str(self.home), **(environment or {})},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, *arguments: str, environment: Mapping[str, str] | None = None) -> Answer:
        """Run it and return its answer."""
        return answer_of(self.start(*arguments, environment=environment))


def answer_of(process: subprocess.Popen[str]) -> Answer:
    out, err = process.communicate(timeout=120.0)
    assert process.returncode == 0, err
    assert not err
    value, found, _ = out.split()
    return Answer(float(value), int(found))


@pytest.fixture
def program(tmp_path: Path) -> Program:
    return Program(tmp_path)


def indexes(folder: Path) -> set[Path]:
    return set(folder.rglob("*.nbi"))


def test_the_cache_is_beside_the_package_and_found_until_a_called_file_changes(
    program: Program,
) -> None:
    assert program.run() == Answer(20.0, 0)
    before = indexes(program.beside)
    assert len(before) == 3
    assert program.run() == Answer(20.0, 1)
    assert indexes(program.beside) == before
    assert not list(program.home.iterdir())

    program.inner.write_text(INNER.replace("total = 0.0", "total = 1.0"))

    assert program.run() == Answer(22.0, 0)
    assert len(indexes(program.beside)) == 3


def test_without_a_folder_to_write_to_the_next_one_is_taken(
    program: Program, tmp_path: Path
) -> None:
    no_folder = tmp_path / "file"
    no_folder.touch()
    chosen, user = tmp_path / "chosen", tmp_path / "user"
    environment = {
        "NUMBA_CACHE_DIR": str(chosen),
        "XDG_CACHE_HOME": str(user),
        "HOME": str(program.home),
    }
    for key, folder in (
        ("NUMBA_CACHE_DIR", chosen),
        (None, program.beside),
        ("XDG_CACHE_HOME", user),
        ("HOME", program.home),
    ):
        assert program.run(environment=environment) == Answer(20.0, 0)
        assert len(indexes(folder)) == 3
        shutil.rmtree(folder)
        if key is None:
            shutil.rmtree(program.beside.parent)
            program.beside.parent.touch()
        else:
            environment[key] = str(no_folder)

    assert program.run(environment=environment) == Answer(20.0, 0)


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def make_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def test_a_damaged_cache_is_replaced(program: Program) -> None:
    program.run()
    files = sorted(program.beside.rglob("*.nb[ic]"))
    assert len(files) == 6
    # Of each function another one of index and data.
    for path, damage in zip(files, [cut_off, make_folder, make_folder] * 2, strict=True):
        damage(path)

    assert program.run() == Answer(20.0, 0)
    program.run()
    assert program.run() == Answer(20.0, 1)


def test_a_full_disk_only_leaves_nothing_for_the_next_process(program: Program) -> None:
    assert program.run("full") == Answer(20.0, 0)
    assert program.run() == Answer(20.0, 0)


def test_processes_that_compile_at_once_agree(program: Program) -> None:
    processes = [program.start() for _ in range(3)]

    assert [answer_of(process).value for process in processes] == [20.0] * 3
    assert program.run() == Answer(20.0, 1)


def test_the_interpreter_runs_the_same_functions(program: Program) -> None:
    program.outer.write_text(OUTER.replace("each.stats.cache_hits", "{type(each): 0}"))

    assert program.run(environment={"NUMBA_DISABLE_JIT": "1"}) == Answer(20.0, 0)
    assert not program.beside.exists()
