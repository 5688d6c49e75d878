# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Python classes of ROS types that are known by name only."""

import re
from importlib import import_module
from typing import Any

from tsobs_ros.bag.definitions import share_folders
from tsobs_ros.errors import NodeError

_NAME = re.compile(r"([A-Za-z]\w*)/(msg|srv|action)/([A-Za-z]\w*)", flags=re.ASCII)


def message_class(name: str) -> type[Any]:
    """Return the class of a message type.

    Args:
        name: The type's full name, `package/msg/Type`; services' events and actions' feedback are
            messages too, such as `package/srv/Type_Event`.

    Raises:
        NodeError: That is no type's name, or no installed one.
    """
    if (match := _NAME.fullmatch(name)) is None:
        raise NodeError(f"'{name}' is not a message type: expected package/msg/Type")
    package, kind, type_name = match.groups()
    # Names come from bags and networks, and importing runs code: of interface packages only.
    if not any((folder / package / kind).is_dir() for folder in share_folders()):
        raise NodeError(f"{name} is not installed")
    try:
        found: type[Any] = getattr(import_module(f"{package}.{kind}"), type_name)
    except (ImportError, AttributeError) as error:
        raise NodeError(f"the Python module of {name} is not installed: {error}") from error
    return found
