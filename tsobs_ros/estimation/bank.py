# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A bank of estimators: doing at once what can be done at once, and the rest one by one."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any, Generic, TypeVar

T = TypeVar("T")
O = TypeVar("O")  # noqa: E741
B = TypeVar("B", bound="Bank[Any]")
Members = tuple[int, ...]

_REMEMBERED = 32
"""Parts of a bank to keep: in use are few, but which of the joints are late may change for ever."""


class Bank(Generic[O]):
    """Observers of equal structure, whose arrays are stacked along a leading axis.

    Attributes:
        observers: One a member, each the authority on its own numbers.
    """

    def __init__(self, observers: Sequence[O]) -> None:
        self.observers = tuple(observers)
        self._parts: dict[Members, Any] = {}

    def only(self: B, members: Members) -> B:
        """Return the bank of some of the members, given their places."""
        if len(members) == len(self.observers):
            return self
        if members not in self._parts:
            if len(self._parts) >= _REMEMBERED:
                self._parts.clear()
            self._parts[members] = type(self)(of(members, self.observers))
        part: B = self._parts[members]
        return part


def in_groups(keys: Sequence[Hashable], step: Callable[[Members], Sequence[T]]) -> list[T]:
    """Take a step for all members that have a key in common, group by group.

    Args:
        keys: One a member.
        step: Returns the results of some members, given their places.

    Returns:
        The results of all members in their order.
    """
    if len(set(keys)) == 1:
        return list(step(tuple(range(len(keys)))))
    groups: dict[Hashable, list[int]] = {}
    for place, key in enumerate(keys):
        groups.setdefault(key, []).append(place)
    results: dict[int, T] = {}
    for group in groups.values():
        results.update(zip(group, step(tuple(group)), strict=True))
    return [results[place] for place in range(len(keys))]


def of(members: Members, items: Sequence[T]) -> Sequence[T]:
    """Return the items of some members, given their places."""
    return items if len(members) == len(items) else [items[place] for place in members]
