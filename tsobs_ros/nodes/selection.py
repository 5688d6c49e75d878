# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The selection of topics by lists and patterns, as parameters of recorder and player."""

import re
from dataclasses import dataclass

from tsobs_ros.errors import ParameterError
from tsobs_ros.nodes.managed import ManagedParameters
from tsobs_ros.settings import setting


@dataclass(frozen=True)
class SelectingParameters(ManagedParameters):
    """The parameters that select topics."""

    topics: tuple[str, ...] = setting((), "Topics to take; all of them without any selection")
    regex: str = setting("", "Take the topics in whose names this is found, too")
    exclude_topics: tuple[str, ...] = setting((), "Topics not to take")
    exclude_regex: str = setting("", "Do not take topics in whose names this is found")

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

    def takes(self, name: str, is_listed: bool, is_excluded: bool) -> bool:
        """Return whether to take a name by the patterns, and by whether the lists have it."""
        if is_excluded or (self.exclude_regex and re.search(self.exclude_regex, name)):
            return False
        return is_listed or bool(self.regex and re.search(self.regex, name))
