# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hostile variants of good files: cut, flipped, spliced, and with values at their extremes."""

import random
import re
import struct
from collections.abc import Sequence

_NUMBERS = (
    "0", "-1", "1e308", "-1e308", "1e-320", ".nan", ".inf", "-.inf", "1e999", "9" * 400, "1e-4",
    "0x7fffffffffffffff", "9223372036854775808", "true", "null", "''", "[]", "{}", "1_0", "1:2:3",
    "2001-01-01", "!!binary aGk=",
)  # fmt: skip
_FRAGMENTS = (
    "[" * 2000, "{a: " * 500, "&a [*a, *a]", "<<: {a: 1}", "!!python/object/apply:os.abort []",
    "\t", "\x00", "- - - - ", "? ", "%YAML 9.9\n---\n", "\u2028", "'", '"', "#", "\ufeff", "*x",
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_INTEGERS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**63 - 1, 2**64 - 1)


def mutated_text(seed: bytes, others: Sequence[bytes], random_: random.Random) -> bytes:
    """Return a text file with one to four mutations."""
    data = seed
    for _ in range(random_.randint(1, 4)):
        if random_.random() < 0.5:
            data = _number_replaced(data, random_)
        elif random_.random() < 0.3:
            place = random_.randint(0, len(data))
            data = data[:place] + random_.choice(_FRAGMENTS).encode() + data[place:]
        elif random_.random() < 0.4:
            data = _lines_changed(data, random_)
        else:
            data = _bytes_changed(data, others, random_)
    return data


def mutated_bytes(seed: bytes, others: Sequence[bytes], random_: random.Random) -> bytes:
    """Return a binary file with one to four mutations."""
    data = seed
    for _ in range(random_.randint(1, 4)):
        if data and random_.random() < 0.4:
            data = _integer_replaced(data, random_)
        else:
            data = _bytes_changed(data, others, random_)
    return data


def _number_replaced(data: bytes, random_: random.Random) -> bytes:
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    match = random_.choice(found)
    return data[: match.start()] + random_.choice(_NUMBERS).encode() + data[match.end() :]


def _lines_changed(data: bytes, random_: random.Random) -> bytes:
    """Remove, repeat, swap or indent a line."""
    lines = data.split(b"\n")
    first, second = random_.randrange(len(lines)), random_.randrange(len(lines))
    action = random_.randrange(4)
    if action == 0:
        del lines[first]
    elif action == 1:
        lines.insert(second, lines[first])
    elif action == 2:
        lines[first], lines[second] = lines[second], lines[first]
    else:
        lines[first] = b" " * random_.randint(1, 6) + lines[first]
    return b"\n".join(lines)


def _integer_replaced(data: bytes, random_: random.Random) -> bytes:
    """Overwrite a place with an extreme little-endian integer."""
    code = random_.choice("BHIQ")
    size = struct.calcsize(code)
    if len(data) < size:
        return data
    place = random_.randint(0, len(data) - size)
    value = random_.choice(_INTEGERS) & (256**size - 1)
    return data[:place] + struct.pack(f"<{code}", value) + data[place + size :]


def _bytes_changed(data: bytes, others: Sequence[bytes], random_: random.Random) -> bytes:
    """Cut, remove, repeat, zero, flip or splice."""
    start = random_.randint(0, len(data))
    end = min(len(data), start + random_.choice((1, 4, 64, 4096)))
    action = random_.randrange(7)
    if action == 0:
        return data[:start]
    if action == 1:
        return data[:start] + data[end:]
    if action == 2:
        return data[:end] + data[start:]
    if action == 3:
        return data[:start] + bytes(end - start) + data[end:]
    if action == 4:
        return data[:start] + random_.randbytes(end - start) + data[end:]
    if action == 5 and others:
        other = random_.choice(list(others))
        return data[:start] + other[random_.randint(0, len(other)) :]
    flipped = bytearray(data)
    for _ in range(random_.randint(1, 8)):
        if flipped:
            flipped[random_.randrange(len(flipped))] ^= 1 << random_.randrange(8)
    return bytes(flipped)
