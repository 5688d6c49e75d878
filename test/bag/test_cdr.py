# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Definitions come from bags, so that hostile ones must neither end nor occupy a check."""

import pytest

from tsobs_ros.bag.definitions import MessageLayout
from tsobs_ros.errors import MessageError

HEADER = b"\x00\x01\x00\x00"


def nested(depth: int, fields: int) -> str:
    """Return a definition in which each type has several of the next one."""
    definitions = [
        "\n".join(f"T{level + 1} field_{n}" for n in range(fields)) for level in range(depth)
    ]
    definitions.append("uint8 value")
    separator = "=" * 80
    first, *others = definitions
    texts = [f"{separator}\nMSG: p/T{n}\n{text}" for n, text in enumerate(others, start=1)]
    return "\n".join([first, *texts, ""])


def test_a_message_has_the_length_its_definition_gives_it() -> None:
    layout = MessageLayout("p/msg/T0", nested(depth=3, fields=2))

    layout.check(HEADER + bytes(8))
    with pytest.raises(MessageError, match="its values need 12 bytes, but it has 11"):
        layout.check(HEADER + bytes(7))


def test_a_type_of_ever_more_parts_is_given_up_where_the_message_ends() -> None:
    layout = MessageLayout("p/msg/T0", nested(depth=60, fields=2))

    with pytest.raises(MessageError, match="its values need"):
        layout.check(HEADER + bytes(8))


def test_a_type_that_is_nested_too_deep_is_malformed() -> None:
    with pytest.raises(ValueError, match="nested too deep"):
        MessageLayout("p/msg/T0", nested(depth=5000, fields=1))
