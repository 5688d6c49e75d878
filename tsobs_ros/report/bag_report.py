# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The report on a bag: a table, a figure, an interactive page, and the same numbers as JSON."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from tsobs_ros import __version__
from tsobs_ros.design.file import checksum, identity
from tsobs_ros.design.record import Design
from tsobs_ros.errors import BagReadError, printable
from tsobs_ros.files import require_new, written_whole
from tsobs_ros.replay.health import JointEvent, find_events, health_of, list_events, map_events
from tsobs_ros.replay.source import BagSource
from tsobs_ros.report.comparison import about_ekfs, aligned, best_ekf, metrics_cells, ratio
from tsobs_ros.report.diagnosed import Diagnosed, diagnose
from tsobs_ros.report.metrics import RunMetrics, innovation_std, measure
from tsobs_ros.report.panels import Table, picture
from tsobs_ros.report.run import RecordedRun, diagnostics, read_run
from tsobs_ros.report.summary import summarise
from tsobs_ros.series import NANOSECONDS


def make_bag_report(
    bag: Path,
    output: Path,
    *,
    design: str | None = None,
    other_design: bool = False,
    ekf: bool = True,
    joint: str | None = None,
    topic: str | None = None,
    force: bool = False,
    notes: Mapping[str, str] = MappingProxyType({}),
) -> tuple[dict[str, Any], str]:
    """Measure a bag and write `report.html`, `report.png` and `report.json` to a folder.

    Returns the report as plain data, as in `report.json`, and as text for a terminal.

    Args:
        bag: Bag folder or MCAP file.
        output: The folder, which is created.
        design: File of the design that the estimates were made with; if None, the one in the bag,
            else the shipped one.
        other_design: Whether the design may differ from the bag's.
        ekf: Whether to run EKFs over the same measurements.
        joint: Name of the joint; None if there is one only.
        topic: Name of the measurements' topic, for a bag with several arms.
        force: Whether to replace files of these names.
        notes: Other facts about the run's origin, such as a seed, by name.

    Raises:
        BagReadError: The bag cannot be read or lacks data that a report needs.
        DesignFileError: The file is no design, or not that of the bag; or the bag's is not unique.
        OutputError: A file exists already, or cannot be written.
        ModuleNotFoundError: matplotlib or plotly is not installed.
    """
    # Imported here, so that matplotlib and plotly are needed only for drawing.
    from tsobs_ros.report.figures import draw_run
    from tsobs_ros.report.page import write_html

    source = BagSource(bag, topic=topic, joints=[joint] if joint else ())
    files = [output / f"report.{kind}" for kind in ("png", "html", "json")]
    require_new(files, force=force)
    given = [] if design is None else [design]
    ((used, *others),) = source.choose_designs(given, others_allowed=other_design).values()
    if others:
        raise BagReadError(f"{bag}: several joints, choose one of {', '.join(source.joints)}")
    run, expected = read_run(source, used.request), innovation_std(used)
    metrics = measure(run, expected)
    health, events, health_lines = None, list[JointEvent](), tuple[str, ...]()
    if recorded := run.parts.get("health"):
        health = health_of(recorded.values)
        stamped = recorded._replace(log_times=recorded.stamps)
        events = find_events(
            run.joint, run.topic, stamped, stale_after=source.ran.settings().stale_after
        )
        health_lines = () if health is None else health.lines()
    diagnosed = diagnose(diagnostics(source), run.origin, metrics.last)
    rival = None
    if ekf and "true_state" in run.parts:
        rival = best_ekf(source, used, source.ran.settings())
    shown = picture(run, metrics, expected, diagnosed=diagnosed, rival=rival and rival[2])
    until = int(run.part("measurements").stamps.max())
    summary = summarise(metrics, health, diagnosed, shown.timing, events, until)
    remarks = [one for one in source.remarks if one.startswith("warning: ")]
    remarks += [*source.ran.doubt(given), *source.ran.remarks, *_limits(run, metrics, diagnosed)]
    cells = metrics_cells(metrics, rival and rival[1])
    note = f"Errors over the {metrics.settled_time:.1f} s that count as settled."
    note += f" {about_ekfs([rival[0]])}." if rival else ""
    mapping = {
        "bag": str(bag),
        "joint": run.joint,
        "design": {"file": used.file, "sha256": checksum(used)},
        "version": __version__,
        "summary": {"level": summary.level.name, "text": summary.text},
        **metrics.as_mapping(),
        "health": health and {**health.as_mapping(), **map_events(events, run.origin)},
        "timing": shown.timing._asdict(),
        "diagnostics": diagnosed.as_mapping(),
        "ekf": rival and _compared(metrics, *rival[:2]),
        "files": [str(path) for path in files],
        "remarks": remarks,
    }
    tables = [
        Table("Errors and bounds", cells[0], cells[1:], 2, note),
        *_tables(run, diagnosed, events),
        Table(
            "What it was made with",
            ("what", "value"),
            [*_facts(bag, source, used), *notes.items()],
            2,
        ),
        Table("Remarks", ("",), [(line,) for line in [*health_lines, *remarks]], 1),
    ]
    with written_whole(output, force=force) as folder:
        draw_run(shown, folder / files[0].name)
        write_html(shown, folder / files[1].name, tables, summary=summary)
        text = json.dumps(mapping, indent=2, allow_nan=False)
        (folder / files[2].name).write_text(text + "\n", encoding="utf-8")
    what = f"{run.joint}, design {used.file} ({identity(used)})"
    parts = [
        [f"{bag}: {what}", summary.text, shown.headline],
        aligned(cells),
        [note, *health_lines],
        list_events(events, run.origin),
        remarks,
        [f"wrote {path}" for path in files],
    ]
    return mapping, "\n\n".join("\n".join(map(printable, part)) for part in parts if part)


def _compared(ours: RunMetrics, method: str, theirs: RunMetrics) -> dict[str, Any]:
    """Return the errors of an EKF, and ours relative to them, as plain data."""
    pairs = list(zip(ours.quantities, theirs.quantities, strict=True))
    return {
        "method": method,
        "rmse": {other.quantity.key: other.rmse for _, other in pairs},
        "normalised_rmse": theirs.normalised_rmse,
        "ratio": {one.quantity.key: ratio(one.rmse, other.rmse) for one, other in pairs},
        "normalised_ratio": ratio(ours.normalised_rmse, theirs.normalised_rmse),
    }


def _tables(run: RecordedRun, diagnosed: Diagnosed, events: Sequence[JointEvent]) -> list[Table]:
    """Return the tables of faults, events and rejected measurements."""
    faults = [
        (
            one.output or run.joint,
            one.kind,
            one.level.name,
            f"{one.begin:.1f}",
            f"{one.end:.1f}",
            f"{one.magnitude:.3g} {one.unit}",
        )
        for one in diagnosed.faults
    ]
    logged = [
        (f"{(time - run.origin) / NANOSECONDS:.1f}", event.level.name, event.text)
        for _, time, event in events
    ]
    rejected = [(reason, str(count)) for reason, count in diagnosed.rejected.items()]
    columns = ("sensor", "fault", "level", "since [s]", "until [s]", "size")
    return [
        Table("Faults of sensors", columns, faults, 3),
        Table("Events", ("time [s]", "level", "what"), logged, 3),
        Table("Rejected measurements", ("reason", "number"), rejected),
    ]


def _limits(run: RecordedRun, metrics: RunMetrics, diagnosed: Diagnosed) -> Iterator[str]:
    if "true_state" not in run.parts:
        yield "note: the bag has no ground truth, so there are bounds but no errors"
    if run.passes > 1:
        yield f"note: this is the longest of {run.passes} passes of time"
    if not metrics.windows:
        yield f"note: there are no errors, as the run is {metrics.unsettled}"
    if not diagnosed.count:
        yield "note: the bag has no diagnostics of the observer: no faults, rejects and ticks"


def _facts(bag: Path, source: BagSource, design: Design) -> Iterator[tuple[str, str]]:
    margin, solver = design.certificate.worst.margin, design.solver
    values = ", ".join(f"{name} = {value}" for name, value in source.ran.parameters.items())
    yield "bag", str(bag)
    yield "joint", source.joints[0]
    yield "design", f"{design.file}, SHA-256 {checksum(design)}"
    yield "certificate", f"holds, checked now; smallest margin {margin:.3g} 1/s"
    yield "rate of the design", f"{design.request.rate:g} Hz"
    yield "solver", f"{solver.name} {solver.version}, {solver.status}"
    yield "parameters of the observer", values or "not recorded"
    yield "version of this report", f"tsobs_ros {__version__}"
