# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Design files: a design with its proof as plain, versioned YAML that people can read.

Floats are written with the shortest text that reads back to the same number, so a design that
was saved and loaded is the same design to the last bit. Loading re-checks the certificate.
"""

import contextlib
import math
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tsobs_ros.design.record import Design, SolverReport
from tsobs_ros.design.request import DesignRequest, DisturbanceTerm
from tsobs_ros.errors import DesignFileError, ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise

FORMAT = "tsobs_ros design"
VERSION = 1
_LARGEST_FILE = 1 << 20
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
    text = _HEADER + yaml.safe_dump(
        _to_mapping(design), sort_keys=False, default_flow_style=None, width=100
    )
    temporary = path.with_name(path.name + ".tmp")
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise DesignFileError(f"{path}: cannot write the design file: {error.strerror}") from error


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
    data = _read_yaml(path)
    try:
        return _from_mapping(data)
    except DesignFileError as error:
        raise DesignFileError(f"{path}: {error}") from error
    except (ModelError, np.linalg.LinAlgError, OverflowError) as error:
        raise DesignFileError(f"{path}: {error}") from error


def load_request(path: Path) -> DesignRequest:
    """Read what `tsobs design` is asked for from a commented YAML file.

    The file has the `design` part of a design file; whatever is left out keeps its default.

    Raises:
        DesignFileError: As for `load_design`.
    """
    data = _read_yaml(path)
    try:
        return _request(_mapping("design", data.get("design", data)))
    except (DesignFileError, ModelError) as error:
        raise DesignFileError(f"{path}: {error}") from error


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise DesignFileError(f"{path}: larger than {_LARGEST_FILE} bytes, not a design file")
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DesignFileError(f"{path}: no such design file") from error
    except OSError as error:
        raise DesignFileError(f"{path}: cannot read the design file: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DesignFileError(f"{path}: not valid YAML: {first}") from error
    if not isinstance(data, dict):
        raise DesignFileError(f"{path}: expected a mapping, got {type(data).__name__}")
    return data


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
        },
        "gain": {"K": design.K[:, 0].tolist()},
        "certificate": {"P": design.P.tolist()},
        "solver": asdict(design.solver),
    }


def _from_mapping(data: Mapping[str, Any]) -> Design:
    if data.get("format") != FORMAT:
        raise DesignFileError(f"format: expected {FORMAT!r}, got {_short(data.get('format'))}")
    if data.get("version") != VERSION:
        raise DesignFileError(f"version: expected {VERSION}, got {_short(data.get('version'))}")
    _known("the file", data, ("format", "version", "design", "gain", "certificate", "solver"))
    request = _request(_mapping("design", data.get("design")))
    gain = _mapping("gain", data.get("gain"))
    certificate = _mapping("certificate", data.get("certificate"))
    solver = _mapping("solver", data.get("solver"))
    n = request.flow.state_count
    K = _numbers("gain.K", gain.get("K"), (n,))
    P = _numbers("certificate.P", certificate.get("P"), (n, n))
    return Design(request, P, K[:, np.newaxis], _solver(solver))


def _request(data: Mapping[str, Any]) -> DesignRequest:
    _known("design", data, [field.name for field in fields(DesignRequest)])
    values: dict[str, Any] = {}
    if "arm" in data:
        values["arm"] = ElasticJointArm(**_floats("design.arm", data["arm"], ElasticJointArm))
    if "process_noise" in data:
        densities = _floats("design.process_noise", data["process_noise"], ProcessNoise)
        values["process_noise"] = ProcessNoise(**densities)
    if "disturbance" in data:
        values["disturbance"] = _terms(data["disturbance"])
    if "initial_std" in data:
        values["initial_std"] = _numbers("design.initial_std", data["initial_std"], (4,)).tolist()
    for name in ("measurement_std", "rate", "x_max", "decay_rate"):
        if name in data:
            values[name] = _number(f"design.{name}", data[name])
    return DesignRequest(**values)


def _terms(data: Any) -> list[DisturbanceTerm]:
    if not isinstance(data, list):
        raise DesignFileError(f"design.disturbance: expected a list, got {_short(data)}")
    terms = []
    for index, item in enumerate(data):
        name = f"design.disturbance[{index}]"
        entry = dict(_mapping(name, item))
        kind = entry.pop("kind", None)
        if not isinstance(kind, str):
            raise DesignFileError(f"{name}.kind: expected a name, got {_short(kind)}")
        terms.append(
            DisturbanceTerm(kind, {key: _number(f"{name}.{key}", entry[key]) for key in entry})
        )
    return terms


def _solver(data: Mapping[str, Any]) -> SolverReport:
    _known("solver", data, [field.name for field in fields(SolverReport)])
    return SolverReport(
        name=str(data.get("name", "")),
        version=str(data.get("version", "")),
        status=str(data.get("status", "")),
        iterations=int(_number("solver.iterations", data.get("iterations", 0))),
        seconds=_number("solver.seconds", data.get("seconds", 0.0)),
    )


def _mapping(name: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise DesignFileError(f"{name}: expected a mapping, got {_short(value)}")
    return value


def _known(name: str, data: Mapping[str, Any], allowed: Any) -> None:
    unknown = [key for key in data if key not in allowed]
    if unknown:
        raise DesignFileError(
            f"{name}: unknown entry {_short(unknown[0])}, expected some of {', '.join(allowed)}"
        )


def _floats(name: str, data: Any, cls: type) -> dict[str, float]:
    entries = _mapping(name, data)
    _known(name, entries, [field.name for field in fields(cls)])
    return {key: _number(f"{name}.{key}", value) for key, value in entries.items()}


def _number(name: str, value: Any) -> float:
    # YAML reads 1e-4 (without a point) as text; people write it, so it is accepted as a number.
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DesignFileError(f"{name}: expected a number, got {_short(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise DesignFileError(f"{name}: expected a finite number, got {_short(value)}")
    return number


def _numbers(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    def walk(item: Any, depth: int, place: str) -> Any:
        if depth == 0:
            return _number(place, item)
        length = shape[len(shape) - depth]
        if not isinstance(item, list) or len(item) != length:
            got = f"{len(item)}" if isinstance(item, list) else _short(item)
            raise DesignFileError(f"{place}: expected a list of {length}, got {got}")
        return [walk(child, depth - 1, f"{place}[{i}]") for i, child in enumerate(item)]

    return np.array(walk(value, len(shape), name), dtype=np.float64)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
