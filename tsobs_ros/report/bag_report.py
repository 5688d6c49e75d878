# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The report on a bag: a table, a figure, an interactive page, and the same numbers as JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from tsobs_ros import __version__
from tsobs_ros.design.file import DesignFile
from tsobs_ros.errors import TsobsError, missing_library, printable
from tsobs_ros.files import require_new, written_whole
from tsobs_ros.replay.designs import choose_designs
from tsobs_ros.replay.health import (
    Health,
    JointEvent,
    find_events,
    health_of,
    list_events,
    map_events,
)
from tsobs_ros.report.comparison import (
    EkfComparison,
    compare_with_ekf,
    metrics_cells,
    render_metrics,
)
from tsobs_ros.report.diagnosed import Diagnosed, diagnose
from tsobs_ros.report.metrics import RunMetrics, innovation_std, measure
from tsobs_ros.report.panels import TimingSummary, picture
from tsobs_ros.report.run import FoundObserver, RecordedRun
from tsobs_ros.report.summary import About, Summary, Table, summarise
from tsobs_ros.series import NANOSECONDS


class ReportError(TsobsError, RuntimeError):
    """A report cannot be made or written."""


@dataclass(frozen=True)
class BagReport:
    """A report that has been made.

    Attributes:
        bag: The bag it is on.
        design: The design that the estimates were made with.
        run: The recorded run.
        metrics: Of the recorded estimates.
        health: Of the estimates, None if it was not recorded.
        events: Changes of their health, in order.
        comparison: With an EKF on the same measurements, if asked for.
        diagnosed: Faults and rejects, as the recorded diagnostics have them.
        timing: How regular the measurements came.
        facts: Names and values of what it was made with.
        files: The files that were written, in order of interest.
        remarks: Limits of the report itself.
    """

    bag: Path
    design: DesignFile
    run: RecordedRun
    metrics: RunMetrics
    health: Health | None
    events: Sequence[JointEvent]
    comparison: EkfComparison | None
    diagnosed: Diagnosed
    timing: TimingSummary
    facts: Sequence[tuple[str, str]]
    files: Sequence[Path]
    remarks: Sequence[str]

    @cached_property
    def summary(self) -> Summary:
        """How the run went, in words."""
        until = int(self.run.measurements.stamps.max())
        known = self.metrics, self.health, self.diagnosed, self.timing
        return summarise(*known, self.events, until)

    def text(self) -> str:
        """Return the report for a terminal."""
        what = f"{self.run.joint}, design {self.design.name} ({self.design.identity})"
        parts = [f"{printable(f'{self.bag}: {what}')}\n{printable(self.summary.text)}"]
        parts.append(render_metrics(self.metrics, self.comparison))
        if self.health is not None:
            events = list_events(self.events, self.run.origin)
            parts.append("\n".join(map(printable, [*self.health.lines(), *events])))
        if self.remarks:
            parts.append("\n".join(map(printable, self.remarks)))
        parts.append("\n".join(printable(f"wrote {path}") for path in self.files))
        return "\n\n".join(parts)

    def as_mapping(self) -> dict[str, Any]:
        """Return the report as plain data that JSON can hold."""
        health = self.health and {
            **self.health.as_mapping(),
            **map_events(self.events, self.run.origin),
        }
        return {
            "bag": str(self.bag),
            "joint": self.run.joint,
            "design": {"file": self.design.name, "sha256": self.design.sha256},
            "version": __version__,
            "summary": {"level": self.summary.level.name, "text": self.summary.text},
            **self.metrics.as_mapping(),
            "health": health,
            "timing": self.timing._asdict(),
            "diagnostics": self.diagnosed.as_mapping(),
            "ekf": None if self.comparison is None else self.comparison.as_mapping(),
            "files": [str(path) for path in self.files],
            "remarks": list(self.remarks),
        }

    @property
    def about(self) -> About:
        """What its page has beside the panels."""
        head, *rows = metrics_cells(self.metrics, self.comparison)
        note = f"Over the {self.metrics.settled_time:.1f} s that count as settled."
        if self.comparison is not None:
            note += f" {self.comparison.note}."
        faults = [
            (
                one.output or self.run.joint,
                one.kind,
                one.level.name,
                f"{one.begin:.1f}",
                f"{one.end:.1f}",
                f"{one.magnitude:.3g} {one.unit}",
            )
            for one in self.diagnosed.faults
        ]
        begin = self.run.origin
        events = [
            (f"{(one.log_time - begin) / NANOSECONDS:.1f}", one.event.level.name, one.event.text)
            for one in self.events
        ]
        rejected = [(reason, str(count)) for reason, count in self.diagnosed.rejected.items()]
        columns = ("sensor", "fault", "level", "since [s]", "until [s]", "size")
        tables = [
            Table("Errors and bounds", head, rows, 2, note),
            Table("Faults of sensors", columns, faults, 3),
            Table("Events", ("time [s]", "level", "what"), events, 3),
            Table("Rejected measurements", ("reason", "number"), rejected),
        ]
        remarks = (*(() if self.health is None else self.health.lines()), *self.remarks)
        return About(self.summary, tables, self.facts, remarks)


def make_bag_report(
    bag: Path,
    output: Path,
    *,
    design: str | None = None,
    other_design: bool = False,
    ekf: bool = True,
    html: bool = True,
    joint: str | None = None,
    namespace: str | None = None,
    force: bool = False,
    notes: Mapping[str, str] = MappingProxyType({}),
) -> BagReport:
    """Measure a bag and write `report.html`, `report.png` and `report.json`.

    Args:
        bag: Bag folder or MCAP file.
        output: Folder for the files, which is created.
        design: File of the design that the estimates were made with; if None, the one in the bag,
            else the shipped one.
        other_design: Whether that may be another one than the bag's.
        ekf: Whether to run EKFs over the same measurements.
        html: Whether to write the page too; it is left out, with a remark, without plotly.
        joint: Name of the joint in the bag; None if there is one only.
        namespace: Namespace of the topics, for a bag with several arms.
        force: Whether to replace files of these names.
        notes: What else is known of the run's origin, such as a seed, by name.

    Raises:
        BagReadError: The bag cannot be read or lacks what a report needs.
        DesignFileError: The design is none, or not that of the bag; or that is not known here.
        OutputError: A file exists already.
        ReportError: A file cannot be written.
        ModuleNotFoundError: matplotlib is not installed.
    """
    page = html and find_spec("plotly") is not None
    names = ["report.png", *(["report.html"] if page else []), "report.json"]
    written = tuple(output / name for name in names)
    require_new(written, force=force)
    found = FoundObserver(bag, namespace=namespace)
    joint, ran = found.choose(joint), found.ran
    given = [] if design is None else [design]
    joints = tuple(one for one in found.joints if one in ran.designs) or (joint,)
    # Only the design of the joint that the report is on is in question.
    named = [f"{joint}={path}" for path in given]
    ((*chosen,),) = choose_designs(bag, ran, joints, named, other_design).values()
    files = dict(zip(joints, chosen, strict=True))
    file = files[joint]
    run = found.run(joint, file.design.request)
    expected = innovation_std(file.design)
    metrics = measure(run, expected)
    health, events = None, list[JointEvent]()
    if run.health is not None:
        stamps, values = run.health
        health = health_of(values)
        events = find_events([joint], run.topic, stamps, stamps, values[:, np.newaxis])
    diagnosed = diagnose(found.statuses(joint), run.origin, metrics.last)
    comparison, rival = None, None
    remarks = [*ran.doubt(given), *ran.remarks]
    if ekf and run.true_state is not None:
        comparison, rival = compare_with_ekf(run, metrics, bag, files, ran.settings())
    if run.true_state is None:
        remarks.append("note: the bag has no ground truth, so there are bounds but no errors")
    if run.passes > 1:
        often = "once" if run.passes == 2 else f"{run.passes - 1} times"
        remarks.append(f"note: time restarted {often}; this is the longest pass")
    if not metrics.windows:
        remarks.append("note: the run is too short to have a settled part, so there are no errors")
    if not diagnosed.count:
        remarks.append(
            "note: the bag has no diagnostics of the observer, so there are no faults, rejects and "
            "ticks"
        )
    if html and not page:
        remarks.append(f"note: no report.html: {missing_library('plotly')}")
    margin, solver = file.design.certificate.worst.margin, file.design.solver
    parameters = ", ".join(f"{name} = {value}" for name, value in ran.parameters.items())
    facts = (
        ("bag", str(bag)),
        ("joint", joint),
        ("design", f"{file.name}, SHA-256 {file.sha256}"),
        ("certificate", f"holds, checked now; smallest margin {margin:.3g} 1/s"),
        ("rate of the design", f"{run.request.rate:g} Hz"),
        ("solver", f"{solver.name} {solver.version}, {solver.status}"),
        ("parameters of the observer", parameters or "not recorded"),
        *notes.items(),
        ("version of this report", f"tsobs_ros {__version__}"),
    )
    shown = picture(run, metrics, expected, diagnosed=diagnosed, rival=rival)
    ordered = sorted(events, key=lambda one: one.log_time)
    known = file, run, metrics, health, ordered, comparison, diagnosed, shown.timing
    report = BagReport(bag, *known, facts, written, remarks)
    with written_whole(output, ReportError, force=force) as folder:
        # Here, so that matplotlib and plotly are needed only for what they draw.
        from tsobs_ros.report.figures import draw_run

        draw_run(shown, folder / names[0])
        if page:
            from tsobs_ros.report.page import write_html

            write_html(shown, folder / names[1], report.about)
        text = json.dumps(report.as_mapping(), indent=2, allow_nan=False)
        (folder / names[-1]).write_text(text + "\n", encoding="utf-8")
    return report
