# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Directives of this site that write reference pages from the package itself.

`{node} observer` has a node's topics, services and parameters, `{command} bag info` the help of a
command. Both show what `--help` prints, whose source are the descriptors that ROS gets.
"""

import inspect
import os
import re
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from importlib import import_module
from io import StringIO
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.logging import getLogger

from tsobs_ros.cli.main import main
from tsobs_ros.settings import in_yaml, settings_of

_LOG = getLogger(__name__)


class NodeReference(SphinxDirective):
    """Topics, services and parameters of a node."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the page's part on the node."""
        name = self.arguments[0]
        try:
            module = import_module(f"tsobs_ros.nodes.{name}")
        except ModuleNotFoundError as error:
            _LOG.warning("%s is not installed, so the %s has no reference", error.name, name)
            return self.parse_text_to_nodes(f"See `ros2 run tsobs_ros {name} --help`.")
        _, _, described = (inspect.getdoc(module) or "").partition("\n\n")
        lines = [*_described(described), "", *_parameters(module.Parameters)]
        return self.parse_text_to_nodes("\n".join(lines))


def _described(text: str) -> Iterator[str]:
    """Make tables of a module's docstring, whose entries are indented and have two columns."""
    in_table = False
    for line in re.sub(r"\n {3,}", "  ", text).splitlines():
        if not line.startswith("  "):
            yield from ("", line) if in_table else (line,)
            in_table = False
            continue
        name, _, content = line.strip().partition("  ")
        if not in_table:
            yield from ("", "| | |", "|---|---|")
        in_table = True
        content = re.sub(r"([<*|])", r"\\\1", " ".join(content.split()))
        yield f"| {f'`{name}`' if content else name} | {content} |"


def _parameters(make: type) -> Iterator[str]:
    yield from ("| parameter | type, default | accepted | |", "|---|---|---|---|")
    for each in settings_of(make).values():
        kind = f"{each.kind.replace('_', ' ')}, `{in_yaml(each.default)}`"
        limits = ", ".join(filter(None, [each.limits, "" if each.live else "read-only"]))
        cells = (f"`{each.name}`", kind, limits, each.description)
        yield f"| {' | '.join(each.replace('|', chr(92) + '|') for each in cells)} |"


class CommandReference(SphinxDirective):
    """Usage, arguments and options of a command of `tsobs`."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Return the page's part on the command."""
        os.environ["COLUMNS"] = "92"
        with redirect_stdout(StringIO()) as text, suppress(SystemExit):
            main([*self.arguments[0].split(), "--help"])
        return self.parse_text_to_nodes(f"```text\n{text.getvalue()}\n```")


def _plain(_app: Sphinx, what: str, *event: Any) -> None:
    """Keep what docstrings mean otherwise: |x| is a magnitude, "a: b" of a property a sentence."""
    lines: list[str] = event[-1]
    lines[:] = [line if ">>>" in line else line.replace("|", "\\|") for line in lines]
    if what == "property":
        lines[0] = lines[0].replace(": ", " – ", 1)


def setup(app: Sphinx) -> dict[str, Any]:
    """Add the directives to Sphinx."""
    app.add_directive("node", NodeReference)
    app.add_directive("command", CommandReference)
    app.connect("autodoc-process-docstring", _plain, priority=400)  # before napoleon
    return {"parallel_read_safe": True}
