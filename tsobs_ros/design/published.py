# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The record of design files and parameters that an observer runs, as one text.

The node publishes it on its topic `design`, latched, so that a bag has all that its estimates were
made with. It has the files' content to the byte, for their checksum and their strict loader. The
text is JSON, as YAML would change line ends.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tsobs_ros.design.file import DesignFile
from tsobs_ros.errors import DesignFileError
from tsobs_ros.schema import decode, encode
from tsobs_ros.yaml_files import MAX_BYTES

FORMAT, VERSION = "tsobs_ros observer", 1

Value = bool | int | float | str
"""A parameter's value."""


@dataclass
class PublishedDesign:
    """A design file, and the joints that are observed with it."""

    joints: list[str]
    file: str
    text: str


@dataclass(kw_only=True)
class ObserverRecord:
    """The full name of the measurements' topic, designs, and parameters that decide estimates."""

    format: str = FORMAT
    version: int = VERSION
    measurements: str
    designs: list[PublishedDesign]
    parameters: dict[str, Value]


def record_text(
    measurements: str,
    joints: Sequence[str],
    files: Sequence[DesignFile],
    parameters: Mapping[str, Value],
) -> str:
    """Return the text of a record, from each joint's name and design file."""
    designs: dict[tuple[str, str], PublishedDesign] = {}
    for joint, file in zip(joints, files, strict=True):
        key = file.name, file.text
        designs.setdefault(key, PublishedDesign([], *key)).joints.append(joint)
    record = ObserverRecord(
        measurements=measurements, designs=list(designs.values()), parameters=dict(parameters)
    )
    return json.dumps(encode(record))


def read_record(text: str) -> ObserverRecord:
    """Return the record in a text that anybody may have written; designs are not looked into.

    Raises:
        DesignFileError: The text is too large, or no record.
    """
    if len(text) > MAX_BYTES:
        raise DesignFileError(f"larger than {MAX_BYTES} bytes")
    try:
        record = decode(json.loads(text), ObserverRecord)
    except (ValueError, RecursionError) as error:
        raise DesignFileError(f"no record of an observer: {error}") from error
    if (record.format, record.version) != (FORMAT, VERSION):
        raise DesignFileError(
            f"expected format {FORMAT!r} of version {VERSION}, got {record.format[:60]!r} of "
            f"version {record.version}"
        )
    return record
