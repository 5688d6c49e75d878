# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""NumPy types of the records of the compiled core, made from the layouts that it declares."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from tsobs_ros.core import native


def record_type(
    name: str, sizes: Iterable[int] = (), inner: Mapping[str, "np.dtype[Any]"] | None = None
) -> Any:
    """Return the NumPy type of a record of some sizes.

    Fields that are records themselves have the types of `inner`; a MATRIX has one record per row.
    """
    nested = inner or {}
    fields: list[tuple[Any, ...]] = []
    for field, kind, rows, columns in native.layout(name, np.array([*sizes], np.int64)):
        number = np.int64 if kind.startswith("COUNT") else np.float64
        if field in nested:
            fields.append(
                (field, nested[field], (rows,)) if kind == "MATRIX" else (field, nested[field])
            )
        elif kind in ("NUMBER", "COUNT"):
            fields.append((field, number))
        else:
            fields.append((field, number, (rows, columns) if kind == "MATRIX" else (rows,)))
    return np.dtype(fields)
