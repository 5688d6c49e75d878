# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Message definitions from the installed interface packages, as rosbag2 stores them in a bag.

Every interface package installs `share/<package>/msg/<Type>.msg`, its text, and `<Type>.json`,
which carries the RIHS01 hash of the type. Both are read from disk: no ROS import is needed.
"""

import json
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tsobs_ros.errors import BagWriteError

_SEPARATOR = "=" * 80
_TYPE_NAME = re.compile(r"([A-Za-z][A-Za-z0-9_]*)/(?:msg/)?([A-Za-z][A-Za-z0-9_]*)")
_FIELD_TYPE = re.compile(
    r"^[ \t]*([A-Za-z0-9_/]+)(?:\[[^\]]*\])?[ \t]+", flags=re.ASCII | re.MULTILINE
)
_PRIMITIVES = frozenset({"bool", "byte", "char", "float32", "float64", "string", "wstring"}) | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}


class MessageDefinition(NamedTuple):
    """What a bag stores about one message type.

    Attributes:
        type: Its full name, `package/msg/Type`.
        text: The text of its `.msg` file and of all it depends on, in `ros2msg` encoding.
        type_hash: Its RIHS01 hash; empty when the installation does not tell.
    """

    type: str
    text: str
    type_hash: str


def share_folders() -> tuple[Path, ...]:
    """Return the folders interface packages are looked for in, first match first.

    The prefixes of a sourced workspace come before the interpreter's own, where the packages are
    after an installation by pip, which sets no environment variable.
    """
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    return tuple(dict.fromkeys(Path(prefix, "share") for prefix in [*prefixes, sys.prefix]))


def find_definition(msgtype: str, folders: Sequence[Path] | None = None) -> MessageDefinition:
    """Return the definition of a message type, complete with all it depends on.

    The order is rosbag2's, so that the text is the same to the byte: the root's text verbatim,
    then each dependency once, depth first, siblings in bytewise order.

    Args:
        msgtype: The type as `package/msg/Type` or `package/Type`.
        folders: The share folders to search; those of `share_folders` by default.

    Raises:
        BagWriteError: The name is not a message type's, or it or a dependency is not installed.
    """
    searched = share_folders() if folders is None else tuple(folders)
    package, name = _split(msgtype)
    path = _find(package, name, searched)
    seen: set[str] = set()
    text = _with_dependencies(path, package, searched, seen)
    full_name = f"{package}/msg/{name}"
    return MessageDefinition(full_name, text, _type_hash(path, full_name))


def _split(msgtype: str) -> tuple[str, str]:
    match = _TYPE_NAME.fullmatch(msgtype)
    if match is None:
        raise BagWriteError(f"'{msgtype}' is not a message type: expected package/msg/Type")
    return match[1], match[2]


def _find(package: str, name: str, folders: Sequence[Path]) -> Path:
    for folder in folders:
        path = folder / package / "msg" / f"{name}.msg"
        if path.is_file():
            return path
    searched = ", ".join(map(str, folders)) or "no folder at all"
    raise BagWriteError(
        f"message type {package}/msg/{name} is not installed: no {package}/msg/{name}.msg in "
        f"{searched}"
    )


def _with_dependencies(path: Path, package: str, folders: Sequence[Path], seen: set[str]) -> str:
    # Bytes, not text mode: a definition with Windows line ends must stay as it is.
    text = path.read_bytes().decode()
    parts = [text]
    for dependency in sorted(_dependencies(text, package), key=str.encode):
        if dependency not in seen:
            seen.add(dependency)
            dependency_package, name = _split(dependency)
            dependency_path = _find(dependency_package, name, folders)
            parts.append(f"\n{_SEPARATOR}\nMSG: {dependency}\n")
            parts.append(_with_dependencies(dependency_path, dependency_package, folders, seen))
    return "".join(parts)


def _dependencies(text: str, package: str) -> set[str]:
    types = set(_FIELD_TYPE.findall(text)) - _PRIMITIVES
    return {name if "/" in name else f"{package}/{name}" for name in types}


def _type_hash(path: Path, full_name: str) -> str:
    try:
        entries = json.loads(path.with_suffix(".json").read_bytes())["type_hashes"]
        return next(str(e["hash_string"]) for e in entries if e["type_name"] == full_name)
    except (OSError, ValueError, KeyError, TypeError, StopIteration):
        # Packages built before Iron have no hash, and a bag is complete without one.
        return ""
