# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Design and request files: plain, versioned YAML that people can read.

Floats are written with the shortest text that reads back to the same number, so a design that
was saved and loaded is the same design to the last bit. Loading re-checks the certificate. The
file of a T–S system given by its matrices has a top-level `system`; the file of an arm has none.
"""

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Any, TypeAlias

import numpy as np

from tsobs_ros.checks import Array, as_matrix, check_names, expect, shown
from tsobs_ros.design.record import Design, SolverReport
from tsobs_ros.design.request import AnyRequest, ArmRequest, TorqueDisturbance, TSRequest
from tsobs_ros.errors import DesignFileError
from tsobs_ros.files import write_whole
from tsobs_ros.model.arm import DIRECT
from tsobs_ros.model.fuzzy import Membership, RuleBase, membership
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.schema import decode, encode, naming, within
from tsobs_ros.yaml_files import MAX_BYTES, read_text, read_yaml, yaml_mapping, yaml_text

FilePath: TypeAlias = str | PathLike[str]
Value: TypeAlias = bool | int | float | str
"""A parameter's value."""

VERSION = 1
_ANSWER = ("gain", "certificate", "solver")
"""Entries of a design file other than its request."""
_ARM_PARAMETERS = ("link_inertia", "motor_inertia", "stiffness", "gravity_torque")
"""Parameters of an arm that have no default in a file; dampings default to 0."""
IDENTITY_LENGTH = 12
"""Number of digits of a checksum that are shown to people."""
_ARM, _SYSTEM = "tsobs_ros design", "tsobs_ros T-S design"
_BESIDE_SYSTEM = (
    "names", "units", "disturbance", "process_noise", "measurement_std", "rate", "decay_rate",
    "initial_std", "certify_uncertainty", "D_s", "uncertainty",
)  # fmt: skip
"""Entries in the file of a T–S system after `system`, in this order: the rest of its request."""
_ONLY_OF_SYSTEMS = {"system", "names", "units", "D_s"}
"""Entries that no arm's request has."""
_HEADERS = {
    _ARM: """\
# A certified observer design for an arm with an elastic joint, made by `tsobs design`.
# Units are SI and radians. P and K are in design coordinates [q1, q1', (k/J1) q2, (k/J1) q2',
# disturbance states]. The observer re-checks every inequality before it uses them, so a file
# that was edited by hand is refused unless its certificate still holds.
""",
    _SYSTEM: """\
# A certified observer design for a Takagi-Sugeno system, made by `tsobs design`. P and K are in
# the coordinates [states, disturbance states]. Loading re-checks every inequality, so a file that
# was edited by hand is refused unless its certificate still holds.
""",
}


def save_design(design: Design, path: FilePath) -> None:
    """Write a design file; an existing file is replaced only once the new one is complete.

    Raises:
        DesignFileError: The file cannot be written.
        ModelError: It is not a design.
    """
    expect("design", design, Design)
    write_whole(path, design_text(design), DesignFileError)


def design_text(design: Design) -> str:
    """Return the content of a design's file: the text as loaded, else the text to be written."""
    if design.source:
        return design.source
    request = design.request
    kind = _ARM if isinstance(request, ArmRequest) else _SYSTEM
    answer = {
        "gain": {"K": design.plain_gain},
        "certificate": {"P": design.P},
        "solver": design.solver,
    }
    data = {"format": kind, "version": VERSION, **request_entries(request), **encode(answer)}
    return yaml_text(_HEADERS[kind], data)


def request_entries(request: AnyRequest) -> dict[str, Any]:
    """Return the entries of a file that describe a request, as plain data."""
    if isinstance(request, ArmRequest):
        return {"design": arm_entries(request)}
    given: dict[str, Any] = {"system": _system_entries(request)}
    given |= {name: getattr(request, name) for name in _BESIDE_SYSTEM}
    return {name: entry for name, entry in encode(given).items() if entry not in (None, {})}


def load_design(path: FilePath | None = None, text: str | None = None) -> Design:
    """Read the design file of an arm or of a T–S system and re-check its certificate.

    Args:
        path: The file; None for the design that comes with the package.
        text: Content of the file, if it is known already.

    Raises:
        DesignFileError: The file is missing, too large, not YAML, or not a design; the message
            names the entry, the expected value and the actual one.
        CertificateError: The certificate does not hold; the message names each failing
            inequality, its vertex and its margin.

    >>> load_design().certificate.holds
    True
    """
    design = parse_design(config_path(SHIPPED_DESIGN) if path is None else path, text)
    design.certificate.require(design.file)
    return design


def checksum(design: Design) -> str:
    """Return the SHA-256 of a design's file, as `sha256sum` prints it."""
    return hashlib.sha256(design_text(design).encode()).hexdigest()


def identity(design: Design) -> str:
    """Return the first digits of a design's checksum, for people."""
    return checksum(design)[:IDENTITY_LENGTH]


@dataclass
class PublishedDesign:
    """A design file as an observer publishes it, and the joints that are observed with it."""

    joints: list[str]
    file: str
    text: str

    @property
    def sha256(self) -> str:
        """Checksum of the file."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def __str__(self) -> str:
        return f"{self.file:.200} (SHA-256 {self.sha256:.{IDENTITY_LENGTH}})"


@dataclass(kw_only=True)
class ObserverRecord:
    """Configuration of a running observer: the full name of its measurement topic, its designs, and
    the parameters that affect estimates.

    The node publishes it as JSON on its latched topic `design`, so that a bag holds everything that
    its estimates were made with. It has design files to the byte, for checksum and strict loader.
    """

    format: str = "tsobs_ros observer"
    version: int = 1
    measurements: str
    designs: list[PublishedDesign]
    parameters: dict[str, Value]


def record_text(
    measurements: str,
    joints: Sequence[str],
    designs: Sequence[Design],
    parameters: Mapping[str, Value],
) -> str:
    """Return the text of a record, made from each joint's name and design."""
    published: dict[tuple[str, str], PublishedDesign] = {}
    for joint, design in zip(joints, designs, strict=True):
        key = design.file, design_text(design)
        published.setdefault(key, PublishedDesign([], *key)).joints.append(joint)
    record = ObserverRecord(
        measurements=measurements, designs=list(published.values()), parameters=dict(parameters)
    )
    return json.dumps(encode(record))


def read_record(text: str) -> ObserverRecord:
    """Return the record in a text from any source; the designs in it are not checked.

    Raises:
        DesignFileError: The text is too large or not a record.
    """
    if len(text) > MAX_BYTES:
        raise DesignFileError(f"larger than {MAX_BYTES} bytes")
    try:
        record = decode(json.loads(text), ObserverRecord)
    except (ValueError, RecursionError) as error:
        raise DesignFileError(f"no record of an observer: {error}") from error
    if (record.format, record.version) != (ObserverRecord.format, ObserverRecord.version):
        raise DesignFileError(
            f"expected format {ObserverRecord.format!r} of version {ObserverRecord.version}, got "
            f"{record.format[:60]!r} of version {record.version}"
        )
    return record


def parse_design(path: FilePath, text: str | None = None) -> Design:
    """Read a design file like `load_design`, but without judging its certificate."""
    text = read_text(path) if text is None else text
    data = yaml_mapping(text, path)
    if "format" not in data and "certificate" not in data:
        raise DesignFileError(
            f"{path}: format: missing; if this is a request, `tsobs design` makes a design of it"
        )
    kind, version = data.pop("format", None), data.pop("version", None)
    if kind not in (_ARM, _SYSTEM):
        raise DesignFileError(
            f"{path}: format: expected {_ARM!r} or {_SYSTEM!r}, got {shown(kind)}"
        )
    # True == 1 == 1.0 in Python, but only one of them is a version.
    if type(version) is not int or version != VERSION:
        raise DesignFileError(f"{path}: version: expected {VERSION}, got {shown(version)}")
    with naming(path):
        answer = decode({name: data.pop(name) for name in _ANSWER if name in data}, _Answer)
        is_arm = kind == _ARM
        request = _arm_request(data) if is_arm else _system_request(data)
        p, n = request.flow.output_matrix.shape
        K = as_matrix("gain.K", answer.gain.K, (n,) if is_arm and p == 1 else (n, p))
        P = as_matrix("certificate.P", answer.certificate.P, (n, n))
        design = Design(request, P, K.reshape(n, p), answer.solver)
        object.__setattr__(design, "file", str(path))
        object.__setattr__(design, "source", text)
        # Evaluated here, so that the error for numbers that allow no proof names the file.
        _ = design.certificate
        return design


def load_request(path: FilePath) -> AnyRequest:
    """Read a request for `tsobs design` from a YAML file, which may have comments.

    The entries of an arm's request may stand alone or under `design`. Omitted entries keep their
    defaults, but if an `arm` is given, only its dampings may be omitted.

    Raises:
        DesignFileError: As for `load_design`, or the file is a design.

    >>> from tsobs_ros.resources import config_path
    >>> load_request(config_path("ts_example.request.yaml")).model.rule_count
    2
    """
    data = read_yaml(path)
    found = [name for name in ("format", *_ANSWER) if name in data]
    if found:
        raise DesignFileError(
            f"{path}: {found[0]}: expected a request, got a finished design, which nodes run and "
            "`tsobs verify` checks"
        )
    with naming(path):
        request: AnyRequest
        if "design" not in data and not _ONLY_OF_SYSTEMS.isdisjoint(data):
            request = _system_request(data)
        else:
            data = data if "design" in data else {"design": data}
            request = _arm_request(data)
            arm = data["design"].get("arm", _ARM_PARAMETERS)
            # Otherwise the shipped arm's numbers would silently stand for a very different arm's.
            if missing := [name for name in _ARM_PARAMETERS if name not in arm]:
                expected = f"missing; an arm has all of {', '.join(_ARM_PARAMETERS)}"
                raise DesignFileError(f"design.arm.{missing[0]}: {expected}")
            if 0.0 in (request.torque_limit, request.torque_rate_limit):
                # The observer has a parameter of the same name, where 0 means the design's limit.
                raise DesignFileError(
                    "torque_limit, torque_rate_limit: expected numbers above 0, got 0.0; left out "
                    "they are generous for any arm, and 1e9 is no limit"
                )
        # Built here, so that the error for a request without a valid model names the file.
        _ = request.flow
        return request


def arm_entries(request: ArmRequest) -> dict[str, Any]:
    """Return the entries of a file that describe an arm's request."""
    entries: dict[str, Any] = encode(request)
    for name, default in (("torque_disturbance", TorqueDisturbance()), ("torque", DIRECT)):
        entry = entries.pop(name)
        if getattr(request, name) != default:
            entries[name] = entry
    return entries


@dataclass
class _Gain:
    K: Array


@dataclass
class _Certificate:
    P: Array


@dataclass
class _Answer:
    """The entries of a design file other than its request."""

    gain: _Gain
    certificate: _Certificate
    solver: SolverReport


@dataclass
class _ArmFile:
    design: ArmRequest


@dataclass
class _Premise:
    """A premise variable, linear in the state and in scheduled signals."""

    state: Array | None = None
    scheduled: Array | None = None


@dataclass(kw_only=True)
class _Rule:
    """One rule: the memberships of its premises by shape and parameters, and its matrices."""

    if_: dict[str, dict[str, str | float]] = field(default_factory=dict, metadata={"name": "if"})
    A: Array
    B: Array
    C: Array | None = None

    def memberships(self, premises: Collection[str]) -> Iterator[Membership]:
        """Yield the memberships of all premises; a premise that the rule omits is always met."""
        check_names("if", self.if_, premises)
        for name in premises:
            with within(f"if.{name}"):
                parameters: dict[str, Any] = dict(self.if_.get(name, {"shape": "always"}))
                yield membership(parameters.pop("shape", None), parameters)


@dataclass
class _System:
    """A T–S system; see `TSModel`."""

    premises: dict[str, _Premise]
    rules: list[_Rule]
    C: Array
    slope_vertices: list[Array] = field(default_factory=list)

    def model(self) -> TSModel:
        """Return the model; matrices of wrong shapes raise `ModelError`."""
        for name in ("rules", "premises"):
            if not getattr(self, name):
                raise ValueError(f"{name}: expected at least one")
        first = self.rules[0]
        for name, matrix in (("rules[0].A", first.A), ("rules[0].B", first.B), ("C", self.C)):
            if np.ndim(matrix) != 2:
                raise ValueError(f"{name}: expected a matrix, as [[1.0]], got {shown(matrix)}")
        n, p, inputs = len(first.A), len(self.C), first.B.shape[1:]
        if first.A.shape != (n, n):
            raise ValueError(f"rules[0].A: expected a square matrix, got shape {first.A.shape}")
        C = as_matrix("C", self.C, (p, n))
        rules, outputs = [], []
        for i, rule in enumerate(self.rules):
            with within(f"rules[{i}]"):
                as_matrix("A", rule.A, (n, n))
                as_matrix("B", rule.B, (n, *inputs))
                outputs.append(as_matrix("C", C if rule.C is None else rule.C, (p, n)))
                rules.append(tuple(rule.memberships(self.premises)))
        given = [each.scheduled for each in self.premises.values()]
        width = max((np.size(each) for each in given if each is not None), default=0)
        premise, schedule = (np.zeros((len(given), columns)) for columns in (n, width))
        for row, (name, each) in enumerate(self.premises.items()):
            with within(f"premises.{name}"):
                if each.state is None and each.scheduled is None:
                    raise ValueError("expected at least one of state and scheduled")
                for source, rows in (("state", premise), ("scheduled", schedule)):
                    if (values := getattr(each, source)) is not None:
                        rows[row] = as_matrix(source, values, rows[row].shape)
        A, B = (np.array([getattr(rule, name) for rule in self.rules]) for name in "AB")
        own = np.array(outputs) if any(rule.C is not None for rule in self.rules) else None
        return TSModel(A, B, C, RuleBase(tuple(rules)), premise, schedule, own)


def _arm_request(data: Mapping[str, Any]) -> ArmRequest:
    design = data.get("design")
    for name in ("disturbance", "measurement_std", "outputs"):
        if isinstance(design, Mapping) and name in design and design[name] is None:
            raise DesignFileError(f"design.{name}: expected a value, got nothing")
    return decode(data, _ArmFile).design


def _system_request(data: dict[Any, Any]) -> TSRequest:
    """Return the request for a T–S system; values out of range raise `ModelError`."""
    with within("system"):
        if "system" not in data:
            raise DesignFileError("missing; it has the premises, rules and C of a T-S system")
        system = decode(data.pop("system"), _System)
        model = system.model()
    return decode(data, TSRequest, model=model, slope_vertices=system.slope_vertices)


def _system_entries(request: TSRequest) -> dict[str, Any]:
    """Return the system of a request in the form that files have."""
    model, names = request.model, [f"z{j + 1}" for j in range(len(request.model.premise))]
    premises = zip(names, model.premise, model.schedule, strict=True)
    rules: list[dict[str, Any]] = [
        {"if": {name: one.mapping for name, one in zip(names, rule, strict=True)}, "A": A, "B": B}
        for rule, A, B in zip(model.rule_base.rules, model.A, model.B, strict=True)
    ]
    for rule, C in zip(rules, () if model.outputs is None else model.outputs, strict=False):
        rule["C"] = C
    return {
        "premises": {
            name: {"state": state, **({"scheduled": scheduled} if scheduled.size else {})}
            for name, state, scheduled in premises
        },
        "rules": rules,
        "C": model.C,
        "slope_vertices": request.slope_vertices,
    }
