# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A command shows how far it is where somebody looks, and works where nothing can show it."""

import io
import sys
from importlib import import_module

import pytest

from tsobs_ros.cli.common import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown_on(stream: io.StringIO, monkeypatch: pytest.MonkeyPatch, **options: bool) -> str:
    """Return what ten samples' work writes to stderr, if that is the stream."""
    monkeypatch.setattr(sys, "stderr", stream)
    with progress(10, " samples", **options) as told:
        told(4)
        told(6)
    return stream.getvalue()


def test_a_terminal_shows_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tqdm")
    assert "/10" in shown_on(Terminal(), monkeypatch)


def test_nothing_is_shown_where_nothing_is_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shown_on(Terminal(), monkeypatch, quiet=True) == ""
    assert shown_on(io.StringIO(), monkeypatch) == ""


def test_the_work_is_done_without_tqdm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tqdm", None)
    assert shown_on(Terminal(), monkeypatch) == ""


def test_what_is_missing_for_the_work_itself_is_told() -> None:
    with pytest.raises(ModuleNotFoundError, match="no_such_module"), progress(1, "B"):
        import_module("no_such_module")
