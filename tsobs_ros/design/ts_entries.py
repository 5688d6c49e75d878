# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A T–S request as entries of a YAML file, and back; every error names the entry."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, shown
from tsobs_ros.design.entries import known_only, mapping, number, numbers
from tsobs_ros.design.file import disturbance_terms
from tsobs_ros.design.request import DisturbanceTerm
from tsobs_ros.design.ts_request import TSRequest
from tsobs_ros.errors import DesignFileError
from tsobs_ros.model.fuzzy import Always, Membership, RuleBase, membership
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import Uncertainty, system_uncertainty

REQUEST_ENTRIES = (
    "system", "disturbance", "D_s", "process_noise", "measurement_std", "rate", "decay_rate",
    "initial_std", "uncertainty", "certify_uncertainty",
)  # fmt: skip
_REQUIRED = ("system", "process_noise", "measurement_std", "rate", "initial_std")
_SOURCES = ("state", "output", "scheduled")


def parse_request(data: Mapping[str, Any]) -> TSRequest:
    """Return the request that the entries describe.

    Raises:
        DesignFileError: An entry is missing or malformed.
        ModelError: A value is out of range.
    """
    for name in _REQUIRED:
        if name not in data:
            raise DesignFileError(f"{name}: missing")
    system = mapping("system", data["system"])
    known_only("system", system, ("premises", "rules", "C", "slope_vertices"))
    model = _model(system)
    n, p = model.state_count, model.C.shape[0]
    certify = data.get("certify_uncertainty", False)
    if not isinstance(certify, bool):
        raise DesignFileError(f"certify_uncertainty: expected true or false, got {shown(certify)}")
    slopes = _list("system.slope_vertices", system.get("slope_vertices", []))
    return TSRequest(
        model=model,
        disturbance=_disturbance(data, p),
        process_noise=numbers("process_noise", data["process_noise"], (n,)),
        measurement_std=numbers("measurement_std", data["measurement_std"], (p,)),
        rate=number("rate", data["rate"]),
        initial_std=numbers("initial_std", data["initial_std"], (n,)),
        decay_rate=number("decay_rate", data.get("decay_rate", 0.0)),
        slope_vertices=[
            numbers(f"system.slope_vertices[{i}]", matrix, (n, n))
            for i, matrix in enumerate(slopes)
        ],
        D_s=None if "D_s" not in data else _matrix("D_s", data["D_s"]),
        uncertainty=_uncertainty(model, data.get("uncertainty", {})),
        certify_uncertainty=certify,
    )


def plain_request(request: TSRequest) -> dict[str, Any]:
    """Return the entries that `parse_request` makes the same request of.

    Raises:
        DesignFileError: A membership function is not one of `model.fuzzy`.
    """
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


class _Premises(NamedTuple):
    """Names of the premise variables, and each one's numbers, (q, ·), by source."""

    names: list[str]
    rows: dict[str, Array]


def _model(system: Mapping[str, Any]) -> TSModel:
    rules = [
        mapping(f"system.rules[{i}]", rule)
        for i, rule in enumerate(_list("system.rules", system.get("rules")))
    ]
    if not rules:
        raise DesignFileError("system.rules: expected at least one rule")
    matrices = {
        name: [_matrix(f"system.rules[{i}].{name}", rule.get(name)) for i, rule in enumerate(rules)]
        for name in ("A", "B")
    }
    for name, stack in matrices.items():
        shapes = {matrix.shape for matrix in stack}
        if len(shapes) != 1:
            raise DesignFileError(
                f"system.rules: expected {name} of one shape in all rules, got {sorted(shapes)}"
            )
    C = _matrix("system.C", system.get("C"))
    n = matrices["A"][0].shape[1]
    if C.shape[1] != n:
        raise DesignFileError(f"system.C: expected rows of {n} numbers, got {C.shape[1]}")
    premises = _premises(system, n, C)
    return TSModel(
        np.array(matrices["A"]),
        np.array(matrices["B"]),
        C,
        RuleBase(tuple(_rule(i, rule, premises.names) for i, rule in enumerate(rules))),
        premises.rows["state"] + premises.rows["output"] @ C,
        premises.rows["scheduled"],
    )


def _premises(system: Mapping[str, Any], n: int, C: Array) -> _Premises:
    entries = mapping("system.premises", system.get("premises"))
    if not entries:
        raise DesignFileError("system.premises: expected at least one premise variable")
    signals = 0
    for name, entry in entries.items():
        known_only(f"system.premises.{name}", mapping(f"system.premises.{name}", entry), _SOURCES)
        if not entry:
            raise DesignFileError(f"system.premises.{name}: expected one of {', '.join(_SOURCES)}")
        if "scheduled" in entry:
            signals = len(_list(f"system.premises.{name}.scheduled", entry["scheduled"]))
    widths = {"state": n, "output": C.shape[0], "scheduled": signals}
    rows = {
        source: np.array(
            [
                numbers(f"system.premises.{name}.{source}", entry[source], (width,))
                if source in entry
                else np.zeros(width)
                for name, entry in entries.items()
            ]
        )
        for source, width in widths.items()
    }
    return _Premises(list(entries), rows)


def _rule(index: int, rule: Mapping[str, Any], premises: list[str]) -> tuple[Membership, ...]:
    place = f"system.rules[{index}]"
    known_only(place, rule, ("if", "A", "B"))
    conditions = mapping(f"{place}.if", rule.get("if", {}))
    known_only(f"{place}.if", conditions, premises)
    return tuple(
        _membership(f"{place}.if.{name}", conditions[name]) if name in conditions else Always()
        for name in premises
    )


def _membership(place: str, entry: Any) -> Membership:
    parameters = dict(mapping(place, entry))
    shape = parameters.pop("shape", None)
    if not isinstance(shape, str):
        raise DesignFileError(f"{place}.shape: expected a name, got {shown(shape)}")
    return membership(
        shape, {name: number(f"{place}.{name}", value) for name, value in parameters.items()}
    )


def _disturbance(data: Mapping[str, Any], outputs: int) -> list[list[DisturbanceTerm]]:
    clean: list[Any] = [[{"kind": "clean"}]] * outputs
    channels = _list("disturbance", data.get("disturbance", clean))
    return [disturbance_terms(f"disturbance[{i}]", terms) for i, terms in enumerate(channels)]


def _uncertainty(model: TSModel, data: Any) -> Uncertainty | None:
    entries = mapping("uncertainty", data)
    if not entries:
        return None
    directions, bounds = {}, {}
    n = model.state_count
    for name, entry in entries.items():
        known_only(f"uncertainty.{name}", mapping(f"uncertainty.{name}", entry), ("E", "bound"))
        E = _list(f"uncertainty.{name}.E", entry.get("E"))
        per_rule = bool(E) and isinstance(E[0], list) and bool(E[0]) and isinstance(E[0][0], list)
        shape = (model.rule_count, n, n) if per_rule else (n, n)
        directions[name] = numbers(f"uncertainty.{name}.E", E, shape)
        bounds[name] = number(f"uncertainty.{name}.bound", entry.get("bound"))
    return system_uncertainty(model, directions, bounds)


def _plain_system(request: TSRequest) -> dict[str, Any]:
    model = request.model
    names = [f"z{j + 1}" for j in range(model.rule_base.premise_count)]
    rules = []
    for memberships, A, B in zip(model.rule_base.rules, model.A, model.B, strict=True):
        conditions = {}
        for name, each in zip(names, memberships, strict=True):
            if not isinstance(each, Membership):
                raise DesignFileError(
                    f"membership of {name}: expected a named one, got {type(each).__name__}"
                )
            conditions[name] = each.as_mapping()
        rules.append({"if": conditions, "A": A.tolist(), "B": B.tolist()})
    return {
        "premises": {
            name: {"state": state.tolist()}
            | ({"scheduled": scheduled.tolist()} if scheduled.size else {})
            for name, state, scheduled in zip(names, model.premise, model.schedule, strict=True)
        },
        "rules": rules,
        "C": model.C.tolist(),
        "slope_vertices": [np.asarray(matrix).tolist() for matrix in request.slope_vertices],
    }


def _matrix(place: str, value: Any) -> Array:
    """Return rows of numbers, of whatever equal lengths, as a matrix."""
    rows = _list(place, value)
    if not rows:
        raise DesignFileError(f"{place}: expected rows of numbers, got none")
    return numbers(place, rows, (len(rows), len(_list(f"{place}[0]", rows[0]))))


def _list(place: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise DesignFileError(f"{place}: expected a list, got {shown(value)}")
    return value
