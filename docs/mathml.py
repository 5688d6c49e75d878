# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Formulas of the site as MathML, which browsers draw without a script or a network.

Sub- and superscripts in text, such as those of E_L and P^{1/2}, are lowered and raised.
"""

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

_FUNCTION = re.compile(r"(<mi>(?:sin|cos|log|det|tr|diag)</mi>)")
_SCRIPT = re.compile(r"([_^])(?:\{([^}]*)\}|(max|eq|[a-zω](?![a-z])|[A-Z](?![A-Za-z])))")
_VERBATIM = (nodes.literal, nodes.literal_block, nodes.math, nodes.math_block, nodes.raw)


def _mathml(node: nodes.Element, display: str) -> str:
    # U+2061 is the application of a function, without which its argument follows unspaced.
    return _FUNCTION.sub("\\1<mo>\u2061</mo>", convert(node.astext(), display=display))


def _inline(self: Any, node: nodes.math) -> None:
    self.body.append(_mathml(node, "inline"))
    raise nodes.SkipNode


def _display(self: Any, node: nodes.math_block) -> None:
    self.body.append(f'<div class="math" tabindex="0">{_mathml(node, "block")}</div>')
    raise nodes.SkipNode


class Scripts(SphinxTransform):
    """Sub- and superscripts in the text of pages; names in code stay."""

    default_priority = 500

    def apply(self, **_: Any) -> None:
        """Replace texts that have scripts."""
        if self.env.docname.startswith(("reference/", "changelog")):
            return
        for text in list(self.document.findall(nodes.Text)):
            if isinstance(text.parent, _VERBATIM) or not _SCRIPT.search(text):
                continue
            found, end = list[nodes.Node](), 0
            for match in _SCRIPT.finditer(text):
                kind = nodes.subscript if match[1] == "_" else nodes.superscript
                script = match[2] or match[3]
                found += [nodes.Text(text[end : match.start()]), kind(script, script)]
                end = match.end()
            text.parent.replace(text, [*found, nodes.Text(text[end:])])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer `mathml` and the scripts."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    app.add_transform(Scripts)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
