# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Python classes of ROS types that are known by name only."""

import re
from functools import reduce
from importlib import import_module
from typing import Any

from tsobs_ros.bag.definitions import share_folders
from tsobs_ros.errors import NodeError

_NAME = re.compile(r"([A-Za-z]\w*)/(msg|srv|action)/([A-Za-z]\w*)", flags=re.ASCII)
# Where the class of what a service or an action sends is, within that of the service or action.
_NESTED = {
    "srv": {"_Event": "Event"},
    "action": {
        "_SendGoal_Event": "Impl.SendGoalService.Event",
        "_GetResult_Event": "Impl.GetResultService.Event",
        "_FeedbackMessage": "Impl.FeedbackMessage",
    },
}


def message_class(name: str) -> type[Any]:
    """Return the class of a message type.

    Args:
        name: The type, `package/msg/Type`, or one that a service or an action brings along, such
            as `package/srv/Type_Event`.

    Raises:
        NodeError: That is no type's name, or no installed one.
    """
    if (match := _NAME.fullmatch(name)) is None:
        raise NodeError(f"'{name}' is not a message type: expected package/msg/Type")
    package, kind, type_name = match.groups()
    # Names come from bags and networks, and importing runs code: of interface packages only.
    if not any((folder / package / kind).is_dir() for folder in share_folders()):
        raise NodeError(f"{name} is not installed")
    path = type_name
    for suffix, nested in _NESTED.get(kind, {}).items():
        if type_name.endswith(suffix):
            path = f"{type_name.removesuffix(suffix)}.{nested}"
            break
    try:
        module: Any = import_module(f"{package}.{kind}")
        found: type[Any] = reduce(getattr, path.split("."), module)
    except (ImportError, AttributeError) as error:
        raise NodeError(f"the Python module of {name} is not installed: {error}") from error
    return found
