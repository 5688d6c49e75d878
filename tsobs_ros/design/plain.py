# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Reading and writing plain YAML files, so that whatever goes wrong names the file."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tsobs_ros.errors import DesignFileError, ModelError
from tsobs_ros.yaml_files import PlainDumper, load_yaml

_LARGEST_FILE = 1 << 20


def read_yaml(path: Path) -> Mapping[str, Any]:
    """Return the mapping that a YAML file holds.

    Raises:
        DesignFileError: The file is missing, too large, not YAML, or not a mapping.
    """
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise DesignFileError(f"{path}: larger than {_LARGEST_FILE} bytes, not a design file")
        data = load_yaml(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DesignFileError(f"{path}: no such design file") from error
    except OSError as error:
        raise DesignFileError(f"{path}: cannot read the design file: {error.strerror}") from error
    except ValueError as error:  # not UTF-8 is one as well
        raise DesignFileError(f"{path}: not valid YAML: {error}") from error
    if not isinstance(data, dict):
        raise DesignFileError(f"{path}: expected a mapping, got {type(data).__name__}")
    return data


def write_yaml(path: Path, header: str, data: Mapping[str, Any]) -> None:
    """Write a YAML file; an existing file is replaced only once the new one is complete.

    Raises:
        DesignFileError: The file cannot be written.
    """
    written = header + yaml.dump(
        data, Dumper=PlainDumper, sort_keys=False, default_flow_style=None, width=100
    )
    temporary = path.with_name(path.name + ".tmp")
    try:
        temporary.write_text(written, encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise DesignFileError(f"{path}: cannot write the design file: {error.strerror}") from error


@contextlib.contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Turn every error of what a file asks for into one that names the file."""
    try:
        yield
    except (DesignFileError, ModelError, ArithmeticError, ValueError, np.linalg.LinAlgError) as e:
        raise DesignFileError(f"{path}: {e}") from e
