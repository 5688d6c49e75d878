# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer node's parameters, from its YAML file or one by one, as settings of a run."""

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from tsobs_ros.checks import shown
from tsobs_ros.design.plain import read_yaml
from tsobs_ros.errors import ParameterError
from tsobs_ros.estimation.observer import GainMode
from tsobs_ros.estimation.supervision import SupervisionOptions
from tsobs_ros.methods import ObserverSettings

_SUPERVISION = "supervision."


def read_parameters(path: Path, node: str = "observer") -> dict[str, Any]:
    """Return what a parameter file says of a node, by the full names of the parameters.

    Args:
        path: A file as for `--params-file` of a node.
        node: The node's name; sections for all nodes, `/**`, count too.

    Raises:
        DesignFileError: The file is missing or no YAML.
        ParameterError: It says nothing of the node.
    """
    found: dict[str, Any] = {}
    sections = read_yaml(path)
    for name, section in sections.items():
        if str(name).rpartition("/")[2] in (node, "**", "*") and isinstance(section, dict):
            found |= _flat(section.get("ros__parameters"))
    if not found:
        has = ", ".join(map(str, sections)) or "none"
        raise ParameterError(f"{path}: no ros__parameters of {node}; sections: {has}")
    return found


def with_parameters(settings: ObserverSettings, values: Mapping[str, Any]) -> ObserverSettings:
    """Return the settings with some of them changed.

    Args:
        settings: The others.
        values: By the names that the parameters have in the node.

    Raises:
        ParameterError: There is no such parameter, or the value is not of its type.
        ModelError: The value is out of range.
    """
    own: dict[str, Any] = {}
    supervision: dict[str, Any] = {}
    for name, value in values.items():
        if name not in NAMES:
            raise ParameterError(f"parameter '{name}' decides no estimate; {', '.join(NAMES)} do")
        short = name.removeprefix(_SUPERVISION)
        group, before = (own, settings) if short == name else (supervision, settings.supervision)
        group[short] = _converted(name, value, getattr(before, short))
    return replace(settings, supervision=replace(settings.supervision, **supervision), **own)


NAMES = (
    *(field.name for field in fields(ObserverSettings) if field.name != "supervision"),
    *(_SUPERVISION + field.name for field in fields(SupervisionOptions)),
)
"""The parameters that decide estimates."""


def _flat(section: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(section, dict):
        return {}
    flat: dict[str, Any] = {}
    for name, value in section.items():
        inner = _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else None
        flat |= {f"{prefix}{name}": value} if inner is None else inner
    return flat


def _converted(name: str, value: Any, before: Any) -> Any:
    """Return a value, or its text, in the type that the parameter has now."""
    text = str(value).strip()
    try:
        if isinstance(before, bool):
            return {"true": True, "false": False}[text.lower()]
        if isinstance(before, GainMode):
            return GainMode(text)
        return type(before)(text)
    except (KeyError, ValueError) as error:
        raise ParameterError(
            f"parameter '{name}': expected a value such as {shown(_plain(before))}, "
            f"got {shown(value)}"
        ) from error


def _plain(value: Any) -> Any:
    return value.value if isinstance(value, GainMode) else value
