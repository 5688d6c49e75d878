# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What pip installs is a ROS package: marker, manifest, config, and launchers for `ros2 run`."""

import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

import tsobs_ros
from tsobs_ros.errors import LIBRARIES, missing_library

ROOT = Path(__file__).resolve().parents[1]
EXECUTABLES = ("observer", "plant_simulator", "recorder", "player", "tsobs")
STEM = f"tsobs_ros-{tsobs_ros.__version__}"
DATA = f"{STEM}.data/data"


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy what a build needs, since it writes next to the sources."""
    copy = tmp_path_factory.mktemp("sources")
    ignored = shutil.ignore_patterns("__pycache__")
    for name in ("tsobs_ros", "config", "examples", "resource"):
        shutil.copytree(ROOT / name, copy / name, ignore=ignored)
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    return copy


def build(sources: Path, kind: str, folder: Path) -> ZipFile:
    """Call the build backend the way pip does, without its isolated environment."""
    code = f"from setuptools.build_meta import {kind}; {kind}({str(folder)!r})"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=sources, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return ZipFile(path)


@pytest.fixture(scope="module")
def wheel(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> ZipFile:
    return build(sources, "build_wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def editable(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> ZipFile:
    return build(sources, "build_editable", tmp_path_factory.mktemp("editable"))


@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_a_wheel_carries_what_ros_looks_for(kind: str, request: pytest.FixtureRequest) -> None:
    names = set(request.getfixturevalue(kind).namelist())

    assert f"{DATA}/share/ament_index/resource_index/packages/tsobs_ros" in names
    assert f"{DATA}/share/tsobs_ros/package.xml" in names
    for path in (*(ROOT / "config").glob("*.yaml"), *(ROOT / "examples").glob("*.py")):
        assert f"{DATA}/share/tsobs_ros/{path.parent.name}/{path.name}" in names
    for name in EXECUTABLES:
        assert f"{DATA}/lib/tsobs_ros/{name}" in names


def test_a_wheel_carries_the_whole_package(wheel: ZipFile) -> None:
    files = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tsobs_ros").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }

    assert files - set(wheel.namelist()) == set()
    assert not [name for name in wheel.namelist() if name.startswith("test")]


def test_rclpy_is_never_required(wheel: ZipFile) -> None:
    metadata = wheel.read(f"{STEM}.dist-info/METADATA").decode()
    required = [line for line in metadata.splitlines() if line.startswith("Requires-Dist:")]

    assert any("rclpy" in line for line in required)
    assert [line for line in required if "ros-" in line and "extra ==" not in line] == []


@pytest.mark.parametrize("name", EXECUTABLES)
def test_a_launcher_runs_the_installed_script(wheel: ZipFile, tmp_path: Path, name: str) -> None:
    prefix = tmp_path / "a prefix"
    script = prefix / "bin" / name
    launcher = prefix / "lib" / "tsobs_ros" / name
    for path in (script, launcher):
        path.parent.mkdir(parents=True)
    script.write_text('#!/bin/sh\necho "ran $(basename "$0") with $2"\nexit 3\n')
    entry = wheel.getinfo(f"{DATA}/lib/tsobs_ros/{name}")
    launcher.write_bytes(wheel.read(entry))
    for path in (script, launcher):
        path.chmod(0o755)

    done = subprocess.run(
        [launcher, "--ros-args", "two words"], capture_output=True, text=True, check=False
    )

    assert entry.external_attr >> 16 & 0o111, "pip keeps it executable only if the wheel does"
    assert (done.returncode, done.stdout) == (3, f"ran {name} with two words\n")


def test_the_advice_on_a_missing_library_is_what_the_package_requires(wheel: ZipFile) -> None:
    metadata = wheel.read(f"{STEM}.dist-info/METADATA").decode()
    required = {
        line.removeprefix("Requires-Dist: ").partition(";")[0].strip()
        for line in metadata.splitlines()
        if line.startswith("Requires-Dist:")
    }
    advised = {library for libraries in LIBRARIES.values() for library in libraries}

    assert advised <= required


@pytest.mark.parametrize(
    ("module", "advice"),
    [
        ("cvxpy.error", "cvxpy is not installed: {} -m pip install cvxpy clarabel"),
        ("mcap", "mcap is not installed: {} -m pip install 'mcap>=1.5'"),
        ("rclpy.node", "rclpy is not installed: source ROS 2 Jazzy, or {} -m pip install"),
        ("colour", None),
    ],
)
def test_a_missing_library_is_advised_on(module: str, advice: str | None) -> None:
    found = missing_library(ModuleNotFoundError(f"No module named {module!r}", name=module))

    assert found is None if advice is None else found.startswith(advice.format(sys.executable))
