# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks refuse numbers that they cannot work with; test_readme.py runs them."""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
SCRIPTS = sorted(p.stem for p in FOLDER.glob("*.py") if "at_least(" in p.read_text("utf-8"))


@pytest.mark.parametrize("name", [name for name in SCRIPTS if name not in ("common", "pages")])
@pytest.mark.parametrize("number", ["-1", "nan", "soon"])
def test_senseless_numbers_are_wrong_usage(
    name: str,
    number: str,
    benchmark: Callable[[str], ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    capsys: Any,
) -> None:
    text = (FOLDER / f"{name}.py").read_text("utf-8")
    options = re.findall(r'"(--[\w-]+)",\s+type=at_least', text)
    assert options
    for option in options:
        monkeypatch.setattr(sys, "argv", [name, f"{option}={number}"])
        with pytest.raises(SystemExit, match="2"):
            benchmark(name).main()
        assert re.search(rf"argument (-n/)?(--\w+/)*{option}: ", capsys.readouterr().err)
