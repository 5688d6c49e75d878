# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The report on a bag: a table, a figure, an interactive page, and the same numbers as JSON."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from tsobs_ros.design.file import DesignFile
from tsobs_ros.errors import TsobsError, missing_library, printable
from tsobs_ros.replay.designs import choose_designs
from tsobs_ros.replay.health import (
    EventFinder,
    Health,
    HealthSum,
    JointEvent,
    list_events,
    map_events,
)
from tsobs_ros.report.comparison import (
    EkfComparison,
    compare_with_ekf,
    metrics_options,
    render_metrics,
)
from tsobs_ros.report.metrics import RunMetrics, measure
from tsobs_ros.report.panels import picture
from tsobs_ros.report.quantities import outputs_of, quantities_of
from tsobs_ros.report.run import RecordedRun, RunParts, find_observer


class ReportError(TsobsError, RuntimeError):
    """A report cannot be made or written."""


@dataclass(frozen=True)
class BagReport:
    """A report that has been made.

    Attributes:
        bag: The bag it is on.
        joint: The joint.
        design: The design that the estimates were made with.
        metrics: Of the recorded estimates.
        health: Of the estimates, None if it was not recorded.
        events: Changes of their health.
        begin: Stamp that times count from [ns].
        comparison: With an EKF on the same measurements, if asked for.
        files: The files that were written, in order of interest.
        remarks: Limits of the report itself.
    """

    bag: Path
    joint: str
    design: DesignFile
    metrics: RunMetrics
    health: Health | None
    events: tuple[JointEvent, ...]
    begin: int
    comparison: EkfComparison | None
    files: tuple[Path, ...]
    remarks: tuple[str, ...]

    def text(self) -> str:
        """Return the report for a terminal."""
        quantities = quantities_of(self.design.design.request)
        table = render_metrics(self.metrics, self.comparison, quantities)
        what = f"{self.joint}, design {self.design.name} ({self.design.identity})"
        parts = [f"{printable(f'{self.bag}: {what}')}\n{table}"]
        if self.health is not None:
            events = list_events(self.events, self.begin)
            parts.append("\n".join(map(printable, [*self.health.lines(), *events])))
        if self.remarks:
            parts.append("\n".join(map(printable, self.remarks)))
        parts.append("\n".join(printable(f"wrote {path}") for path in self.files))
        return "\n\n".join(parts)

    def as_mapping(self) -> dict[str, Any]:
        """Return the report as plain data that JSON can hold."""
        return {
            "bag": str(self.bag),
            "joint": self.joint,
            "design": {"file": self.design.name, "sha256": self.design.sha256},
            **self.metrics.as_mapping(),
            "health": None
            if self.health is None
            else {**self.health.as_mapping(), **map_events(self.events, self.begin)},
            "ekf": None if self.comparison is None else self.comparison.as_mapping(),
            "files": [str(path) for path in self.files],
            "remarks": list(self.remarks),
        }


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
) -> BagReport:
    """Measure a bag and write `report.png`, `report.html` and `report.json`.

    Args:
        bag: Bag folder or MCAP file.
        output: Folder for the files; it is created, files of the same names are replaced.
        design: File of the design that the estimates were made with; if None, the one in the bag,
            else the shipped one.
        other_design: Whether that may be another one than the bag's.
        ekf: Whether to run an EKF over the same measurements; takes about a second a minute.
        html: Whether to write the page too; it is left out, with a remark, without plotly.
        joint: Name of the joint in the bag; None if there is one only.
        namespace: Namespace of the topics, for a bag with several arms.

    Raises:
        BagReadError: The bag cannot be read or lacks what a report needs.
        DesignFileError: The design is none, or not that of the bag; or that is not known here.
        ReportError: A file cannot be written.
        ModuleNotFoundError: matplotlib is not installed.
    """
    found = find_observer(bag, namespace=namespace)
    joint, ran = found.choose(joint), found.ran
    given = [] if design is None else [design]
    joints = tuple(one for one in found.joints if one in ran.designs) or (joint,)
    # Only the design of the joint that the report is on is in question.
    named = [f"{joint}={path}" for path in given]
    ((*chosen,),) = choose_designs(bag, ran, joints, named, others_allowed=other_design).values()
    files = dict(zip(joints, chosen, strict=True))
    file = files[joint]
    parts = found.run(joint, file.design.request)
    run = parts.run
    options = metrics_options(file.design)
    health = _HealthOf(parts)
    metrics = measure(health, options)
    comparison = None
    if ekf and parts.has_truth:
        comparison = compare_with_ekf(run, metrics, bag, files, ran.settings(), options)
    page = html and find_spec("plotly") is not None
    remarks = [*ran.doubt(given), *ran.remarks]
    if not parts.has_truth:
        remarks.append("note: the bag has no ground truth, so there are bounds but no errors")
    if run.passes > 1:
        remarks.append(f"note: time restarted {run.passes - 1} times; this is the longest pass")
    if not metrics.windows:
        remarks.append("note: the run is too short to have a settled part, so there are no errors")
    if html and not page:
        remarks.append(f"note: no report.html: {missing_library('plotly')}")
    outputs = ["report.png", *(["report.html"] if page else []), "report.json"]
    written = tuple(output / name for name in outputs)
    report = BagReport(
        bag=bag,
        joint=run.joint,
        design=file,
        metrics=metrics,
        health=health.sum.result(),
        events=tuple(health.finder.events),
        begin=run.origin,
        comparison=comparison,
        files=written,
        remarks=tuple(remarks),
    )
    try:
        output.mkdir(parents=True, exist_ok=True)
        # Here, so that matplotlib and plotly are needed only for what they draw.
        from tsobs_ros.report.figures import draw_run

        measured = outputs_of(file.design.request)
        shown = picture(parts, metrics, options.innovation_stds, measured)
        draw_run(shown, written[0])
        if page:
            from tsobs_ros.report.page import write_html

            write_html(shown, written[1])
        text = json.dumps(report.as_mapping(), indent=2, allow_nan=False)
        written[-1].write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise ReportError(f"cannot write the report: {error}") from error
    return report


class _HealthOf:
    """The parts of a run, whose health is gathered as they pass."""

    def __init__(self, parts: RunParts) -> None:
        self._parts = parts
        self.sum, self.finder = HealthSum(), EventFinder([parts.run.joint], parts.run.topic)

    def __iter__(self) -> Iterator[RecordedRun]:
        for part in self._parts:
            if part.health is not None:
                stamps, values = part.health
                self.finder.add(stamps, stamps, values[:, np.newaxis])
                self.sum.add(values)
            yield part
