# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The file of a fitted request: comments say where each number comes from."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import yaml

from tsobs_ros.design.request import ArmRequest
from tsobs_ros.identification.joint import numbers_of
from tsobs_ros.identification.result import Fit, Found
from tsobs_ros.schema import encode

_HEADER = """\
# What `tsobs design` is asked for, with numbers of `tsobs fit`: {samples} samples of
# {names}.
# ± is the 1 sigma of a fitted number. One that is hardly shown stays near its value before.
# Units are SI and radians.
"""


def request_text(fit: Fit, names: str) -> str:
    """Return the fitted request as a commented file.

    Args:
        fit: The fit.
        names: Of the recordings.
    """
    request = fit.request
    found = {each.name: each for each in fit.numbers}
    data: dict[str, Any] = encode(request)
    lines = [_HEADER.format(samples=f"{fit.samples[0]:,}", names=names), "design:\n"]
    for name in [each.name for each in fields(ArmRequest)]:
        if data.get(name) in (None, {}, []) and name != "uncertainty":
            continue
        if _is_spoken_for(request, name):
            continue
        lines.append(_entry(name, data[name], found, fit))
    for lack in fit.lacks:
        lines.append(f"# The model lacks {lack.what}.\n")
    return "".join(lines)


def _is_spoken_for(request: ArmRequest, name: str) -> bool:
    """Return whether an entry is not written: others stand for it."""
    return name in (("disturbance", "measurement_std") if request.outputs else ("outputs",))


def _entry(name: str, value: Any, found: Mapping[str, Found], fit: Fit) -> str:
    """Return the lines of one entry of the request."""
    own_values = {each.name: each.start for each in numbers_of(fit.request)}
    written = {each.name: own_values.get(each.name, each.value) for each in fit.numbers}
    if isinstance(value, Mapping) and name in ("arm", "torque"):
        lines = [
            f"    {key}: {_flow(each)}{_comment(found.get(f'{name}.{key}'), each)}\n"
            for key, each in value.items()
        ]
        return f"  {name}:\n{''.join(lines)}"
    if name == "outputs":
        lines = []
        for each in value:
            own = [one for key, one in found.items() if key.startswith(f"{each['measures']}.")]
            lines += [
                f"    # {one.name}: {_words(one, written[one.name])}\n"
                for one in own
                if not one.name.endswith(".offset")  # no entry of a request
            ]
            lines.append(f"    - {_flow(each)}\n")
        return f"  outputs:\n{''.join(lines)}"
    own = [
        one
        for key, one in found.items()
        if key.startswith((f"{name}.", f"link_angle.{name}"))
        or (name == "measurement_std" and key == "link_angle.measurement_std")
    ]
    comments = "".join(f"  # {one.name}: {_words(one, written[one.name])}\n" for one in own)
    if name == "uncertainty" and value:
        comments = "  # Three sigmas of the fit; the prior's bound of what it does not show.\n"
    return f"{comments}  {name}: {_flow(value)}\n"


def _comment(one: Found | None, value: float) -> str:
    return "" if one is None else f"  # {_words(one, value)}"


def _words(one: Found, value: float) -> str:
    if not (value or one.significant):
        return f"nothing is shown ({one.value:.2g} ± {one.std:.2g} {one.unit})"
    if not one.seen:
        return f"the recording hardly shows it (± {one.std:.2g} {one.unit})".replace(" )", ")")
    if abs(value / one.value - 1.0) > 1e-4:
        return f"likeliest of a filter without friction; with it {one.value:.4g} ± {one.std:.2g}"
    return f"fitted, ± {one.std:.2g} {one.unit}; it was {one.before:.4g}".replace(" ;", ";")


def _flow(value: Any) -> str:
    """Return plain data as YAML in one line."""
    text: str = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
    return text.removesuffix("\n").removesuffix("\n...")
