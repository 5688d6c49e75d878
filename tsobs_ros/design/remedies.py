# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Changes of a request that has no design, each tried before it is suggested."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.names import NO_LABELS, labelled
from tsobs_ros.design.problem import DesignProblem
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TSRequest
from tsobs_ros.model.arm import SIDES
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import Uncertainty

_FASTER = (1.5, 2.0, 3.0, 5.0, 10.0, 20.0)
_SHARES = (0.75, 0.5, 0.25)
_OTHER_FREQUENCIES = (1.25, 0.8, 1.6, 0.625, 2.5)

_CLEAN = DisturbanceTerm("clean")
_BIAS, _DECAYING = DisturbanceTerm("bias"), DisturbanceTerm("gauss_markov")

Terms: TypeAlias = tuple[DisturbanceTerm, ...]
Request: TypeAlias = ArmRequest | TSRequest


class Remedy(NamedTuple):
    """A changed request.

    Attributes:
        text: The change in words.
        request: The request after it.
    """

    text: str
    request: Request


def helpful(
    families: Iterable[Iterable[Remedy]], has_design: Callable[[DesignProblem], bool]
) -> tuple[Remedy, ...]:
    """Return the first of each family of changes that leads to a design.

    Args:
        families: Changes of one kind each, the smallest change first.
        has_design: Whether a request has a design.
    """
    found = []
    for family in families:
        for remedy in family:
            if has_design(remedy.request):
                found.append(remedy)
                break
    return tuple(found)


def remedies_of_hidden_modes(
    request: Request, slopes: Sequence[float | None] = (), oscillates: bool = False
) -> Iterator[Iterable[Remedy]]:
    """Yield changes of a request whose disturbances hide a mode.

    Args:
        request: The request.
        slopes: Gravity slopes at which modes of an arm are hidden, None for any.
        oscillates: Whether one of them does.
    """
    if request.disturbance_model.arbitrary:
        yield from _without_arbitrary(request)
        return
    yield from _fewer_terms(request)
    if isinstance(request, ArmRequest) and slopes and None not in slopes:
        yield _domain_above(request, max(slope for slope in slopes if slope is not None))
    if oscillates:
        yield _other_frequencies(request)
    yield from _decaying(request)
    yield from _clean(request)
    yield from _further_outputs(request)


def remedies_of_gain(request: Request) -> Iterator[Iterable[Remedy]]:
    """Yield changes of a request that no gain with one common matrix was found for."""
    yield _faster(request)
    yield _smaller_domain(request)
    if request.decay_rate > 0.0:
        rates = [share * request.decay_rate for share in (0.25, 1.0 / 16.0, 1.0 / 64.0, 0.0)]
        yield (
            Remedy(f"a smaller decay_rate: {rate:.3g} 1/s", replace(request, decay_rate=rate))
            for rate in rates
        )
    if request.certify_uncertainty:
        yield _smaller_uncertainty(request)
    if isinstance(request, ArmRequest):
        yield _noise(request)
    yield from _decaying(request)
    yield from _further_outputs(request)


class _Channel(NamedTuple):
    """The terms of one disturbance, and where it acts, in words."""

    name: str
    terms: Terms


def _channels(request: Request) -> list[_Channel]:
    """Return the disturbances of all outputs or channels, then of the torques at both sides."""
    if isinstance(request, ArmRequest):
        torques = request.torque_disturbance
        return [
            *(_Channel(each.measures, tuple(each.disturbance)) for each in request.sensors),
            *(
                _Channel(f"the torque at the {side}", tuple(getattr(torques, side)))
                for side in SIDES
            ),
        ]
    numbered = [f"channel {i + 1}" for i in range(len(request.disturbance))]
    names = numbered if request.D_s is not None else request.output_names
    pairs = zip(names, request.disturbance, strict=True)
    return [_Channel(name, tuple(terms)) for name, terms in pairs]


def _with_terms(request: Request, place: int, terms: Terms) -> Request:
    """Return a request with other terms of the disturbance at a place of `_channels`."""
    if isinstance(request, TSRequest):
        each = list(request.disturbance)
        each[place] = terms
        return replace(request, disturbance=each)
    outputs = list(request.outputs)
    if place >= len(request.sensors):
        side = SIDES[place - len(request.sensors)]
        torques = replace(request.torque_disturbance, **{side: terms})
        return replace(request, torque_disturbance=torques)
    if not outputs:
        return replace(request, disturbance=terms)
    outputs[place] = replace(outputs[place], disturbance=terms)
    return _with_outputs(request, outputs)


def _with_outputs(request: ArmRequest, outputs: Sequence[Output]) -> ArmRequest:
    return replace(
        request,
        outputs=tuple(outputs),
        disturbance=outputs[0].disturbance,
        measurement_std=outputs[0].measurement_std,
    )


def _without_arbitrary(request: Request) -> Iterator[Iterable[Remedy]]:
    def modelled(term: DisturbanceTerm) -> Request:
        changed = request
        for place, channel in enumerate(_channels(request)):
            terms = tuple(term if each.kind == "arbitrary" else each for each in channel.terms)
            changed = _with_terms(changed, place, terms)
        return changed

    text = "a model of the disturbance in place of arbitrary: kind"
    yield (Remedy(f"{text} {term.kind}", modelled(term)) for term in (_BIAS, _DECAYING))
    known = [
        place
        for place, channel in enumerate(_channels(request))
        if all(term.kind != "arbitrary" for term in channel.terms)
    ]
    if isinstance(request, ArmRequest):
        known = [place for place in known if place < len(request.sensors)]
        outputs = [request.sensors[place] for place in known]
        if outputs:
            text = "leaving these outputs out: y − C x̂ then reads their disturbance"
            yield [Remedy(text, _with_outputs(request, outputs))]
        else:
            std = request.measurement_std
            yield (
                Remedy(
                    f"another sensor in its place that is known to be clean: {name}",
                    _with_outputs(request, [Output(name, std)]),
                )
                for name in ("motor_angle", "link_angle")
                if name not in request.output_names
            )
    elif known and request.D_s is None:
        text = "leaving these outputs out of C: y − C x̂ then reads their disturbance"
        yield [Remedy(text, _with_rows(request, known))]


def _with_rows(request: TSRequest, rows: Sequence[int]) -> TSRequest:
    """Return a request with some of its outputs."""
    names, units = request.names, request.units
    return replace(
        request,
        model=_with_outputs_of(request.model, lambda C: C[rows]),
        disturbance=[request.disturbance[row] for row in rows],
        measurement_std=np.asarray(request.measurement_std)[rows],
        names=_with_labels(names, names.outputs and tuple(names.outputs[row] for row in rows)),
        units=_with_labels(units, units.outputs and tuple(units.outputs[row] for row in rows)),
    )


def _with_outputs_of(model: TSModel, change: Callable[[Array], Array]) -> TSModel:
    """Return a system whose output matrices are changed, those of single rules too."""
    each = None if model.outputs is None else np.array([change(C) for C in model.outputs])
    return replace(model, C=change(model.C), outputs=each)


def _with_labels(labels: Any, outputs: tuple[str, ...]) -> Any:
    return type(labels)(labels.states, outputs, labels.inputs, labels.scheduled)


def _fewer_terms(request: Request) -> Iterator[Iterable[Remedy]]:
    for place, (name, terms) in enumerate(_channels(request)):
        if len(terms) > 1:
            alike = " and ".join(term.kind for term in terms)
            yield (
                Remedy(
                    f"fewer terms: two of {alike} move alike and cannot be distinguished, whatever "
                    f"else moves; {name} without {terms[last].kind}",
                    _with_terms(request, place, terms[:last] + terms[last + 1 :]),
                )
                for last in range(len(terms) - 1, -1, -1)
            )


def _domain_above(request: ArmRequest, slope: float) -> Iterator[Remedy]:
    if not slope < 1.0 - 1e-9:
        return
    tidy = 0.0 if abs(slope) < 1e-12 else slope
    widest = math.acos(tidy)
    for share in (0.95, *_SHARES):
        x_max = float(f"{share * widest:.3g}")
        text = (
            f"a smaller domain: x_max below {widest:.4g} rad keeps the slope above {tidy:.4g}; "
            f"{x_max:g} rad has a design"
        )
        yield Remedy(text, replace(request, x_max=x_max))


def _other_frequencies(request: Request) -> Iterator[Remedy]:
    for factor in _OTHER_FREQUENCIES:
        changed, moved = request, []
        for place, channel in enumerate(_channels(request)):
            terms = []
            for term in channel.terms:
                if "frequency" in term:
                    frequency = float(f"{factor * term['frequency']:.3g}")
                    moved.append(f"{frequency:g} in place of {term['frequency']:g} rad/s")
                    term = DisturbanceTerm.from_mapping({**term, "frequency": frequency})
                terms.append(term)
            changed = _with_terms(changed, place, tuple(terms))
        own = "the arm's own frequencies on the domain" if isinstance(request, ArmRequest) else ""
        away = f"a disturbance frequency away from {own or 'those of the system'}"
        yield Remedy(f"{away}: {', '.join(moved)}", changed)


def _decaying(request: Request) -> Iterator[Iterable[Remedy]]:
    for place, (name, terms) in enumerate(_channels(request)):
        if any(term.kind not in ("clean", "gauss_markov") for term in terms):
            yield [
                Remedy(
                    f"kind gauss_markov for {name}, whose decaying state need not be seen, "
                    "in place of one that persists",
                    _with_terms(request, place, (_DECAYING,)),
                )
            ]


def _clean(request: Request) -> Iterator[Iterable[Remedy]]:
    for place, (name, terms) in enumerate(_channels(request)):
        if any(term.kind != "clean" for term in terms):
            yield [
                Remedy(
                    f"kind clean for {name}, if it is not disturbed",
                    _with_terms(request, place, (_CLEAN,)),
                )
            ]


def _further_outputs(request: Request) -> Iterator[Iterable[Remedy]]:
    if isinstance(request, ArmRequest):
        std = request.measurement_std
        known = request.output_names
        for name in ("link_angle", "motor_angle"):
            if name not in known:
                added = Output(name, std)
                yield [
                    Remedy(
                        f"a further output without disturbance: {name} with 1σ of {std:.3g} rad",
                        _with_outputs(request, [*request.sensors, added]),
                    )
                ]
        return
    yield (
        _with_state(request, state)
        for state in range(request.model.state_count)
        if not any(np.flatnonzero(row).tolist() == [state] for row in np.asarray(request.model.C))
    )


def _with_state(request: TSRequest, state: int) -> Remedy:
    """Return the change to a further output that shows one state."""
    n = request.model.state_count
    std = 0.1 * float(np.asarray(request.initial_std)[state])
    names, units = request.names, request.units
    name, unit = request.state_names[state], request.state_units[state]
    added: dict[str, Any] = {
        "model": _with_outputs_of(request.model, lambda C: np.vstack([C, np.eye(n)[state]])),
        "measurement_std": np.append(np.asarray(request.measurement_std), std),
    }
    if request.D_s is None:
        added["disturbance"] = [*request.disturbance, (_CLEAN,)]
    else:
        added["D_s"] = np.vstack([request.D_s, np.zeros((1, np.shape(request.D_s)[1]))])
    if names.outputs:
        added["names"] = _with_labels(names, (*names.outputs, f"{name}_measured"))
    if units != NO_LABELS:
        added["units"] = _with_labels(units, (*units.outputs, unit))
    (label,) = labelled([name], [unit])
    return Remedy(
        f"a further output without disturbance: {label} with 1σ of {std:.3g}",
        replace(request, **added),
    )


def _faster(request: Request) -> Iterator[Remedy]:
    slower = ""
    for factor in _FASTER:
        rate = factor * request.rate
        yield Remedy(f"a faster rate: {rate:g} Hz{slower}", replace(request, rate=rate))
        slower = f" ({rate:g} Hz is not enough)"


def _smaller_domain(request: Request) -> Iterator[Remedy]:
    if isinstance(request, ArmRequest):
        for x_max in (share * request.x_max for share in _SHARES):
            if request.arm.gravity_torque:
                yield Remedy(f"a smaller x_max: {x_max:.3g} rad", replace(request, x_max=x_max))
        return
    what = "slope vertices" if request.slope_vertices else "rules"
    matrices = np.array(request.slope_vertices or request.model.A)
    if len(matrices) < 2:
        return
    middle = matrices.mean(axis=0)
    for share in _SHARES:
        closer = middle + share * (matrices - middle)
        text = f"a smaller domain: {what} {100 * share:.0f} % as far from their mean"
        if request.slope_vertices:
            yield Remedy(text, replace(request, slope_vertices=tuple(closer)))
        else:
            yield Remedy(text, replace(request, model=replace(request.model, A=closer)))


def _smaller_uncertainty(request: Request) -> Iterator[Remedy]:
    for share in (0.5, 0.25, 0.1):
        text = f"smaller bounds of uncertainty: {100 * share:.0f} % of them"
        known = request.uncertainty_model
        bounds = {name: share * bound for name, bound in known.bounds.items()}
        if isinstance(request, ArmRequest):
            yield Remedy(text, replace(request, uncertainty=bounds))
        else:
            smaller = Uncertainty(bounds, known.directions)
            yield Remedy(text, replace(request, uncertainty=smaller))


def _noise(request: ArmRequest) -> Iterator[Remedy]:
    """Yield densities in place of those that are 0."""
    default, noise = ProcessNoise(), request.process_noise
    if not (noise.link and noise.motor):
        noise = ProcessNoise(noise.link or default.link, noise.motor or default.motor)
        text = f"process_noise above 0: link {noise.link:g}, motor {noise.motor:g} rad²/s³"
        yield Remedy(text, replace(request, process_noise=noise))
