# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Message definitions from the installed interface packages, as rosbag2 stores them in a bag.

Every interface package installs the text of a type as `share/<package>/msg/<Type>.msg`, or only as
`<Type>.idl`, and its RIHS01 hash in `<Type>.json`. No ROS import is needed. A message of a service
or an action, such as `package/srv/<Type>_Event`, has the text of the `.srv` or `.action` file.
"""

import json
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tsobs_ros.errors import BagWriteError
from tsobs_ros.files import naming_path

_SEPARATOR = "=" * 80
_TYPE_NAME = re.compile(
    r"([A-Za-z][A-Za-z0-9_]*)/(?:(msg|srv|action)/)?([A-Za-z][A-Za-z0-9_]*)", flags=re.ASCII
)
_FIELD_TYPE = re.compile(
    r"^[ \t]*([A-Za-z0-9_/]+)(?:\[[^\]]*\])?[ \t]+", flags=re.ASCII | re.MULTILINE
)
_IDL_INCLUDE = re.compile(r"^#include\s+[\"<]([A-Za-z0-9_/]+)\.idl[\">]", flags=re.MULTILINE)
# wstring is left out: rosbag2 stores a message that has one in IDL.
_PRIMITIVES = {"string", "bool", "byte", "char", "float32", "float64"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
# The messages of a service or an action have no file of their own.
_OF_SERVICE = re.compile(
    "((_SendGoal|_GetResult)?_(Event|Request|Response)|_FeedbackMessage|_Goal|_Result|_Feedback)$"
)

# The definitions that our bags need, without comments, for machines without ROS: the text of each,
# then name and text of each type on which it depends.
_KNOWN = {
    "std_msgs/msg/String": ("string data\n",),
    "std_msgs/msg/Int64MultiArray": (
        "std_msgs/MultiArrayLayout layout\nint64[] data",
        "std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
        "std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n",
    ),
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        "float64[] effort",
        "std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
        "builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
    ),
}


class MessageDefinition(NamedTuple):
    """The definition of a message type, as a bag stores it.

    Attributes:
        type: Its full name, `package/msg/Type`.
        text: The text of its file and of the files of all types it depends on.
        type_hash: Its RIHS01 hash; empty if the installation has none.
        encoding: The language of the text, `ros2msg` or `ros2idl`.
    """

    type: str
    text: str
    type_hash: str
    encoding: str = "ros2msg"


def share_folders() -> tuple[Path, ...]:
    """Return the folders in which to search for interface packages, highest priority first.

    The prefixes of a sourced workspace come before the interpreter's own prefix, into which pip
    installs the packages without setting an environment variable.
    """
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    return tuple(dict.fromkeys(Path(prefix, "share") for prefix in [*prefixes, sys.prefix]))


def find_definition(msgtype: str, folders: Sequence[Path] | None = None) -> MessageDefinition:
    """Return the definition of a message type, complete with all dependencies.

    The text is byte for byte that of rosbag2: the root's text verbatim, then each dependency once,
    depth first, siblings in bytewise order. Like rosbag2's, it is in IDL if the type or a
    dependency has no `.msg` file. The types of an observer's bags need no installation.

    Args:
        msgtype: The type as `package/msg/Type` or `package/Type`, or a message of a service or an
            action.
        folders: The share folders to search; those of `share_folders` by default.

    Raises:
        BagWriteError: The name is not a message type's, or it or a dependency is not installed.
    """
    folders = share_folders() if folders is None else folders
    package, kind, name = _parts(msgtype)
    full = f"{package}/{kind}/{name}"
    try:
        text, encoding = _with_dependencies(full, "msg", folders, set()), "ros2msg"
    except BagWriteError as error:
        try:
            text = _with_dependencies(full, "idl", folders, set())
        except BagWriteError:
            if full not in _KNOWN:
                raise error from None
            return MessageDefinition(full, f"\n{_SEPARATOR}\nMSG: ".join(_KNOWN[full]), "")
        text, encoding = f"{_SEPARATOR}\nIDL: {full}\n{text}", "ros2idl"
    return MessageDefinition(full, text, _type_hash(full, folders), encoding)


def _parts(msgtype: str) -> tuple[str, str, str]:
    """Return package, kind and name of a type."""
    match = _TYPE_NAME.fullmatch(msgtype)
    if match is None:
        raise BagWriteError(f"'{msgtype}' is not a message type: expected package/msg/Type")
    return match[1], match[2] or "msg", match[3]


def _with_dependencies(msgtype: str, language: str, folders: Sequence[Path], seen: set[str]) -> str:
    """Return a type's text, followed by those of its dependencies that are not in `seen`."""
    package, kind, _ = _parts(msgtype)
    try:
        # Bytes, not text mode: a definition with Windows line ends must stay as it is.
        text = _find(msgtype, kind if language == "msg" else language, folders).decode()
    except UnicodeDecodeError as error:
        raise BagWriteError(f"{msgtype}: its definition is not UTF-8: {error}") from error
    if language == "idl":
        needed = set(_IDL_INCLUDE.findall(text))
    else:
        types = set(_FIELD_TYPE.findall(text)) - _PRIMITIVES
        needed = {name if "/" in name else f"{package}/{name}" for name in types}
    for name in sorted(needed, key=str.encode):
        if name not in seen:
            seen.add(name)
            text += f"\n{_SEPARATOR}\n{language.upper()}: {name}\n"
            text += _with_dependencies(name, language, folders, seen)
    return text


def _type_hash(msgtype: str, folders: Sequence[Path]) -> str:
    try:
        entries = json.loads(_find(msgtype, "json", folders))["type_hashes"]
        return next(str(e["hash_string"]) for e in entries if e["type_name"] == msgtype)
    except (BagWriteError, ValueError, KeyError, TypeError, StopIteration):
        # Packages built before Iron have no hash, and a bag is complete without one.
        return ""


def _find(msgtype: str, extension: str, folders: Sequence[Path]) -> bytes:
    """Return the content of a type's file."""
    package, kind, name = _parts(msgtype)
    file = name if kind == "msg" else _OF_SERVICE.sub("", name)
    relative = f"{package}/{kind}/{file}.{extension}"
    for folder in folders:
        if (path := folder / relative).is_file():
            with naming_path(path, BagWriteError):
                return path.read_bytes()
    searched, full = ", ".join(map(str, folders)), f"{package}/{kind}/{name}"
    raise BagWriteError(f"message type {full} is not installed: no {relative} in {searched}")
