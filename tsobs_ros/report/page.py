# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A run as an interactive page: what it comes to in words, its panels to zoom into, its tables."""

import base64
import gzip
import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs

from tsobs_ros.checks import Array
from tsobs_ros.estimation.health import Level
from tsobs_ros.report import panels as content
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.report.panels import ERROR, TIME, Curve, Panel, Picture, Plot
from tsobs_ros.report.summary import About, Table
from tsobs_ros.style import GRID, INK, MUTED

_VERDICTS = {Level.OK: "✓ Good:", Level.WARN: "! Mind:", Level.ERROR: "✗ Bad:"}
_MAX_ROWS = 200
_NUMBER = ' class="number"'
# Nothing is fetched from anywhere: the page needs only itself.
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"


def write_html(picture: Picture, path: Path, about: About | None = None) -> None:
    """Write a page that needs nothing but itself: no network, no second file.

    plotly.js is in it, compressed, which is most of the page: with a script beside it, a page
    that is sent or moved alone would be blank.

    Args:
        picture: What is shown.
        path: The page; it is replaced.
        about: What it has besides.

    Raises:
        OSError: The page cannot be written.
    """
    about = about or About()
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
        page.writelines(_head(picture, about))
        page.write(figures)
        page.writelines(_tail(about))
        for name, data in (("library", get_plotlyjs()), ("content", _json(drawn))):
            page.write(f'<script type="text/plain" id="{name}">{_packed(data)}</script>\n')
        page.write(f"<script>\n{script}</script>\n</body>\n</html>\n")


def _packed(text: str) -> str:
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode("ascii")


def _json(data: Any) -> str:
    return json.dumps(data, separators=(",", ":"), allow_nan=False)


def _head(picture: Picture, about: About) -> Iterator[str]:
    yield f"<header>\n<h1>{escape(picture.name)}</h1>\n"
    if about.sentences:
        kind = {Level.OK: "good", Level.WARN: "warn"}.get(about.level, "error")
        verdict = _VERDICTS.get(about.level, _VERDICTS[Level.ERROR])
        text = escape(" ".join(about.sentences))
        yield f'<p class="verdict {kind}"><strong>{verdict}</strong>{text}</p>\n'
    yield f'<p class="muted">{escape(picture.headline)}</p>\n</header>\n<main>\n'
    yield '<p id="failure" role="status"></p>\n'
    yield (
        "<noscript><p>The figures need JavaScript; report.png and report.pdf have them too."
        "</p></noscript>\n"
    )


def _tail(about: About) -> Iterator[str]:
    for table in about.tables:
        yield f"<section>\n<h2>{escape(table.title)}</h2>\n"
        yield f'<div class="wide" tabindex="0" role="region" aria-label="{escape(table.title)}">'
        yield f"<table>{_table(table)}</table></div>\n</section>\n"
    if about.facts:
        facts = "".join(
            f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in about.facts
        )
        yield f"<section>\n<h2>What it was made with</h2>\n<dl>{facts}</dl>\n</section>\n"
    if about.remarks:
        yield "<section>\n<h2>Remarks</h2>\n"
        yield "".join(f"<p>{escape(remark)}</p>\n" for remark in about.remarks)
        yield "</section>\n"
    yield "</main>\n"


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
    """Return the panels' elements, and what is drawn into them."""
    drawn: list[dict[str, Any]] = []
    rows = []
    for panel in picture.panels:
        plots = [panel.values, *([panel.error] if panel.error is not None else [])]
        figures = []
        for plot in plots:
            identity = f"plot{len(drawn)}"
            drawn.append(_drawn(plot, picture, identity))
            last = plot is plots[-1]
            figures.append(_figure(plot, panel, identity, panel.remark if last else ()))
        single = "" if len(plots) > 1 else " single"
        rows.append(f'<div class="row{single}">{"".join(figures)}</div>\n')
    groups = {
        trace["legendgroup"]: trace["meta"]
        for one in drawn
        for trace in one["data"]
        if "legendgroup" in trace
    }
    keys = "".join(
        f'<button type="button" aria-pressed="true" disabled data-group="{escape(group)}">'
        f'<span class="swatch" style="background:{colour}"></span>{escape(group)}</button>'
        for group, colour in groups.items()
    )
    bar = f'<div class="keys" role="group" aria-label="curves to show">{keys}</div>\n'
    return f"<section>\n{bar}{''.join(rows)}</section>\n", drawn


def _figure(plot: Plot, panel: Panel, identity: str, remark: Sequence[str]) -> str:
    name = f"{plot.label} [{panel.unit}]" if panel.unit else plot.label
    if plot.label == ERROR:
        name = f"{panel.values.label}: {name}"
    notes = [f"– – {dashed[1]}" for dashed in (plot.level, plot.other) if dashed is not None]
    text = escape("  ·  ".join([*notes, *remark]))
    own = "".join(
        f'<li><span class="swatch" style="background:{line.colour}"></span>{escape(line.name)}</li>'
        for line in plot.lines
    )
    legend = f'<ul class="own">{own}</ul>' if len(plot.lines) > 1 else ""
    return (
        f'<figure><figcaption><h3>{escape(name)}</h3><p class="remark">{text}</p>{legend}'
        f'</figcaption><div class="plot" id="{identity}" role="img" '
        f'aria-label="{escape(f"{name} over {plot.axis}. {text}")}"></div></figure>'
    )


def _drawn(plot: Plot, picture: Picture, identity: str) -> dict[str, Any]:
    follows = plot.axis == TIME
    axis = {"zeroline": False, "gridcolor": GRID, "fixedrange": False}
    layout: dict[str, Any] = {
        "margin": {"l": 56, "r": 10, "t": 6, "b": 34},
        "font": {"color": INK, "size": 12, "family": "system-ui, sans-serif"},
        "showlegend": False,
        "hovermode": "x",
        "xaxis": axis
        | ({"range": list(picture.time_range)} if follows else {})
        | {"title": {"text": plot.axis, "standoff": 4, "font": {"size": 11, "color": MUTED}}},
        "yaxis": axis | {"range": list(plot.limits), "nticks": 5},
        "shapes": list(_shapes(plot, picture)),
    }
    if plot.strips:
        names = list(dict.fromkeys(strip.name for strip in plot.strips))
        layout["yaxis"] |= {"tickvals": list(range(len(names))), "ticktext": [*map(escape, names)]}
        layout["yaxis"]["automargin"] = True
    return {"id": identity, "data": list(_traces(plot)), "layout": layout, "follows": follows}


def _traces(plot: Plot) -> Iterator[dict[str, Any]]:
    blue = content.ESTIMATE_COLOUR
    for sigmas, times, lower, upper in plot.bands or ():
        x, y = _outline(times, lower, upper)
        fill = {"fill": "toself", "fillcolor": "rgba(0, 114, 178, 0.15)", "hoverinfo": "skip"}
        yield _trace(f"bound {sigmas:g}σ", Curve(x, y), {"width": 0}, "#9cc6e0", **fill)
    if plot.dots is not None:
        name = plot.label if plot.estimate is None else "measured"
        grey = content.MEASUREMENT_COLOUR
        if plot.dense:
            yield _trace(name, plot.dots, {"width": 0.7}, grey)
        else:
            mark = {"size": 2.5, "color": grey}
            yield _trace(name, plot.dots, None, grey, mode="markers", marker=mark)
    if plot.truth is not None:
        yield _trace("true", plot.truth, {"width": 4}, content.TRUTH_COLOUR)
    if plot.rival is not None:
        line = {"width": 1.2, "dash": "dot"}
        yield _trace("EKF", plot.rival, line, content.RIVAL_COLOUR)
    if plot.estimate is not None:
        yield _trace("estimated", plot.estimate, {"width": 1.5}, blue)
    if plot.other is not None:
        curve, name = plot.other
        yield _trace(name, curve, {"width": 1, "dash": "dash"}, MUTED)
    for one in plot.lines:
        yield _trace(one.name, one.curve, {"width": 1.3}, one.colour)
    names = list(dict.fromkeys(strip.name for strip in plot.strips))
    for strip in plot.strips[:_MAX_ROWS]:
        place = float(names.index(strip.name))
        ends = Curve(np.array([strip.begin, strip.end]), np.full(2, place))
        colour = content.LEVEL_COLOURS.get(strip.level, content.EVENT_COLOUR)
        yield _trace(f"{strip.name}, {strip.level.name}", ends, {"width": 14}, colour)


def _trace(
    name: str, curve: Curve, line: Mapping[str, Any] | None, colour: str, **style: Any
) -> dict[str, Any]:
    trace = {
        "type": "scatter",
        "mode": "lines",
        "name": escape(name),
        "x": _encoded(curve.times),
        "y": _encoded(curve.values),
        **({} if line is None else {"line": {"color": colour, **line}}),
        **style,
    }
    # A curve of one of these names is in many panels, and switched in all of them.
    if name in _SHARED:
        trace |= {"legendgroup": name, "meta": colour}
    return trace


_SHARED = ("measured", "true", "estimated", "EKF", "bound 1σ", f"bound {SIGMAS:g}σ")


def _encoded(values: Array) -> dict[str, str]:
    """Return numbers as plotly.js reads them; single precision is finer than any screen."""
    data = np.asarray(values, dtype="<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(data).decode("ascii")}


def _outline(times: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return the outlines of a band, with NaN between its parts."""
    known = np.isfinite(lower) & np.isfinite(upper)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    x, y = [], []
    for begin, end in edges.reshape(-1, 2).tolist():
        own = slice(begin, end)
        x += [times[own], times[own][::-1], [np.nan]]
        y += [upper[own], lower[own][::-1], [np.nan]]
    return np.concatenate([[], *x[:-1]]), np.concatenate([[], *y[:-1]])


def _shapes(plot: Plot, picture: Picture) -> Iterator[dict[str, Any]]:
    if plot.axis == TIME:
        # One path for all: a shape for each would make a page of many events slow.
        if picture.unsettled:
            colour = content.SETTLING_COLOUR
            yield _area(picture.unsettled) | {"fillcolor": colour, "line": {"width": 0}}
        if plot.spans:
            spans = _area(plot.spans) | {"fillcolor": content.EVENT_COLOUR, "opacity": 0.2}
            yield spans | {"line": {"width": 0}}
        jumps = [event.time for event in picture.events if event.what != "start"]
        if jumps:
            path = " ".join(f"M{time:.4f},0 L{time:.4f},1" for time in jumps)
            line = {"color": content.EVENT_COLOUR, "dash": "dot", "width": 1}
            yield {"type": "path", "xref": "x", "yref": "paper", "path": path, "line": line}
    for sign in (-1.0, 1.0) if plot.level is not None else ():
        assert plot.level is not None
        height = sign * plot.level[0]
        line = {"color": MUTED, "dash": "dash", "width": 1}
        ends = {"xref": "paper", "x0": 0, "x1": 1, "yref": "y", "y0": height, "y1": height}
        yield {"type": "line", "line": line, **ends}


def _area(spans: Sequence[tuple[float, float]]) -> dict[str, Any]:
    path = " ".join(f"M{a:.4f},0 L{a:.4f},1 L{b:.4f},1 L{b:.4f},0 Z" for a, b in spans)
    return {"type": "path", "xref": "x", "yref": "paper", "path": path, "layer": "below"}
