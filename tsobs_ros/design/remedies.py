# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Changes of a request that has no design, each tried before it is suggested.

A family is changes of one kind, the smallest first, of which the first with a design is suggested.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

from tsobs_ros.design.feasibility import find_obstacles
from tsobs_ros.design.request import AnyRequest, ArmRequest, Output
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ANGLES
from tsobs_ros.model.disturbance import CLEAN, DisturbanceTerm

_DECAYING = (DisturbanceTerm("gauss_markov"),)
_SHARES = (0.75, 0.5, 0.25)


class Remedy(NamedTuple):
    """A change of a request in words, and the request after it."""

    text: str
    request: AnyRequest


Family = Iterable[Remedy]


def remedies_of(request: AnyRequest) -> Iterator[Family]:
    """Yield changes of a request whose disturbances hide modes, or that no gain was found for."""
    if request.disturbance_model.arbitrary:
        yield [_modelled(request, kind) for kind in ("bias", "gauss_markov")]
        return
    if obstacles := find_obstacles(request):
        slopes = [each.slope for each in obstacles if each.slope is not None]
        if isinstance(request, ArmRequest) and len(slopes) == len(obstacles):
            yield _domain_above(request, max(slopes))
    else:
        yield _faster(request)
        smaller = [request.on_share(share) for share in _SHARES]
        yield [Remedy(*each) for each in smaller if each is not None]
        slower = [share * request.decay_rate for share in (0.25, 0.0) if request.decay_rate]
        yield [
            Remedy(f"a smaller decay_rate: {rate:.3g} 1/s", replace(request, decay_rate=rate))
            for rate in slower
        ]
    for terms, kept, text in (
        (_DECAYING, ("clean", "gauss_markov"), "whose decaying state need not be seen"),
        (CLEAN, ("clean",), "if it is not disturbed"),
    ):
        for place, channel in enumerate(request.channels):
            if any(term.kind not in kept for term in channel.terms):
                words = f"kind {terms[0].kind} for {channel.name}, {text}"
                yield [Remedy(words, request.with_terms(place, terms))]
    if isinstance(request, ArmRequest):
        std = request.measurement_std
        for name in (name for name in ANGLES if name not in request.output_names):
            text = f"a further output without disturbance: {name} with 1σ of {std:.3g} rad"
            outputs = [*request.sensors, Output(name, std)]
            yield [Remedy(text, replace(request, outputs=outputs))]


def _modelled(request: AnyRequest, kind: str) -> Remedy:
    """Return a request with terms of a kind in place of all that are arbitrary."""
    for place, channel in enumerate(request.channels):
        model = DisturbanceTerm(kind)
        terms = tuple(model if each.kind == "arbitrary" else each for each in channel.terms)
        request = request.with_terms(place, terms)
    return Remedy(f"a model of the disturbance in place of arbitrary: kind {kind}", request)


def _domain_above(request: ArmRequest, slope: float) -> Iterator[Remedy]:
    tidy = 0.0 if abs(slope) < 1e-12 else slope
    widest = math.acos(min(tidy, 1.0))
    for share in (0.95, *_SHARES) if slope < 1.0 - 1e-9 else ():
        x_max = float(f"{share * widest:.3g}")
        text = (
            f"a smaller domain: x_max below {widest:.4g} rad keeps the slope above {tidy:.4g}; "
            f"{x_max:g} rad has a design"
        )
        yield Remedy(text, replace(request, x_max=x_max))


def _faster(request: AnyRequest) -> Iterator[Remedy]:
    slower = ""
    for factor in (1.5, 2.0, 3.0, 5.0, 10.0, 20.0):
        rate = factor * request.rate
        try:
            faster = replace(request, rate=rate)
        except ModelError:  # a delay of too many periods
            return
        yield Remedy(f"a faster rate: {rate:g} Hz{slower}", faster)
        slower = f" ({rate:g} Hz is not enough)"
