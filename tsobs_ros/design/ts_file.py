# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Requests and designs for T–S systems as plain YAML; a top-level `system` tells them apart.

A design file holds its whole request as data, so it can be re-checked without anything else.
"""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tsobs_ros.checks import Array, shown
from tsobs_ros.design.entries import known_only, mapping, numbers
from tsobs_ros.design.file import solver_report
from tsobs_ros.design.plain import naming_file, read_yaml, write_yaml
from tsobs_ros.design.ts_design import TSDesign
from tsobs_ros.design.ts_entries import REQUEST_ENTRIES, parse_request, plain_request
from tsobs_ros.design.ts_request import TSRequest
from tsobs_ros.errors import DesignFileError

FORMAT = "tsobs_ros T-S design"
VERSION = 1
_HEADER = """\
# A certified observer design for a Takagi-Sugeno system, made by `tsobs design`. P and K are in
# the coordinates [states, disturbance states]. Loading re-checks every inequality, so a file that
# was edited by hand is refused unless its certificate still holds.
"""


def is_ts_file(path: Path) -> bool:
    """Return whether a request or design file is about a T–S system given by its matrices.

    Raises:
        DesignFileError: The file cannot be read.
    """
    return "system" in read_yaml(path)


def load_ts_request(path: Path) -> TSRequest:
    """Read what `tsobs design` is asked for.

    Raises:
        DesignFileError: The file is missing, too large, not YAML, or not a request; the text
            names the entry, what was expected and what came.
    """
    data = read_yaml(path)
    with naming_file(path):
        known_only("the file", data, REQUEST_ENTRIES)
        return parse_request(data)


def save_ts_design(design: TSDesign, path: Path) -> None:
    """Write a design file; an existing file is replaced only once the new one is complete.

    Raises:
        DesignFileError: The file cannot be written, or the system has memberships that no file
            can give.
    """
    with naming_file(path):
        data = {
            "format": FORMAT,
            "version": VERSION,
            **plain_request(design.request),
            "gain": {"K": design.K.tolist()},
            "certificate": {"P": design.P.tolist()},
            "solver": asdict(design.solver),
        }
    write_yaml(path, _HEADER, data)


def load_ts_design(path: Path) -> TSDesign:
    """Read a design file and re-check its certificate.

    Raises:
        DesignFileError: As for `load_ts_request`.
        CertificateError: The certificate does not hold; the text names each inequality, its
            vertices and its margin.
    """
    design = parse_ts_design(path)
    design.certificate.require(str(path))
    return design


def parse_ts_design(path: Path) -> TSDesign:
    """Read a design file without judging its certificate (for `tsobs verify`).

    Raises:
        DesignFileError: As for `load_ts_request`.
    """
    data = read_yaml(path)
    with naming_file(path):
        design = _design(data)
        # Evaluated here, where numbers no proof can be made of are refused with the file's name.
        _ = design.certificate
        return design


def _design(data: Mapping[str, Any]) -> TSDesign:
    if data.get("format") != FORMAT:
        raise DesignFileError(f"format: expected {FORMAT!r}, got {shown(data.get('format'))}")
    version = data.get("version")
    # True == 1 == 1.0 in Python, but only one of them is a version.
    if type(version) is not int or version != VERSION:
        raise DesignFileError(f"version: expected {VERSION}, got {shown(version)}")
    own = ("format", "version", "gain", "certificate", "solver")
    known_only("the file", data, (*own, *REQUEST_ENTRIES))
    request = parse_request({name: data[name] for name in data if name not in own})
    n, p = request.flow.state_count, request.flow.output_matrix.shape[0]
    K = _matrix(data, "gain", "K", (n, p))
    P = _matrix(data, "certificate", "P", (n, n))
    return TSDesign(request, P, K, solver_report(mapping("solver", data.get("solver"))))


def _matrix(data: Mapping[str, Any], part: str, name: str, shape: tuple[int, int]) -> Array:
    entry = mapping(part, data.get(part))
    known_only(part, entry, (name,))
    return np.asarray(numbers(f"{part}.{name}", entry.get(name), shape))
