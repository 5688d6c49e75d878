# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The README's Python runs, and what it names is there."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsobs_ros.cli.main import main

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_python_of_the_readme_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(code, "README.md", "exec"), names)
    assert np.isfinite(names["estimates"].state).all()
    assert capsys.readouterr().out


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\]\(([^)#:]+)\)", README))))
def test_what_the_readme_points_to_exists(target: str) -> None:
    assert (ROOT / target).exists()


@pytest.mark.parametrize("word", re.findall(r"^    tsobs (\w+)  ", README, re.MULTILINE))
def test_the_commands_of_the_readme_exist(word: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main([word, "--help"])
    assert ended.value.code == 0
