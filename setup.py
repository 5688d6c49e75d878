# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Build tsobs_ros, for colcon as an ament_python package and for pip as a wheel."""

import re
import runpy
import sys
from pathlib import Path

from setuptools import Distribution, Extension, find_packages, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import CCompilerError

NAME = "tsobs_ros"
EXECUTABLES = {
    "plant_simulator": "tsobs_ros.executables:plant_simulator",
    "observer": "tsobs_ros.executables:observer",
    "recorder": "tsobs_ros.executables:recorder",
    "player": "tsobs_ros.executables:player",
    "visualizer": "tsobs_ros.executables:visualizer",
    "tsobs": "tsobs_ros.executables:tsobs",
}
NEEDED = (
    "it takes a C compiler and the headers of Python {}.{}, e.g. `apt install build-essential "
    "python3-dev`"
).format(*sys.version_info)
LAUNCHER = """#!/bin/sh
exec "$(dirname -- "$(readlink -f -- "$0")")/../../bin/{name}" "$@"
"""


class AmentDistribution(Distribution):
    """Keeps data files in editable wheels, which ask for `has_data` and drop them without it."""

    has_data = Distribution.has_data_files


class CoreBuilder(build_ext):
    """Ends a failed build with one line that says what to install."""

    def build_extension(self, ext: Extension) -> None:
        """Compile the core, or exit."""
        # After a source is deleted, no other one is newer than the build: compare digests too.
        built, digest = Path(self.get_ext_fullpath(ext.name)), dict(ext.define_macros)["SOURCES"]
        if built.exists() and digest.strip('"').encode() not in built.read_bytes():
            self.force = True
        try:
            super().build_extension(ext)
        except CCompilerError as error:
            sys.exit(f"{NAME}: building the compiled core failed: {error}; {NEEDED}")


def version() -> str:
    """Read the version without importing the package, whose dependencies may be missing."""
    text = Path(NAME, "__init__.py").read_text(encoding="utf-8")
    match = re.search(r'^__version__ = "(.+)"$', text, re.MULTILINE)
    assert match is not None, "tsobs_ros/__init__.py states no __version__"
    return match[1]


def launchers() -> list[str]:
    """Write launchers for `ros2 run` in a prefix made by pip, which installs to bin only."""
    folder = Path("build", "launchers")
    folder.mkdir(parents=True, exist_ok=True)
    for name in EXECUTABLES:
        path = folder / name
        path.write_text(LAUNCHER.format(name=name), encoding="utf-8")
        path.chmod(0o755)
    return [str(folder / name) for name in EXECUTABLES]


def data_files() -> list[tuple[str, list[str]]]:
    """List the files that are installed outside the Python package."""
    files = [
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", sorted(map(str, Path("config").glob("*.*ml")))),
        (f"share/{NAME}/examples", sorted(map(str, Path("examples").glob("*.py")))),
        (f"share/{NAME}/examples/c", ["examples/c/step_log.c"]),
        *(
            (f"share/{NAME}/{folder}", sorted(map(str, Path(folder).glob("*"))))
            for folder in ("launch", "urdf", "views")
        ),
    ]
    # pip installs the console scripts to bin, colcon to lib/tsobs_ros.
    if {"bdist_wheel", "editable_wheel"} & set(sys.argv):
        files.append((f"lib/{NAME}", launchers()))
    else:
        files.append(("bin", ["resource/tsobs"]))
    return files


def extension() -> Extension:
    """Declare the compiled core: strict IEEE arithmetic, one binary for all Pythons."""
    core = Path(NAME, "core")
    digest = runpy.run_path(str(core / "sources.py"))["digest"](core)
    return Extension(
        f"{NAME}.core.native",
        sources=sorted(map(str, core.glob("*.c"))),
        depends=sorted(map(str, core.glob("*.h"))),
        define_macros=[("Py_LIMITED_API", "0x030B0000"), ("SOURCES", f'"{digest}"')],
        extra_compile_args=[
            *("-std=c99", "-O3", "-ffp-contract=off", "-fno-math-errno"),
            *("-Wall", "-Wextra", "-fvisibility=hidden"),
        ],
        libraries=["m"],
        py_limited_api=True,  # from 3.11 on; setup.cfg names the wheel to match
    )


setup(
    name=NAME,
    version=version(),
    description="State and sensor-disturbance estimation for a robot arm with an elastic joint",
    # `colcon build --symlink-install` runs a link to this file, and makes no link to the README.
    long_description=Path(__file__).resolve().with_name("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    author="The tsobs_ros contributors",
    maintainer="The tsobs_ros contributors",
    maintainer_email="tsobs_ros@example.org",
    distclass=AmentDistribution,
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    # Stated although it is the default: "pip install -e" then puts this folder on the path. Else a
    # finder looks for the package last, after the current folder: a clone there has the name of the
    # package, and passes for an empty namespace package.
    package_dir={"": "."},
    package_data={
        NAME: ["py.typed", "report/page.css", "report/page.js", "core/*.[ch]", "core/*.pyi"]
    },
    ext_modules=[extension()],
    cmdclass={"build_ext": CoreBuilder},
    data_files=data_files(),
    zip_safe=False,
    # Never rclpy: a sourced ROS provides it without pip's knowledge, and wheels would outrank it.
    install_requires=[
        "numpy>=1.26",
        "pyyaml>=6.0",
        "msgspec>=0.21",  # the first whose errors are ValueErrors
        "mcap>=1.5",
        "zstandard>=0.22",
        "lz4>=4.3",
    ],
    extras_require={
        "ros": ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"],
        "design": [
            "cvxpy-base>=1.5",
            "clarabel>=0.9",
            "scipy>=1.11",
        ],  # cvxpy adds 150 MB of solvers that are not used
        # Plotly 6 is the first whose pages read arrays as bytes.
        "report": ["matplotlib>=3.8", "plotly>=6", "tqdm>=4.66", "mcap-ros2-support>=0.5.5"],
        "export": ["mcap-ros2-support>=0.5.5", "pyarrow>=14"],
        "campaign": ["pyarrow>=14", "tqdm>=4.66"],
        "watch": ["rich>=13"],
        "docs": ["furo", "latex2mathml", "myst-parser", "sphinx"],
        "test": [
            "bayesian-filters",
            "hypothesis",
            "markdown-it-py",
            "mcap-ros2-support",
            "mypy>=2.4,<3",
            "playwright",
            "pyarrow",
            "pytest>=8,<9.2",  # newer ones scatter the groups of pytest-xdist 3.8
            "pytest-xdist",
            "rosbags",
            "ruff>=0.17,<0.18",
            "scipy",
            "setuptools>=70.1",  # tests build wheels without network
        ],
    },
    entry_points={
        "console_scripts": [f"{name} = {target}" for name, target in EXECUTABLES.items()]
    },
)
