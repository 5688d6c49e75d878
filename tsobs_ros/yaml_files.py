# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""YAML from files that anybody may have written: plain data, in bounded time and memory.

A few lines can make `yaml.safe_load` build gigabytes (merge keys), overflow the stack (a million
brackets), return a structure that takes for ever to walk through (aliases of aliases), or calculate
for minutes (numbers in base 60). None of our files needs any of this.
"""

import re
from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import yaml

from tsobs_ros.errors import DesignFileError, TsobsError
from tsobs_ros.files import naming_path, open_regular

MAX_BYTES = 1 << 20
"""Largest size of a file, and of a text in one."""

_MAX_NODES = 100_000
_MAX_DEPTH = 50
_TAGS = re.compile(r"(^|[\r\n\x85\u2028\u2029])\ufeff?%TAG")
# With colons, PyYAML's time grows with the square of the length.
_LONG_NUMBER = re.compile(r"[-+0-9_:.]{200,}")


# libyaml's parser is five times as fast; PyYAML without it behaves the same.
class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Refuses a key that occurs twice, of which PyYAML would take the last value."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        mapping, names = super().construct_mapping(node, deep), set[tuple[str, str]]()
        for key, _ in node.value:
            if (key.tag, key.value) in names:
                problem = f"{key.value} occurs twice in a mapping"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            names.add((key.tag, key.value))
        return mapping


MakeError = Callable[[str], TsobsError]
"""The kind of error to raise."""


def read_yaml(path: str | PathLike[str], error: MakeError = DesignFileError) -> dict[Any, Any]:
    """Return the mapping that a YAML file holds, or raise errors of one kind.

    Raises:
        TsobsError: The file is missing, too large, not YAML, or not a mapping.
    """
    return yaml_mapping(read_text(path, error), path, error)


def read_text(path: str | PathLike[str], error: MakeError = DesignFileError) -> str:
    """Return a small file's text with its line ends unchanged; raises as `read_yaml`."""
    with naming_path(path, error), open_regular(Path(path)) as stream:
        raw = stream.read(MAX_BYTES + 1)
    if len(raw) > MAX_BYTES:
        raise error(f"{path}: expected a YAML file of at most {MAX_BYTES} bytes, got a larger one")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not valid YAML: {problem}") from problem


def yaml_mapping(
    text: str, name: str | PathLike[str], error: MakeError = DesignFileError
) -> dict[Any, Any]:
    """Return the mapping that a YAML text of a file holds; raises as `read_yaml`."""
    try:
        data = load_yaml(text)
    except ValueError as problem:
        raise error(f"{name}: not valid YAML: {problem}") from problem
    if not isinstance(data, dict):
        got = "nothing: it is empty" if data is None else type(data).__name__
        raise error(f"{name}: expected a mapping, got {got}")
    return data


def yaml_text(header: str, data: Mapping[str, Any]) -> str:
    """Return plain data as YAML below a comment; no part of the data may occur twice."""
    text: str = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
    return header + text


def load_yaml(text: str) -> object:
    """Return the plain data that a YAML text of one document holds.

    Raises:
        ValueError: It is not YAML, is too large, has aliases, merge keys, tags of other languages
            or nests too deep; the message is one line.
    """
    if len(text) > MAX_BYTES:
        raise ValueError(f"larger than {MAX_BYTES} bytes")
    try:
        _check_structure(text)
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark, problem = (getattr(error, name, None) for name in ("problem_mark", "problem"))
        line = f"line {mark.line + 1}: " if mark else ""
        if mark and text[mark.index : mark.index + 1] == "\t":
            problem = "found a tab; indent by spaces"
        raise ValueError(line + str(problem or error).partition("\n")[0]) from error
    except (ValueError, OverflowError, RecursionError) as error:
        # Such as a date that does not exist, or a number of five thousand digits.
        raise ValueError(str(error).partition("\n")[0]) from error


def _check_structure(text: str) -> None:
    """Refuse structures that are dangerous to build, by parser events alone: without recursion."""
    if _TAGS.search(text):  # libyaml compares each one with all before it
        raise ValueError("abbreviations of tags are not supported")
    depth = nodes = 0
    for event in yaml.parse(text, Loader=_Loader):
        problem = ""
        nodes += isinstance(event, yaml.NodeEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent):
            problem = "aliases are not supported"
        elif nodes > _MAX_NODES:
            problem = f"more than {_MAX_NODES} values"
        elif depth > _MAX_DEPTH:
            problem = f"nested deeper than {_MAX_DEPTH} levels"
        elif isinstance(event, yaml.ScalarEvent) and event.implicit[0]:
            if event.value == "<<":
                problem = "merge keys are not supported"
            elif _LONG_NUMBER.fullmatch(event.value):
                problem = f"a number of {len(event.value)} digits"
        if problem:
            raise ValueError(f"line {event.start_mark.line + 1}: {problem}")
