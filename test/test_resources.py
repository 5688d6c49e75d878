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
PRINT = "from tsobs_ros.resources import config_path; print(config_path('some.yaml'))"


def install(location: Path) -> None:
    """Copy the modules in question to a site folder."""
    (location / "tsobs_ros").mkdir(parents=True)
    for name in ("__init__.py", "errors.py", "resources.py"):
        shutil.copy(ROOT / "tsobs_ros" / name, location / "tsobs_ros")


def config(folder: Path) -> str:
    folder.mkdir(parents=True)
    path = folder / "some.yaml"
    path.write_text("some: thing\n")
    return str(path)


def found(site: Path, **environment: str) -> str:
    return subprocess.check_output(
        [sys.executable, "-P", "-c", PRINT],
        env={**os.environ, "PYTHONPATH": str(site), **environment},
        text=True,
    ).strip()


@pytest.mark.parametrize(
    "site",
    ["lib/python3.12/site-packages", "."],
    ids=["colcon or pip", "pip --target"],
)
def test_the_prefix_that_holds_the_code_is_searched(tmp_path: Path, site: str) -> None:
    install(tmp_path / "prefix" / site)
    path = config(tmp_path / "prefix" / "share" / "tsobs_ros" / "config")
    config(tmp_path / "other" / "share" / "tsobs_ros" / "config")  # may be of another version

    assert found(tmp_path / "prefix" / site, AMENT_PREFIX_PATH=str(tmp_path / "other")) == path


def test_a_checkout_finds_its_own_files_and_others_those_of_ament(tmp_path: Path) -> None:
    install(tmp_path / "checkout")
    share = tmp_path / "prefix" / "share" / "tsobs_ros" / "config"
    of_ament, prefixes = config(share), f"/none:{tmp_path / 'prefix'}"
    assert found(tmp_path / "checkout", AMENT_PREFIX_PATH=prefixes) == of_ament

    (tmp_path / "checkout" / "package.xml").touch()
    own = config(tmp_path / "checkout" / "config")
    assert found(tmp_path / "checkout", AMENT_PREFIX_PATH=prefixes) == own


def test_a_missing_file_is_an_error_that_names_the_others() -> None:
    with pytest.raises(ResourceError, match=r"no config file 'none\.yaml' in .*observer\.yaml"):
        config_path("none.yaml")
