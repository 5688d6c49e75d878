# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Config files are found in every layout the package can be installed in, without ROS."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tsobs_ros.resources import ResourceError, config_path

ROOT = Path(__file__).resolve().parents[1]
SHARE = "share/tsobs_ros/config"
PRINT = "from tsobs_ros.resources import config_path; print(config_path('some.yaml'))"


def config(folder: Path) -> str:
    folder.mkdir(parents=True)
    (folder / "some.yaml").write_text("some: thing\n")
    return str(folder / "some.yaml")


@pytest.mark.parametrize("site", ["lib/python3.12/site-packages", "."])
def test_files_are_those_nearest_to_the_code(tmp_path: Path, site: str) -> None:
    """Of colcon or pip, and of `pip --target`: of a checkout, its prefix, and of ament."""
    prefix, other = tmp_path / "prefix", tmp_path / "other"
    code = prefix / site / "tsobs_ros"
    code.mkdir(parents=True)
    for name in ("__init__.py", "errors.py", "resources.py"):
        shutil.copy(ROOT / "tsobs_ros" / name, code)

    def found() -> str:
        environment = {"PYTHONPATH": str(code.parent), "AMENT_PREFIX_PATH": f"/none:{other}"}
        command = [sys.executable, "-P", "-c", PRINT]
        return subprocess.check_output(command, env={**os.environ, **environment}, text=True)

    for folder in (other / SHARE, prefix / SHARE, code.parent / "config"):
        (code.parent / "package.xml").touch()
        path = config(folder)
        assert found() == f"{path}\n"


def test_a_missing_file_is_an_error_that_names_the_others() -> None:
    with pytest.raises(ResourceError, match=r"no config file 'none\.yaml' in .*observer\.yaml"):
        config_path("none.yaml")
