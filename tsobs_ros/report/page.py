# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An interactive page of a run: a verdict in words, plots to zoom into, and tables."""

import base64
import gzip
import json
from collections.abc import Iterator, Sequence
from html import escape
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs

from tsobs_ros.checks import Array
from tsobs_ros.estimation.health import Level
from tsobs_ros.report.panels import (
    EVENT_COLOUR,
    SETTLING_COLOUR,
    STYLES,
    TIME,
    Band,
    Picture,
    Plot,
    Table,
    stretches,
)
from tsobs_ros.report.summary import Summary
from tsobs_ros.style import GRID, INK, MUTED

_VERDICTS = {Level.OK: ("good", "✓ Good:"), Level.WARN: ("warn", "! Mind:")}
_MAX_ROWS = 200
_NUMBER = ' class="number"'
# Nothing is fetched from anywhere: the page needs only itself.
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"


def write_html(
    picture: Picture,
    path: Path,
    tables: Sequence[Table] = (),
    *,
    first: Sequence[Table] = (),
    summary: Summary | None = None,
) -> None:
    """Write a page that needs nothing but itself: no network, no second file.

    The page contains plotly.js, compressed, which is most of its size: with a separate script, a
    page that is sent or moved alone would be blank. `tables` are below the plots, `first` is above
    them.

    Raises:
        OSError: The page cannot be written.
    """
    own = Path(__file__)
    style = own.with_suffix(".css").read_text(encoding="utf-8")
    script = own.with_suffix(".js").read_text(encoding="utf-8")
    figures, drawn = _figures(picture)
    with path.open("w", encoding="utf-8") as page:
        page.write(
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
            f"<title>{escape(picture.name)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        )
        page.writelines(_head(picture, summary))
        page.writelines(_tables(first))
        page.write(figures)
        page.writelines(_tables(tables))
        page.write("</main>\n")
        content = json.dumps(drawn, separators=(",", ":"), allow_nan=False)
        for name, text in (("library", get_plotlyjs()), ("content", content)):
            data = base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode("ascii")
            page.write(f'<script type="text/plain" id="{name}">{data}</script>\n')
        page.write(f"<script>\n{script}</script>\n</body>\n</html>\n")


def _head(picture: Picture, summary: Summary | None) -> Iterator[str]:
    yield f"<header>\n<h1>{escape(picture.name)}</h1>\n"
    if summary is not None:
        kind, verdict = _VERDICTS.get(summary.level, ("error", "✗ Bad:"))
        yield f'<p class="verdict {kind}"><strong>{verdict}</strong>{escape(summary.text)}</p>\n'
    yield f'<p class="muted">{escape(picture.headline)}</p>\n</header>\n<main>\n'
    yield '<p id="failure" role="status"></p>\n'
    yield "<noscript><p>The figures need JavaScript; the tables do not.</p></noscript>\n"


def _tables(tables: Sequence[Table]) -> Iterator[str]:
    for table in filter(attrgetter("rows"), tables):
        text = "" if table.numbers < len(table.head) else ' class="text"'
        yield f"<section>\n<h2>{escape(table.title)}</h2>\n"
        yield f'<div class="wide" tabindex="0" role="region" aria-label="{escape(table.title)}">'
        yield f"<table{text}>{_table(table)}</table></div>\n</section>\n"


def _table(table: Table) -> str:
    def cells(tag: str, row: Sequence[str]) -> str:
        scope = ' scope="col"' if tag == "th" else ""
        return "".join(
            f"<{tag}{scope}{_NUMBER if place >= table.numbers else ''}>{escape(cell)}</{tag}>"
            for place, cell in enumerate(row)
        )

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in table.rows[:_MAX_ROWS])
    left_out = len(table.rows) - _MAX_ROWS
    note = table.note + (f" {left_out} more rows are left out." if left_out > 0 else "")
    caption = f"<caption>{escape(note)}</caption>" if note else ""
    return f"{caption}<thead><tr>{cells('th', table.head)}</tr></thead><tbody>{body}</tbody>"


def _figures(picture: Picture) -> tuple[str, list[dict[str, Any]]]:
    """Return the HTML elements of the plots, and the data that are drawn into them."""
    drawn: list[dict[str, Any]] = []
    rows = ""
    for row in picture.rows:
        rows += f'<div class="row{"" if len(row) > 1 else " single"}">'
        for plot in row:
            identity = f"plot{len(drawn)}"
            drawn.append(_drawn(plot, picture, identity))
            rows += _figure(plot, identity)
        rows += "</div>\n"
    groups = {
        trace["legendgroup"]: trace["meta"]
        for one in drawn
        for trace in one["data"]
        if "legendgroup" in trace
    }
    keys = "".join(
        f'<button type="button" aria-pressed="true" disabled data-group="{group}">'
        f'<span class="swatch" style="background:{colour}"></span>{group}</button>'
        for group, colour in groups.items()
    )
    bar = f'<div class="keys" role="group" aria-label="curves to show">{keys}</div>\n'
    return f"<section>\n{bar}{rows}</section>\n", drawn


def _figure(plot: Plot, identity: str) -> str:
    text = escape("  ·  ".join(plot.remark))
    own = "".join(
        f'<li><span class="swatch" style="background:{one.style.colour}"></span>'
        f"{escape(one.name)}</li>"
        for one in plot.own
    )
    legend = f'<ul class="own">{own}</ul>' if own else ""
    # A row needs room for its name.
    height = max(220, 24 * len(plot.rows) + 70)
    return (
        f'<figure><figcaption><h3>{escape(plot.title)}</h3><p class="remark">{text}</p>{legend}'
        f'</figcaption><div class="plot" id="{identity}" style="height:{height}px" role="img" '
        f'aria-label="{escape(f"{plot.title} over {plot.axis}. {text}")}"></div></figure>'
    )


def _drawn(plot: Plot, picture: Picture, identity: str) -> dict[str, Any]:
    follows = plot.axis == TIME
    axis = {"zeroline": False, "gridcolor": GRID, "fixedrange": False}
    layout: dict[str, Any] = {
        # The toolbar needs room above the values.
        "margin": {"l": 56, "r": 10, "t": 30, "b": 34},
        "font": {"color": INK, "size": 12, "family": "system-ui, sans-serif"},
        "showlegend": False,
        "hovermode": "x",
        "xaxis": axis
        | ({"range": list(picture.time_range)} if follows else {})
        | {"title": {"text": plot.axis, "standoff": 4, "font": {"size": 11, "color": MUTED}}},
        "yaxis": axis | {"range": list(plot.limits), "nticks": 5},
        "shapes": list(_shapes(plot, picture)),
    }
    if plot.rows:
        ticks = {"tickvals": [*range(len(plot.rows))], "ticktext": [*map(escape, plot.rows)]}
        layout["yaxis"] |= ticks | {"automargin": True, "ticklabelstandoff": 4}
    return {"id": identity, "data": list(_traces(plot)), "layout": layout, "follows": follows}


def _traces(plot: Plot) -> Iterator[dict[str, Any]]:
    for place, band in enumerate(plot.bands):
        x, y = _outline(band)
        fill = {"fill": "toself", "fillcolor": "rgba(0, 114, 178, 0.15)", "hoverinfo": "skip"}
        yield _trace(band.name, x, y, line={"width": 0}, **fill) | _switch(
            band.name, _SWATCHES[place]
        )
    for curve in plot.curves:
        colour, width, dash = curve.style
        look: dict[str, Any] = {"line": {"color": colour, "width": width, "dash": _DASHES[dash]}}
        if dash == ".":
            look = {"mode": "markers", "marker": {"size": 2.5, "color": colour}}
        trace = _trace(curve.name, curve.times, curve.values, **look)
        yield trace | (_switch(curve.name, colour) if curve.name in STYLES else {})


_SWATCHES = "#cfe4f0", "#8dbcd9"  # of a wider band and a narrower one, which lies on it
_DASHES = {"-": "solid", "--": "dash", ":": "dot", ".": "solid"}


def _trace(name: str, x: Array, y: Array, **style: Any) -> dict[str, Any]:
    points = {"x": _encoded(x), "y": _encoded(y)}
    return {"type": "scatter", "mode": "lines", "name": escape(name), **points, **style}


def _switch(name: str, colour: str) -> dict[str, str]:
    """Return the entries by which a button switches all curves of a name."""
    return {"legendgroup": name, "meta": colour}


def _encoded(values: Array) -> dict[str, str]:
    """Return numbers as plotly.js reads them; single precision is finer than any screen."""
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is left out
        data = np.asarray(values, dtype="<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(data).decode("ascii")}


def _outline(band: Band) -> tuple[Array, Array]:
    """Return the outlines of a band, with NaN between its parts."""
    x, y = [np.zeros(0)], [np.zeros(0)]
    for own in stretches(np.isfinite(band.lower) & np.isfinite(band.upper)):
        x += [band.times[own], band.times[own][::-1], np.array([np.nan])]
        y += [band.upper[own], band.lower[own][::-1], np.array([np.nan])]
    return np.concatenate(x)[:-1], np.concatenate(y)[:-1]


def _shapes(plot: Plot, picture: Picture) -> Iterator[dict[str, Any]]:
    if plot.axis == TIME:
        # One path for all spans: a shape for each would make a page with many events slow.
        span = "M{0:.4f},0 L{0:.4f},1 L{1:.4f},1 L{1:.4f},0 Z"
        below = {"line": {"width": 0}, "layer": "below"}
        yield _path(span, picture.unsettled) | {"fillcolor": SETTLING_COLOUR} | below
        yield _path(span, plot.spans) | {"fillcolor": EVENT_COLOUR, "opacity": 0.2} | below
        line = {"color": EVENT_COLOUR, "dash": "dot", "width": 1}
        jumps = [(time,) for time in picture.jumps]
        yield _path("M{0:.4f},0 L{0:.4f},1", jumps) | {"line": line}
    for height in (-plot.level, plot.level) if plot.level else ():
        line = {"color": MUTED, "dash": "dash", "width": 1}
        ends = {"xref": "paper", "x0": 0, "x1": 1, "yref": "y", "y0": height, "y1": height}
        yield {"type": "line", "line": line, **ends}


def _path(part: str, times: Sequence[tuple[float, ...]]) -> dict[str, Any]:
    path = " ".join(part.format(*one) for one in times) or "M0,0"
    return {"type": "path", "xref": "x", "yref": "paper", "path": path}
