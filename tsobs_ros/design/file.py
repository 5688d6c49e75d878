# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Design and request files: plain, versioned YAML that people can read.

Floats are written with the shortest text that reads back to the same number, so a design that
was saved and loaded is the same design to the last bit. Loading re-checks the certificate. A file
about a T–S system given by its matrices has a top-level `system`, one about an arm has not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from os import PathLike
from typing import Any, ClassVar, TypeAlias

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from tsobs_ros.checks import Array, as_matrix, shown
from tsobs_ros.design.record import Design, SolverReport
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, TSRequest
from tsobs_ros.errors import DesignFileError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.fuzzy import Always, Membership, RuleBase, membership
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import Uncertainty, system_uncertainty
from tsobs_ros.schema import Entries, Number, Variant, decode, naming, within
from tsobs_ros.yaml_files import read_yaml, write_yaml

FilePath: TypeAlias = str | PathLike[str]
Request: TypeAlias = ArmRequest | TSRequest

VERSION = 1
_HEADER = """\
# A certified observer design for an arm with an elastic joint, made by `tsobs design`.
# Units are SI and radians. P and K are in design coordinates [q1, q1', (k/J1) q2, (k/J1) q2',
# disturbance states]. The observer re-checks every inequality before it uses them, so a file
# that was edited by hand is refused unless its certificate still holds.
"""
_TS_HEADER = """\
# A certified observer design for a Takagi-Sugeno system, made by `tsobs design`. P and K are in
# the coordinates [states, disturbance states]. Loading re-checks every inequality, so a file that
# was edited by hand is refused unless its certificate still holds.
"""


def save_design(design: Design, path: FilePath) -> None:
    """Write a design file; an existing file is replaced only once the new one is complete.

    Raises:
        DesignFileError: The file cannot be written, or a T–S system has memberships that no file
            can give.
    """
    request = design.request
    if isinstance(request, ArmRequest):
        header, format_name = _HEADER, ArmDesignFile.FORMAT
        entries = {"design": _plain_arm_request(request)}
    else:
        header, format_name = _TS_HEADER, TSDesignFile.FORMAT
        with naming(path):
            entries = _plain_ts_request(request)
    answer = {
        "gain": {"K": design.plain_gain},
        "certificate": {"P": design.P.tolist()},
        "solver": asdict(design.solver),
    }
    write_yaml(path, header, {"format": format_name, "version": VERSION, **entries, **answer})


def load_design(path: FilePath) -> Design:
    """Read the design file of an arm or of a T–S system and re-check its certificate.

    Raises:
        DesignFileError: The file is missing, too large, not YAML, or not a design; the text
            names the entry, what was expected and what came.
        CertificateError: The certificate does not hold; the text names each inequality, its
            vertex and its margin.

    >>> from tsobs_ros.resources import config_path
    >>> load_design(config_path("elastic_joint.design.yaml")).request.rate
    200.0
    """
    design = parse_design(path)
    design.certificate.require(str(path))
    return design


def parse_design(path: FilePath) -> Design:
    """Read a design file without judging its certificate (for `tsobs verify`).

    Raises:
        DesignFileError: As for `load_design`.
    """
    data = read_yaml(path)
    if "format" not in data and "certificate" not in data:
        raise DesignFileError(
            f"{path}: format: missing; if this is a request, `tsobs design` makes a design of it"
        )
    kinds: dict[str, type[ArmDesignFile | TSDesignFile]] = {
        kind.FORMAT: kind for kind in (ArmDesignFile, TSDesignFile)
    }
    name, version = data.get("format"), data.get("version")
    if not isinstance(name, str) or name not in kinds:
        expected = " or ".join(map(repr, kinds))
        raise DesignFileError(f"{path}: format: expected {expected}, got {shown(name)}")
    # True == 1 == 1.0 in Python, but only one of them is a version.
    if type(version) is not int or version != VERSION:
        raise DesignFileError(f"{path}: version: expected {VERSION}, got {shown(version)}")
    entries = decode(data, kinds[name], path)
    with naming(path):
        request = entries.request()
        n, p = request.flow.state_count, request.flow.output_matrix.shape[0]
        is_arm = isinstance(request, ArmRequest)
        K = as_matrix("gain.K", entries.gain.K, (n,) if is_arm else (n, p)).reshape(n, p)
        P = as_matrix("certificate.P", entries.certificate.P, (n, n))
        design = Design(request, P, K, entries.solver.report())
        # Evaluated here, so that numbers no proof can be made of are refused with the file's name.
        _ = design.certificate
        return design


def load_request(path: FilePath) -> Request:
    """Read what `tsobs design` is asked for from a commented YAML file.

    The arm's entries may stand alone or under `design`; what is left out keeps its default.

    Raises:
        DesignFileError: As for `load_design`, or the file is a design.

    >>> from tsobs_ros.resources import config_path
    >>> load_request(config_path("ts_example.request.yaml")).model.rule_count
    2
    """
    data = read_yaml(path)
    found = [name for name in ("format", "gain", "certificate", "solver") if name in data]
    if found:
        raise DesignFileError(
            f"{path}: {found[0]}: expected a request, got a finished design; a request has none of "
            f"format, version, gain, certificate and solver"
        )
    kind: type[TSEntries | ArmRequestFile | ArmEntries] = ArmEntries
    if "system" in data:
        kind = TSEntries
    elif "design" in data:
        kind = ArmRequestFile
    entries = decode(data, kind, path)
    with naming(path):
        request = entries.request()
        # Built here, so that a request no model can be made of is refused with the file's name.
        _ = request.flow
        return request


class TermEntry(Variant):
    """A disturbance's term: its kind, and its parameters."""

    tag = "kind"


class MembershipEntry(Variant):
    """A membership function: its shape, and its parameters."""

    tag = "shape"


class ArmParameters(Entries):
    """Physical parameters; see `ElasticJointArm`."""

    link_inertia: Number | UnsetType = UNSET
    motor_inertia: Number | UnsetType = UNSET
    stiffness: Number | UnsetType = UNSET
    gravity_torque: Number | UnsetType = UNSET
    link_damping: Number | UnsetType = UNSET
    motor_damping: Number | UnsetType = UNSET


class NoiseDensities(Entries):
    """Densities of the arm's acceleration noise; see `ProcessNoise`."""

    link: Number | UnsetType = UNSET
    motor: Number | UnsetType = UNSET


class ArmEntries(Entries):
    """Entries of a request for an arm; see `ArmRequest`."""

    arm: ArmParameters = msgspec.field(default_factory=ArmParameters)
    disturbance: list[TermEntry] | UnsetType = UNSET
    process_noise: NoiseDensities = msgspec.field(default_factory=NoiseDensities)
    measurement_std: Number | UnsetType = UNSET
    rate: Number | UnsetType = UNSET
    x_max: Number | UnsetType = UNSET
    decay_rate: Number | UnsetType = UNSET
    initial_std: NDArray[np.float64] | UnsetType = UNSET
    uncertainty: dict[str, Number] | UnsetType = UNSET
    certify_uncertainty: bool | UnsetType = UNSET

    def request(self) -> ArmRequest:
        """Return the request; values out of range raise `ModelError`."""
        values = _given(self)
        with within("arm"):
            values["arm"] = ElasticJointArm(**_given(self.arm))
        with within("process_noise"):
            values["process_noise"] = ProcessNoise(**_given(self.process_noise))
        if not isinstance(self.disturbance, UnsetType):
            values["disturbance"] = _terms("disturbance", self.disturbance)
        return ArmRequest(**values)


class ArmRequestFile(Entries):
    """A file with the entries of a request for an arm under `design`."""

    design: ArmEntries

    def request(self) -> ArmRequest:
        """Return the request; values out of range raise `DesignFileError`."""
        with within("design"):
            return self.design.request()


class PremiseEntry(Entries):
    """One premise variable, linear in state, undisturbed outputs and scheduled signals."""

    state: NDArray[np.float64] | UnsetType = UNSET
    output: NDArray[np.float64] | UnsetType = UNSET
    scheduled: NDArray[np.float64] | UnsetType = UNSET


class RuleEntry(Entries, kw_only=True):
    """One rule: the memberships of its premises, and its matrices."""

    if_: dict[str, MembershipEntry] = msgspec.field(name="if", default_factory=dict)
    A: NDArray[np.float64]
    B: NDArray[np.float64]


class SystemEntry(Entries):
    """A T–S system; see `TSModel`."""

    premises: dict[str, PremiseEntry]
    rules: list[RuleEntry]
    C: NDArray[np.float64]
    slope_vertices: list[NDArray[np.float64]] = msgspec.field(default_factory=list)

    def model(self) -> TSModel:
        """Return the system; matrices of other shapes raise `ModelError`."""
        if not self.rules or not self.premises:
            missing = "rules" if not self.rules else "premises"
            raise ValueError(f"{missing}: expected at least one")
        n, p = len(self.rules[0].A), len(self.C)
        inputs = self.rules[0].B.shape
        for i, rule in enumerate(self.rules):
            as_matrix(f"rules[{i}].A", rule.A, (n, n))
            as_matrix(f"rules[{i}].B", rule.B, (n, *inputs[1:]))
        C = as_matrix("C", self.C, (p, n))
        given = [entry.scheduled for entry in self.premises.values()]
        signals = [len(each) for each in given if not isinstance(each, UnsetType)]
        state, output, scheduled = (
            self._premise_rows(source, width)
            for source, width in (("state", n), ("output", p), ("scheduled", max([0, *signals])))
        )
        rules = tuple(self._memberships(i, rule) for i, rule in enumerate(self.rules))
        return TSModel(
            np.array([rule.A for rule in self.rules]),
            np.array([rule.B for rule in self.rules]),
            C,
            RuleBase(rules),
            state + output @ C,
            scheduled,
        )

    def _premise_rows(self, source: str, width: int) -> Array:
        """Return the numbers that each premise variable takes of a source, shape (q, width)."""
        rows = np.zeros((len(self.premises), width))
        for row, (name, entry) in zip(rows, self.premises.items(), strict=True):
            if not _given(entry):
                raise ValueError(f"premises.{name}: expected one of state, output, scheduled")
            if _is_set(given := getattr(entry, source)):
                row[:] = as_matrix(f"premises.{name}.{source}", given, (width,))
        return rows

    def _memberships(self, index: int, rule: RuleEntry) -> tuple[Membership, ...]:
        for name in rule.if_:
            if name not in self.premises:
                raise ValueError(
                    f"rules[{index}].if: unknown entry {shown(name)}, expected some of "
                    f"{', '.join(self.premises)}"
                )
        chosen: list[Membership] = []
        for name in self.premises:
            entry = rule.if_.get(name)
            with within(f"rules[{index}].if.{name}"):
                named = Always() if entry is None else membership(entry.name, entry.parameters)
            chosen.append(named)
        return tuple(chosen)


class DirectionEntry(Entries):
    """An uncertain direction: one matrix, or one a rule; and the bound of its θ."""

    E: NDArray[np.float64]
    bound: Number


class TSEntries(Entries, kw_only=True):
    """Entries of a request for a T–S system; see `TSRequest`."""

    system: SystemEntry
    process_noise: NDArray[np.float64]
    measurement_std: NDArray[np.float64]
    rate: Number
    initial_std: NDArray[np.float64]
    disturbance: list[list[TermEntry]] | UnsetType = UNSET
    decay_rate: Number = Number(0.0)
    D_s: NDArray[np.float64] | UnsetType = UNSET
    uncertainty: dict[str, DirectionEntry] = msgspec.field(default_factory=dict)
    certify_uncertainty: bool = False

    def request(self) -> TSRequest:
        """Return the request; values out of range raise `ModelError`."""
        with within("system"):
            model = self.system.model()
        if isinstance(self.disturbance, UnsetType):
            disturbance = [[DisturbanceTerm("clean")]] * len(model.C)
        else:
            disturbance = [
                _terms(f"disturbance[{i}]", terms) for i, terms in enumerate(self.disturbance)
            ]
        return TSRequest(
            model=model,
            disturbance=disturbance,
            process_noise=self.process_noise,
            measurement_std=self.measurement_std,
            rate=self.rate,
            initial_std=self.initial_std,
            decay_rate=self.decay_rate,
            slope_vertices=self.system.slope_vertices,
            D_s=None if isinstance(self.D_s, UnsetType) else self.D_s,
            uncertainty=self._uncertainty(model),
            certify_uncertainty=self.certify_uncertainty,
        )

    def _uncertainty(self, model: TSModel) -> Uncertainty | None:
        if not self.uncertainty:
            return None
        directions = {name: entry.E for name, entry in self.uncertainty.items()}
        bounds = {name: float(entry.bound) for name, entry in self.uncertainty.items()}
        return system_uncertainty(model, directions, bounds)


class GainEntry(Entries):
    """The filter gain: a list of numbers for an arm, of rows for a T–S system."""

    K: NDArray[np.float64]


class CertificateEntry(Entries):
    """The matrix that proves the gain."""

    P: NDArray[np.float64]


class SolverEntry(Entries):
    """Who computed the matrices; see `SolverReport`."""

    # YAML reads a version such as 0.11 as a number.
    name: str | float = ""
    version: str | float = ""
    status: str | float = ""
    iterations: Number = Number(0)
    seconds: Number = Number(0)
    margin: Number = Number(SolverReport.margin)

    def report(self) -> SolverReport:
        """Return the record."""
        texts = (str(self.name), str(self.version), str(self.status))
        return SolverReport(*texts, int(self.iterations), float(self.seconds), float(self.margin))


class ArmDesignFile(ArmRequestFile, kw_only=True):
    """The design file of an arm."""

    FORMAT: ClassVar[str] = "tsobs_ros design"
    format: str
    version: int
    gain: GainEntry
    certificate: CertificateEntry
    solver: SolverEntry


class TSDesignFile(TSEntries, kw_only=True):
    """The design file of a T–S system."""

    FORMAT: ClassVar[str] = "tsobs_ros T-S design"
    format: str
    version: int
    gain: GainEntry
    certificate: CertificateEntry
    solver: SolverEntry


def _given(entries: Entries) -> dict[str, Any]:
    """Return the entries that the file has, by name."""
    return {
        name: value
        for name in entries.__struct_fields__
        if _is_set(value := getattr(entries, name))
    }


def _is_set(value: object) -> bool:
    return not isinstance(value, UnsetType)


def _terms(place: str, entries: Sequence[TermEntry]) -> list[DisturbanceTerm]:
    terms = []
    for index, entry in enumerate(entries):
        with within(f"{place}[{index}]"):
            term = DisturbanceTerm(entry.name, entry.parameters)
            _ = term.model()
            terms.append(term)
    return terms


def _plain_arm_request(request: ArmRequest) -> dict[str, Any]:
    return {
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
    }


def _plain_ts_request(request: TSRequest) -> dict[str, Any]:
    plain: dict[str, Any] = {
        "system": _plain_system(request),
        "disturbance": [[term.as_mapping() for term in terms] for terms in request.disturbance],
        "process_noise": np.asarray(request.process_noise).tolist(),
        "measurement_std": np.asarray(request.measurement_std).tolist(),
        "rate": request.rate,
        "decay_rate": request.decay_rate,
        "initial_std": np.asarray(request.initial_std).tolist(),
        "certify_uncertainty": request.certify_uncertainty,
    }
    if request.D_s is not None:
        plain["D_s"] = np.asarray(request.D_s).tolist()
    if request.uncertainty is not None:
        known = request.uncertainty
        plain["uncertainty"] = {
            name: {"E": E.tolist(), "bound": bound}
            for name, E, bound in zip(known.names, known.linear, known.limits.tolist(), strict=True)
        }
    return plain


def _plain_system(request: TSRequest) -> dict[str, Any]:
    model = request.model
    names = [f"z{j + 1}" for j in range(model.rule_base.premise_count)]
    premises = {
        name: {"state": state.tolist()}
        | ({"scheduled": scheduled.tolist()} if scheduled.size else {})
        for name, state, scheduled in zip(names, model.premise, model.schedule, strict=True)
    }
    rules = [
        {"if": _plain_memberships(names, memberships), "A": A.tolist(), "B": B.tolist()}
        for memberships, A, B in zip(model.rule_base.rules, model.A, model.B, strict=True)
    ]
    return {
        "premises": premises,
        "rules": rules,
        "C": model.C.tolist(),
        "slope_vertices": [np.asarray(matrix).tolist() for matrix in request.slope_vertices],
    }


def _plain_memberships(names: Sequence[str], memberships: Sequence[Any]) -> Mapping[str, Any]:
    for name, each in zip(names, memberships, strict=True):
        if not isinstance(each, Membership):
            raise ValueError(
                f"membership of {name}: expected a named one, got {type(each).__name__}"
            )
    return {name: each.as_mapping() for name, each in zip(names, memberships, strict=True)}
