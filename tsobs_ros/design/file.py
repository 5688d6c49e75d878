# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Design files: a design with its proof as plain, versioned YAML that people can read.

Floats are written with the shortest text that reads back to the same number, so a design that
was saved and loaded is the same design to the last bit. Loading re-checks the certificate.
"""

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from tsobs_ros.checks import shown
from tsobs_ros.design.entries import floats, known_only, mapping, number, numbers, text
from tsobs_ros.design.plain import naming_file, read_yaml, write_yaml
from tsobs_ros.design.record import Design, SolverReport
from tsobs_ros.design.request import DesignRequest, DisturbanceTerm
from tsobs_ros.errors import DesignFileError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise

FORMAT = "tsobs_ros design"
VERSION = 1
_HEADER = """\
# A certified observer design for an arm with an elastic joint, made by `tsobs design`.
# Units are SI and radians. P and K are in design coordinates [q1, q1', (k/J1) q2, (k/J1) q2',
# disturbance states]. The observer re-checks every inequality before it uses them, so a file
# that was edited by hand is refused unless its certificate still holds.
"""


def save_design(design: Design, path: Path) -> None:
    """Write a design file; an existing file is replaced only once the new one is complete.

    Raises:
        DesignFileError: The file cannot be written.
    """
    write_yaml(path, _HEADER, _to_mapping(design))


def load_design(path: Path) -> Design:
    """Read a design file and re-check its certificate.

    Raises:
        DesignFileError: The file is missing, too large, not YAML, or not a design; the text
            names the entry, what was expected and what came.
        CertificateError: The certificate does not hold; the text names each inequality, its
            vertex and its margin.
    """
    design = parse_design(path)
    design.certificate.require(str(path))
    return design


def parse_design(path: Path) -> Design:
    """Read a design file without judging its certificate (for `tsobs verify`).

    Raises:
        DesignFileError: As for `load_design`.
    """
    data = read_yaml(path)
    with naming_file(path):
        design = _from_mapping(data)
        # Evaluated here, where numbers no proof can be made of are refused with the file's name.
        _ = design.certificate
        return design


def load_request(path: Path) -> DesignRequest:
    """Read what `tsobs design` is asked for from a commented YAML file.

    The file has the `design` part of a design file; whatever is left out keeps its default.

    Raises:
        DesignFileError: As for `load_design`.
    """
    data = read_yaml(path)
    with naming_file(path):
        request = _request(mapping("design", data.get("design", data)))
        # Built here, so that a request no model can be made of is refused with the file's name.
        _ = request.flow
        return request


def _to_mapping(design: Design) -> dict[str, Any]:
    request = design.request
    return {
        "format": FORMAT,
        "version": VERSION,
        "design": {
            "arm": asdict(request.arm),
            "disturbance": [term.as_mapping() for term in request.disturbance],
            "process_noise": asdict(request.process_noise),
            "measurement_std": request.measurement_std,
            "rate": request.rate,
            "x_max": request.x_max,
            "decay_rate": request.decay_rate,
            "initial_std": list(request.initial_std),
            "uncertainty": dict(request.uncertainty),
            "certify_uncertainty": request.certify_uncertainty,
        },
        "gain": {"K": design.K[:, 0].tolist()},
        "certificate": {"P": design.P.tolist()},
        "solver": asdict(design.solver),
    }


def _from_mapping(data: Mapping[str, Any]) -> Design:
    if data.get("format") != FORMAT:
        raise DesignFileError(f"format: expected {FORMAT!r}, got {shown(data.get('format'))}")
    version = data.get("version")
    # True == 1 == 1.0 in Python, but only one of them is a version.
    if type(version) is not int or version != VERSION:
        raise DesignFileError(f"version: expected {VERSION}, got {shown(version)}")
    known_only("the file", data, ("format", "version", "design", "gain", "certificate", "solver"))
    request = _request(mapping("design", data.get("design")))
    gain = mapping("gain", data.get("gain"))
    certificate = mapping("certificate", data.get("certificate"))
    solver = mapping("solver", data.get("solver"))
    known_only("gain", gain, ("K",))
    known_only("certificate", certificate, ("P",))
    n = request.flow.state_count
    K = numbers("gain.K", gain.get("K"), (n,))
    P = numbers("certificate.P", certificate.get("P"), (n, n))
    return Design(request, P, K[:, np.newaxis], solver_report(solver))


def _request(data: Mapping[str, Any]) -> DesignRequest:
    known_only("design", data, [field.name for field in fields(DesignRequest)])
    values: dict[str, Any] = {}
    if "arm" in data:
        values["arm"] = ElasticJointArm(**floats("design.arm", data["arm"], ElasticJointArm))
    if "process_noise" in data:
        densities = floats("design.process_noise", data["process_noise"], ProcessNoise)
        values["process_noise"] = ProcessNoise(**densities)
    if "disturbance" in data:
        values["disturbance"] = disturbance_terms("design.disturbance", data["disturbance"])
    if "initial_std" in data:
        values["initial_std"] = numbers("design.initial_std", data["initial_std"], (4,)).tolist()
    for name in ("measurement_std", "rate", "x_max", "decay_rate"):
        if name in data:
            values[name] = number(f"design.{name}", data[name])
    if "uncertainty" in data:
        bounds = mapping("design.uncertainty", data["uncertainty"])
        values["uncertainty"] = {
            name: number(f"design.uncertainty.{name}", bounds[name]) for name in bounds
        }
    if "certify_uncertainty" in data:
        values["certify_uncertainty"] = data["certify_uncertainty"]
        if not isinstance(data["certify_uncertainty"], bool):
            raise DesignFileError(
                f"design.certify_uncertainty: expected true or false, "
                f"got {shown(data['certify_uncertainty'])}"
            )
    return DesignRequest(**values)


def disturbance_terms(name: str, data: Any) -> list[DisturbanceTerm]:
    """Return the terms of one channel's disturbance, or raise `DesignFileError`."""
    if not isinstance(data, list):
        raise DesignFileError(f"{name}: expected a list, got {shown(data)}")
    terms = []
    for index, item in enumerate(data):
        place = f"{name}[{index}]"
        entry = dict(mapping(place, item))
        kind = entry.pop("kind", None)
        if not isinstance(kind, str):
            raise DesignFileError(f"{place}.kind: expected a name, got {shown(kind)}")
        parameters = {key: number(f"{place}.{key}", value) for key, value in entry.items()}
        terms.append(DisturbanceTerm(kind, parameters))
    return terms


def solver_report(data: Mapping[str, Any]) -> SolverReport:
    """Return the record of the solver, or raise `DesignFileError`."""
    known_only("solver", data, [field.name for field in fields(SolverReport)])
    return SolverReport(
        **{
            name: text(f"solver.{name}", data.get(name, ""))
            for name in ("name", "version", "status")
        },
        iterations=int(number("solver.iterations", data.get("iterations", 0))),
        seconds=number("solver.seconds", data.get("seconds", 0.0)),
        margin=number("solver.margin", data.get("margin", SolverReport.margin)),
    )
