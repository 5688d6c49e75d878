# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of `tsobs paper`: claims, numbers and figures, as Markdown and as one HTML file."""

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tsobs_ros.paper.claim_table import HEAD, Claim, claim_rows, html_table, markdown_table

TITLE = "The adaptive T–S observer: what its paper claims and what holds"

INTRODUCTION = (
    "The three examples of T. V. Dang, W.-J. Wang, L. Luoh, C.-H. Sun, “Adaptive observer design "
    "for the uncertain Takagi–Sugeno fuzzy system with output disturbance” (IET Control Theory & "
    "Applications, 2011), run again, with each claim judged by a number that this run computed. "
    "The text that was available has lost its minus signs and every π; how they were put back is "
    "told in tsobs_ros/model/examples.py, and the proofs of the propositions are in docs/method.md."
)

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.55 system-ui, sans-serif; color: #1f2933; background: #fff;
       max-width: 68rem; margin: 2rem auto; padding: 0 1.25rem; }
h1 { font-size: 1.6rem; line-height: 1.25; } h2 { font-size: 1.2rem; margin-top: 2.5rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .86rem; line-height: 1.4; }
th { text-align: left; border-bottom: 2px solid #c4c9d0; padding: .4rem .6rem; }
td { vertical-align: top; border-bottom: 1px solid #e3e6ea; padding: .45rem .6rem; }
.holds, .holds_only_if, .does_not_hold { border-left: 4px solid; min-width: 13rem; }
.holds { border-left-color: #00798c; } .holds_only_if { border-left-color: #edae49; }
.does_not_hold { border-left-color: #d1495b; }
.test { font: .72rem/1.4 ui-monospace, monospace; overflow-wrap: anywhere; color: #52606d; }
figure { margin: 1.5rem 0; } img { max-width: 100%; height: auto; }
pre { background: #f5f7fa; padding: .8rem; white-space: pre-wrap; font-size: .8rem;
      line-height: 1.45; }
"""


class Table(NamedTuple):
    """A table of numbers with a heading and a remark below."""

    heading: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    remark: str


class Section(NamedTuple):
    """Figures of one example."""

    heading: str
    figures: Sequence[Path]


def write_markdown(
    path: Path,
    claims: Sequence[Claim],
    tables: Sequence[Table],
    analysis: str,
    sections: Sequence[Section],
) -> None:
    """Write the page as Markdown, its figures linked.

    Args:
        path: The file; it is replaced. The figures are in its folder.
        claims: The table of claims.
        tables: Further numbers.
        analysis: The analysis of the three systems as plain text.
        sections: The figures.

    Raises:
        OSError: The file cannot be written.
    """
    parts = [f"# {TITLE}", INTRODUCTION, "## Claims", markdown_table(HEAD, claim_rows(claims))]
    for table in tables:
        parts += [f"## {table.heading}", markdown_table(table.head, table.rows), table.remark]
    parts += ["## Analysis", f"```\n{analysis}\n```"]
    for section in sections:
        parts.append(f"## {section.heading}")
        parts += [f"![{figure.stem}]({figure.name})" for figure in section.figures]
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def write_html(
    path: Path,
    claims: Sequence[Claim],
    tables: Sequence[Table],
    analysis: str,
    sections: Sequence[Section],
) -> None:
    """Write the page as one HTML file that needs no other; arguments as `write_markdown`."""
    parts = [
        f"<h1>{html.escape(TITLE)}</h1>",
        f"<p>{html.escape(INTRODUCTION)}</p>",
        "<h2>Claims</h2>",
        f'<div class="wide">{html_table(HEAD, claim_rows(claims))}</div>',
    ]
    for table in tables:
        parts += [
            f"<h2>{html.escape(table.heading)}</h2>",
            f'<div class="wide">{html_table(table.head, table.rows)}</div>',
            f"<p>{html.escape(table.remark)}</p>",
        ]
    parts += ["<h2>Analysis</h2>", f"<pre>{html.escape(analysis)}</pre>"]
    for section in sections:
        parts.append(f"<h2>{html.escape(section.heading)}</h2>")
        parts += [_figure(figure) for figure in section.figures]
    body = "\n".join(parts)
    path.write_text(
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(TITLE)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n",
        encoding="utf-8",
    )


def _figure(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    name = html.escape(path.stem.replace("_", " "))
    return f'<figure><img alt="{name}" src="data:image/png;base64,{data}"></figure>'
