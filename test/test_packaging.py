# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What pip installs is a ROS package: marker, manifest, config, and launchers for `ros2 run`."""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest

import tsobs_ros
from tsobs_ros.core import native
from tsobs_ros.errors import LIBRARIES

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
VIEWS = ("launch", "urdf", "views")
EXECUTABLES = ("observer", "plant_simulator", "recorder", "player", "visualizer", "tsobs")
STEM = f"tsobs_ros-{tsobs_ros.__version__}"
DATA = f"{STEM}.data/data"


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy what a build needs, since it writes next to the sources."""
    copy = tmp_path_factory.mktemp("sources") / "tsobs_ros"
    ignored = shutil.ignore_patterns("__pycache__", "*.so")
    for name in ("tsobs_ros", "config", "examples", "resource", *VIEWS):
        shutil.copytree(ROOT / name, copy / name, ignore=ignored)
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "LICENSE", "README.md"):
        shutil.copy(ROOT / name, copy)
    return copy


def python(*arguments: Any, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python with arguments in a folder."""
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env={**os.environ, **environment},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def build(sources: Path, kind: str, folder: Path) -> ZipFile:
    """Call the build backend the way pip does, without its isolated environment."""
    code = f"from setuptools.build_meta import {kind}; {kind}({str(folder)!r})"
    done = python("-c", code, cwd=sources)
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
    views = [path for name in VIEWS for path in (ROOT / name).iterdir()]
    assert len(views) == 5
    for path in (*(ROOT / "config").glob("*.yaml"), *(ROOT / "examples").glob("*.py"), *views):
        assert f"{DATA}/share/tsobs_ros/{path.parent.name}/{path.name}" in names
    for name in EXECUTABLES:
        assert f"{DATA}/lib/tsobs_ros/{name}" in names


def test_a_wheel_carries_the_whole_package(wheel: ZipFile) -> None:
    files = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tsobs_ros").rglob("*")
        if path.is_file() and path.suffix != ".so" and "__pycache__" not in path.parts
    }

    assert files - set(wheel.namelist()) == set()
    assert "tsobs_ros/core/native.abi3.so" in wheel.namelist()
    assert "tsobs_ros/core/layout.h" in files
    assert not [name for name in wheel.namelist() if name.startswith("test")]


def test_the_folder_of_a_clone_does_not_pass_for_the_package(
    editable: ZipFile, sources: Path, tmp_path: Path
) -> None:
    """From a workspace's `src`, or wherever the clone is, which Python looks into first."""
    editable.extractall(tmp_path)
    code = (
        f"import site; site.addsitedir({str(tmp_path)!r}); import tsobs_ros as t; print(t.__file__)"
    )
    # Without the package that this Python has.
    done = python("-S", "-c", code, cwd=sources.parent, PYTHONPATH="")

    assert done.stdout.strip() == str(sources / "tsobs_ros" / "__init__.py"), done.stderr


@pytest.mark.parametrize("compiler", ["no_such_compiler", "without_headers"])
def test_a_core_that_cannot_be_built_is_one_line_that_says_what_to_install(
    sources: Path, tmp_path: Path, compiler: str
) -> None:
    script = tmp_path / "without_headers"
    script.write_text(
        '#!/bin/sh\nfor each; do shift; case "$each" in -I*) ;; *) set -- "$@" "$each";; esac\n'
        'done\nexec cc "$@"\n'
    )
    script.chmod(0o755)
    command = ["setup.py", "-q", "build_ext", "--build-temp", tmp_path, "--force"]
    path = f"{tmp_path}:{os.environ['PATH']}"
    done = python(*command, cwd=sources, CC=compiler, PATH=path)

    assert done.returncode == 1
    line = done.stderr.splitlines()[-1]
    assert line.startswith("tsobs_ros: building the compiled core failed: ")
    assert "apt install build-essential python3-dev" in line
    assert "Traceback" not in done.stderr


def test_a_core_that_is_not_built_from_these_sources_is_not_loaded(
    sources: Path, tmp_path: Path
) -> None:
    shutil.copytree(
        sources / "tsobs_ros", tmp_path / "tsobs_ros", ignore=shutil.ignore_patterns("*.so")
    )
    core = tmp_path / "tsobs_ros" / "core"

    def load() -> str:
        code = "import tsobs_ros; print(tsobs_ros.load_design.__name__)"
        done = python("-c", code, cwd=tmp_path, PYTHONPATH="")
        return (done.stdout + done.stderr).splitlines()[-1]

    assert "tsobs_ros.core.native is not built: in the folder with setup.py, " in load()
    shutil.copy(native.__file__, core)
    assert load() == "load_design"
    (core / "new.h").write_text("/* fewer, more or other sources */\n")
    assert "tsobs_ros.core.native is built from other C sources: in the folder " in load()
    for path in core.glob("*.[ch]"):  # as in a wheel
        path.unlink()
    assert load() == "load_design"


def test_the_readme_installs_what_the_package_requires(wheel: ZipFile) -> None:
    """ROS has NumPy, for whose first version it is built, and rosdep installs PyYAML."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    _, _, command = readme.replace("\\\n", "").partition(".venv/bin/python -m pip install ")
    installed = set(shlex.split(command.splitlines()[0]))
    needed = {each for name in LIBRARIES if name != "rclpy" for each in LIBRARIES[name]}

    assert installed == needed - {"pyyaml>=6.0", "numpy>=1.26"} | {"numpy<2"}
    manifest = (ROOT / "package.xml").read_text(encoding="utf-8")
    for key in ("numpy", "yaml"):
        assert f"<exec_depend>python3-{key}</exec_depend>" in manifest


def test_colcon_puts_the_command_on_the_path(sources: Path, tmp_path: Path) -> None:
    """As colcon does, by `setup.py install`; its hook adds the folder `bin` to the path."""
    done = python("setup.py", "install_data", "--install-dir", tmp_path, cwd=sources)
    assert done.returncode == 0, done.stderr
    script = tmp_path / "lib" / "tsobs_ros" / "tsobs"
    script.parent.mkdir(parents=True)
    script.write_text('#!/bin/sh\necho "ran with $2"\n')
    script.chmod(0o755)

    path = {**os.environ, "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    assert subprocess.check_output(["tsobs", "verify", "two words"], env=path) == (
        b"ran with two words\n"
    )
