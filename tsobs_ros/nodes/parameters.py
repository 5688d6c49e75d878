# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameters of a node, made of its settings; a change of several is accepted or refused whole.

Integers become doubles before rclpy compares types: overrides before their declaration, requests in
a pre-set callback. rclpy refuses other types and scalars out of range; an on-set callback checks
everything else.
"""

import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter

from tsobs_ros.errors import ParameterError, printable
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.settings import (
    Setting,
    about_unknown,
    changed,
    in_yaml,
    setting,
    settings_of,
    values_of,
)

P = TypeVar("P")
T = TypeVar("T")

_MAX_INTEGER, _MAX_FLOAT = 2**63 - 1, sys.float_info.max


@dataclass(frozen=True)
class ManagedParameters:
    """The parameters of every managed node; subclasses add those of one node."""

    autostart: bool = setting(True, "Configure and activate at start, without a lifecycle manager")


@dataclass(frozen=True)
class SelectingParameters(ManagedParameters):
    """The parameters that select topics."""

    topics: tuple[str, ...] = setting((), "Topics to take; all of them without any selection")
    regex: str = setting("", "Take also the topics whose names contain a match of this")
    exclude_topics: tuple[str, ...] = setting((), "Topics not to take")
    exclude_regex: str = setting("", "Do not take topics whose names contain a match of this")

    def __post_init__(self) -> None:
        """Check the patterns.

        Raises:
            ParameterError: One of them is not a regular expression.
        """
        for name in ("regex", "exclude_regex"):
            pattern = getattr(self, name)
            try:
                re.compile(pattern)
            except re.error as error:
                raise ParameterError(
                    f"parameter '{name}': not a regular expression ({error}): '{pattern}'"
                ) from error

    def resolved(self, resolve: Callable[[str, str], str]) -> Self:
        """Return the parameters with full names in place of the given names of topics.

        `resolve` returns the full name for a parameter's name and a given name.
        """
        topics = tuple(resolve("topics", name) for name in self.topics)
        excluded = tuple(resolve("exclude_topics", name) for name in self.exclude_topics)
        return replace(self, topics=topics, exclude_topics=excluded)

    def takes(self, topic: str, by_default: bool = True) -> bool:
        """Return whether to take a topic by its full name, `by_default` if nothing is selected."""
        is_taken = topic in self.topics or bool(self.regex and re.search(self.regex, topic))
        is_taken |= by_default and not (self.topics or self.regex)
        return is_taken and not (
            topic in self.exclude_topics
            or (self.exclude_regex and re.search(self.exclude_regex, topic))
        )


@dataclass(frozen=True)
class JointParameters(ManagedParameters):
    """The parameters that name the joints, and the design of each joint."""

    joints: tuple[str, ...] = setting(("elastic_joint",), "Names of the joints in messages")
    design: str = setting("", "Path of the design file; empty for the one that is shipped")
    joint_designs: tuple[str, ...] = setting(
        (),
        "Design file of each of the joints, empty for the one that `design` names; empty list: "
        "that one for all",
    )

    def read(self, reader: Callable[[str], T]) -> dict[str, T]:
        """Return the result of `reader` on each joint's design file; it is called once per file."""
        shipped = str(config_path(SHIPPED_DESIGN))
        each = self.design_of.items()
        paths = {joint: str(expanded("design", path or shipped)) for joint, path in each}
        found = {path: reader(path) for path in dict.fromkeys(paths.values())}
        return {joint: found[path] for joint, path in paths.items()}

    @property
    def design_of(self) -> dict[str, str]:
        """Path of each joint's design file, empty for the one that is shipped.

        Raises:
            ParameterError: A name is empty or occurs twice, or there are more or fewer paths.
        """
        joints, own = self.joints, self.joint_designs
        if not joints or "" in joints or len(set(joints)) < len(joints):
            raise ParameterError(f"joints: expected names, each once, got {list(joints)}")
        if own and len(own) != len(joints):
            raise ParameterError(
                f"joint_designs: expected one for each of the {len(joints)} joints or none, "
                f"got {len(own)}"
            )
        paths = own or ("",) * len(joints)
        return {joint: path or self.design for joint, path in zip(joints, paths, strict=True)}


def expanded(parameter: str, path: str) -> Path:
    """Return the path that a parameter names, in which ~ stands for a home folder.

    Raises:
        ParameterError: There is no such home folder.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        problem = f"expected a path, got {in_yaml(path)}, whose home folder is unknown"
        raise ParameterError(f"parameter '{parameter}': {problem}") from error


def full_name(node: Node, parameter: str, name: str) -> str:
    """Return the full name of what a parameter names, with the remappings of topics.

    Raises:
        ParameterError: ROS does not accept the name.
    """
    try:
        return str(node.resolve_topic_name(name))
    except RuntimeError as error:  # rclpy does not export the type
        problem = f"parameter '{parameter}': expected a ROS name, got {in_yaml(name)}"
        raise ParameterError(problem) from error


def declare(node: Node, make: type[P], given: Mapping[str, Any]) -> P:
    """Declare the parameters of a dataclass of settings; return it with the given overrides.

    Raises:
        ParameterError: An override has the wrong type, breaks a rule, or the values contradict
            each other.
    """
    known = settings_of(make)
    built: P = changed(make(), {name: each for name, each in given.items() if name in known})
    values = values_of(built)
    for name, entry in known.items():
        # Type before value, as rclpy takes an empty list for bytes; read-only only after the value.
        node.declare_parameter(name, _type(entry), ignore_override=True)
        node.set_parameters_atomically([Parameter(name, _type(entry), values[name])])
        node.set_descriptor(name, _descriptor(entry))
    for name in given:
        if not (node.has_parameter(name) or name.startswith("qos_overrides.")):
            node.get_logger().warning(printable(about_unknown(name, known)))
    return built


def converted(node: Node, make: type, proposal: Sequence[Parameter]) -> list[Parameter]:
    """Return values in the parameters' types if possible; rclpy refuses the others."""
    found = []
    for each in proposal:
        if not node.has_parameter(each.name):  # rclpy does not say which one
            raise ParameterNotDeclaredException(each.name)
        entry = settings_of(make).get(each.name)
        value = None if entry is None or each.value is None else entry.accepted(each.value)
        found.append(each if value is None else Parameter(each.name, _type(entry), value))
    return found


def updated(value: P, proposal: Sequence[Parameter]) -> P:
    """Return a dataclass of settings with the values of its parameters; others are ignored.

    Raises:
        ParameterError: A value breaks a rule, or they contradict each other.
    """
    known = settings_of(type(value))
    return changed(value, {each.name: each.value for each in proposal if each.name in known})


def _type(entry: Any) -> Parameter.Type:
    return Parameter.Type[entry.kind.upper()]


def _descriptor(entry: Setting) -> ParameterDescriptor:
    low, high = entry.minimum, entry.maximum
    descriptor = ParameterDescriptor(
        type=_type(entry).value, description=entry.description, read_only=not entry.live
    )
    if entry.is_array or entry.choices:  # ROS ranges bind scalars only
        each = "each element " if entry.is_array and entry.limits else ""
        descriptor.additional_constraints = each + entry.limits
    elif entry.limits and entry.type is int:
        first = -_MAX_INTEGER if low is None else math.ceil(low)
        last = _MAX_INTEGER if high is None else math.floor(high)
        descriptor.integer_range = [IntegerRange(from_value=first, to_value=last)]
    elif entry.limits:
        begin = -_MAX_FLOAT if low is None else float(low)
        end = _MAX_FLOAT if high is None else float(high)
        descriptor.floating_point_range = [FloatingPointRange(from_value=begin, to_value=end)]
    return descriptor
