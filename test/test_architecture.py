# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Imports point one way, from the nodes and the command line down to the model."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "tsobs_ros"

COMMON = {"checks", "errors", "files", "resources", "schema", "series"}
COMMON |= {"settings", "stop", "style", "yaml_files"}


def directions() -> dict[str, set[str]]:
    """Read from docs/architecture.md which parts each part of the package may import."""
    text = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| .*`(\w+)(?:/|\.py)` \| (.+) \|$", text, re.MULTILINE)
    found = {name: set[str]() for name in COMMON}
    for place, (name, cell) in enumerate(rows):
        found[name] = set(re.findall(r"`(\w+)(?:/|\.py)`", cell))
        if "everything below" in cell:
            found[name] = {below for below, _ in rows[place + 1 :]} - found[name]
        if "the core" in cell:
            found[name] |= {"core", "model", "estimation"}
    return found


MAY_IMPORT = directions()

# The only parts that may import a library, so that the others work without it.
HOME: dict[str, set[str]] = {
    "rclpy": {"nodes"},
    "ament_index_python": {"nodes"},
    "cvxpy": {"design"},
    "clarabel": {"design"},
    "scipy": {"design", "identification"},
    "matplotlib": {"report"},
    "plotly": {"report"},
    "pyarrow": {"campaign", "report"},
    "rich": {"cli"},
}
ROS_INTERFACES = {"rcl_interfaces", "builtin_interfaces", "std_srvs"}


def homes_of(library: str) -> set[str] | None:
    if library in ROS_INTERFACES or library.endswith("_msgs") or library.startswith("rosidl_"):
        return {"nodes"}
    return HOME.get(library)


def imported(source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and dotted name of everything that a module imports, anywhere."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "relative imports are not read here"
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and "import" in ast.unparse(node.func):
            yield from (
                (node.lineno, str(each.value))
                for each in node.args[:1]
                if isinstance(each, ast.Constant)
            )


def violations(path: Path) -> Iterator[str]:
    """Yield the imports that a module, given by its path in the package, must not have."""
    part = path.parts[0].removesuffix(".py")
    assert part in MAY_IMPORT, f"{path}: new part; list its imports in docs/architecture.md"
    for line, name in imported((PACKAGE / path).read_text(encoding="utf-8")):
        root, _, rest = name.partition(".")
        target, homes = rest.partition(".")[0], homes_of(root)
        if root == "tsobs_ros":
            own = target == part or target.startswith("__")
            if target in MAY_IMPORT and not own and target not in MAY_IMPORT[part] | COMMON:
                yield f"{path}:{line}: {part} must not import {target}"
        elif homes is not None and part not in homes:
            yield f"{path}:{line}: {root} belongs to {' and '.join(sorted(homes))}, not {part}"


def modules() -> list[Path]:
    return sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))


def test_the_package_keeps_its_import_directions() -> None:
    found = [violation for path in modules() for violation in violations(path)]

    assert not found, "\n".join(found)


def check_runs(blocked: tuple[str, ...], code: str) -> None:
    """Run a program without some libraries."""
    without = f"import sys; sys.modules.update(dict.fromkeys({blocked!r}))\n"
    done = subprocess.run(
        [sys.executable, "-c", without + code],
        cwd=PACKAGE.parent, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_the_nodes_of_a_robot_need_numpy_and_a_yaml_reader_alone() -> None:
    """With what rosdep gets from Ubuntu's apt they start, observe and draw."""
    check_runs(
        ("scipy", "msgspec", "mcap", "zstandard", "lz4", "cvxpy", "matplotlib", "plotly"),
        "import rclpy\n"
        "from tsobs_ros.nodes import observer, plant_simulator, visualizer\n"
        "rclpy.init()\n"
        "nodes = [each.create() for each in (observer, plant_simulator, visualizer)]\n"
        "assert all(each.active for each in nodes)\n"
        "for each in nodes: each.close()",
    )


def test_parts_without_ros_import_without_the_extras() -> None:
    parts = ("model", "estimation", "simulation", "bag", "cli", "executables")
    names = [
        ".".join(("tsobs_ros", *path.with_suffix("").parts))
        for path in modules()
        if path.parts[0].removesuffix(".py") in parts
    ]
    check_runs(
        ("rclpy", "cvxpy", "clarabel", "matplotlib", "plotly"),
        f"from importlib import import_module\nfor name in {names!r}: import_module(name)",
    )
