# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The site: it builds without a warning, fits a phone, and has all that the package offers."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import tsobs_ros as ts
from tsobs_ros.cli.main import main

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
TEXT = "\n".join(path.read_text(encoding="utf-8") for path in PAGES)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as `make docs` builds it; a warning is an error, such as a link to nowhere."""
    pytest.importorskip("sphinx")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-d", folder / "trees"]
    done = subprocess.run(
        [*command, DOCS, folder / "html"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder / "html"


@pytest.mark.parametrize("width", [390, 1280])
def test_every_page_fits_and_is_quiet(site: Path, browser: Any, width: int) -> None:
    """No page scrolls sideways, lacks a picture or its description, or complains."""
    said: list[str] = []
    with browser.new_context(viewport={"width": width, "height": 800}) as context:
        page = context.new_page()
        page.on("console", lambda message: said.append(f"{page.url}: {message.text}"))
        page.on("pageerror", lambda error: said.append(f"{page.url}: {error}"))
        for path in sorted(site.rglob("*.html")):
            page.goto(path.as_uri())
            sideways, pictures = page.evaluate(
                "[document.documentElement.scrollWidth - innerWidth,"
                " [...document.images].filter(i => !i.naturalWidth || !i.alt).map(i => i.src)]"
            )
            assert sideways <= 0, path.name
            assert not pictures, path.name
    assert not said


def test_the_reference_has_all_public_names(site: Path) -> None:
    page = (site / "reference" / "python.html").read_text(encoding="utf-8")
    assert [name for name in ts.__all__ if f'id="tsobs_ros.{name}"' not in page] == []


def test_the_reference_has_all_commands(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    commands = re.findall(r"^    (\w+)  ", capsys.readouterr().out, re.MULTILINE)
    assert len(commands) > 8
    assert [name for name in commands if f"{{command}} {name}" not in TEXT] == []


def test_every_figure_is_shown_and_made_by_a_command() -> None:
    made = (DOCS / "figures.py").read_text(encoding="utf-8")
    shown = TEXT + (ROOT / "README.md").read_text(encoding="utf-8")
    for path in (DOCS / "images").iterdir():
        assert f"images/{path.name}" in shown
        assert path.suffix == ".svg" or f'    "{path.stem}": ' in made


def test_messages_of_the_troubleshooting_page_are_those_of_the_package() -> None:
    """Each piece of two words and more, between what varies, stands in the sources."""
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    sources = [ROOT / "Makefile", ROOT / "setup.py", *(ROOT / "tsobs_ros").rglob("*.py")]
    text = " ".join(path.read_text(encoding="utf-8") for path in sources)
    text = re.sub(r'"\s*f?"', "", text)
    shown = re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", page, flags=re.DOTALL))
    commands = re.compile(r"tsobs |make |-[pr] |torque_disturbance|certify_uncertainty")
    pieces = [
        piece.strip(" :;-")
        for message in shown
        if not commands.match(message)
        for piece in re.split(r"…|[\d.]+ ", " ".join(message.split()))
    ]
    pieces = [piece for piece in pieces if " " in piece]
    assert len(pieces) > 12
    assert [piece for piece in pieces if piece not in text] == []
