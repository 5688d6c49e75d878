# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What every file, the manifest and the documents have to agree on."""

import re
from pathlib import Path
from xml.etree import ElementTree

import tsobs_ros

ROOT = Path(__file__).resolve().parents[1]
HEADER = "# Copyright 2026 The tsobs_ros contributors\n# SPDX-License-Identifier: Apache-2.0\n"
SOURCES = [
    Path("setup.py"),
    *sorted(
        p.relative_to(ROOT)
        for top in ("tsobs_ros", "test", "examples")
        for p in (ROOT / top).rglob("*.py")
    ),
]


def text(name: str | Path) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def manifest() -> ElementTree.Element:
    return ElementTree.parse(ROOT / "package.xml").getroot()


def test_every_source_has_the_licence_header() -> None:
    without = [str(path) for path in SOURCES if not text(path).startswith(HEADER)]

    assert not without, f"no licence header in {', '.join(without)}"


def test_the_manifest_is_a_ros_package_and_names_every_one_imported() -> None:
    root = manifest()
    facts = (root.get("format"), root.findtext("name"), root.findtext("export/build_type"))
    assert facts == ("3", "tsobs_ros", "ament_python")
    # An invalid address only warns, and then builds a package that ROS does not see.
    assert re.fullmatch(
        r"[\w.%+-]+@[\w-]+(\.[\w-]+)*\.[a-zA-Z]{2,}", root.find("maintainer").get("email")
    )
    sources = "".join(text(path) for path in SOURCES if path.parts[0] == "tsobs_ros")
    imported = set(re.findall(r"^\s*(?:from|import) (\w+)", sources, re.MULTILINE))
    ros = {n for n in imported if re.fullmatch(r"\w+_(msgs|interfaces)|rclpy|std_srvs", n)}
    assert ros <= {element.text for element in root.iter("exec_depend")}


def test_all_versions_are_the_same() -> None:
    newest = re.search(r"^(\d+\.\d+\.\d+)\b.*\n-{3,}", text("CHANGELOG.rst"), re.MULTILINE)

    assert newest is not None, "CHANGELOG.rst has no section such as '0.1.0 (2026-01-31)'"
    assert manifest().findtext("version") == tsobs_ros.__version__ == newest[1]
    assert f"version: {tsobs_ros.__version__}\n" in text("CITATION.cff")


def test_what_the_architecture_names_exists() -> None:
    named = set(re.findall(r"`([\w/]+(?:/|\.py|\.[ch]))`", text("docs/architecture.md")))
    tree = re.findall(
        r"^  ((?:[\w/]+(?:/|\.py)(?:, +)?)+)", text("docs/architecture.md"), re.MULTILINE
    )
    named |= {name for line in tree for name in line.split(", ")}

    assert len(named) > 40
    assert [n for n in named if not any((ROOT / f / n).exists() for f in (".", "tsobs_ros"))] == []
