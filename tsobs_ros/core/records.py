# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""NumPy types of the records of the compiled core, made from the layouts that it states."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

Layout = Iterable[tuple[str, str, int, int]]
"""Name, kind, rows and columns of the fields of a record, as layout.h defines them."""


def record_type(layout: Layout, inner: Mapping[str, "np.dtype[Any]"] | None = None) -> Any:
    """Return the NumPy type of a record.

    Args:
        layout: Of its fields.
        inner: Types of the fields that are records themselves: a MATRIX has one per row, a VECTOR
            is a single one.
    """
    nested = inner or {}
    fields: list[tuple[Any, ...]] = []
    for name, kind, rows, columns in layout:
        number = np.int64 if kind.startswith("COUNT") else np.float64
        if name in nested:
            fields.append(
                (name, nested[name], (rows,)) if kind == "MATRIX" else (name, nested[name])
            )
        elif kind in ("NUMBER", "COUNT"):
            fields.append((name, number))
        else:
            fields.append((name, number, (rows, columns) if kind == "MATRIX" else (rows,)))
    return np.dtype(fields)
