# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The unit of a log's angles, judged by the arm that they are to be of."""

import math
from typing import Any

import numpy as np

from tsobs_ros.bag.joint_series import Times
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.errors import LogError
from tsobs_ros.estimation.history import USED
from tsobs_ros.methods import ObserverSettings, make_ekf
from tsobs_ros.replay.columns import UNITS

_DEGREE = UNITS["angle"]["deg"]
# Of 112 simulated runs with the arm's own design, those in rad were at most 1.9, those in degrees
# that are read as rad at least 44. A wrong design may look like either.
_MISFIT, _FIT, _MIN_RATIO = 15.0, 6.0, 10.0
_MIN_USED = 50


def check_unit_of_angles(
    source: Any, settings: ObserverSettings, designs: tuple[Design, ...]
) -> None:
    """Refuse angles without a unit that fit the arm in degrees, and do not at all in radians.

    Args:
        source: The log, whose part with most motion is looked at.
        settings: How the observer is run.
        designs: One a joint.

    Raises:
        LogError: They seem to be degrees.
    """
    part = source.liveliest
    for joint, (titles, design) in enumerate(zip(source.without_unit, designs, strict=True)):
        if not titles:
            continue
        names = design.request.output_names
        angles = np.array([name.endswith("_angle") for name in names])
        y, u = part.y[:, joint, : len(names)], part.u[:, joint, :1]
        as_rad = _misfit(design, settings, part.stamps, y, u)
        if as_rad < _MISFIT:
            continue
        as_deg = _misfit(design, settings, part.stamps, np.where(angles, y * _DEGREE, y), u)
        if as_deg < min(_FIT, as_rad / _MIN_RATIO):
            columns = f"columns {', '.join(map(repr, titles))} have"
            if len(titles) == 1:
                columns = f"column {titles[0]!r} has"
            raise LogError(
                f"{source.path}: {columns} no unit, and its angles do not fit the arm "
                f"as rad (innovations of {as_rad:.0f}σ), but as deg they do ({as_deg:.1f}σ): write "
                f"'{titles[0]} [deg]' or --units angle=deg; if they are rad, --units angle=rad, "
                "and check the design"
            )


def _misfit(
    design: Design, settings: ObserverSettings, stamps: Times, outputs: Array, torques: Array
) -> float:
    """Return the median of |innovation| / expected 1σ of an EKF, 0 of too few measurements."""
    ekf, order = make_ekf(design, settings, gate=math.inf), np.argsort(stamps, kind="stable")
    times = stamps[order] - stamps.min() + 10**9
    found = ekf.offer_many(times, outputs[order], torques[order], int(times[-1]))
    misfits = np.abs(found.innovations) / found.expected_std
    # While the estimate settles, large innovations are expected.
    sizes = misfits[found.output_codes == USED][len(stamps) // 8 :]
    return float(np.median(sizes)) if len(sizes) >= _MIN_USED else 0.0
