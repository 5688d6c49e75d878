# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Why samples are not used: the tracker's reasons, and two that only messages tell apart.

A missing input is no wrong shape, and one that is NaN is not implausible but unknown.
"""

from collections import Counter
from collections.abc import Mapping

from tsobs_ros.estimation.health import meaning
from tsobs_ros.estimation.history import IMPLAUSIBLE_TORQUE, REASONS
from tsobs_ros.estimation.records import RejectReason

WRONG = REASONS.index(RejectReason.WRONG_JOINT)
MISSING = REASONS.index(RejectReason.MISSING_INPUT)
UNKNOWN = REASONS.index(RejectReason.UNKNOWN_INPUT)
NAMES = tuple(reason.value if reason else "" for reason in REASONS)
"""Names of the reasons by their codes."""
COUNTED_AS = {MISSING: WRONG, UNKNOWN: IMPLAUSIBLE_TORQUE}
"""What the tracker counts the two further ones as."""
OF_INPUT = (IMPLAUSIBLE_TORQUE, UNKNOWN)
"""Of such a sample the outputs are used all the same."""

ADVICE: Mapping[str, str] = {reason.value: meaning(reason).remedy for reason in RejectReason}
"""What to do about each reason."""


MANY_TORQUES = 0.2
BEYOND_LIMIT = (
    "the drive is beyond the torque limit for a fifth of the time: the design's torque_limit is "
    "wrong"
)
"""What it means that more than this share of recent torques is implausible."""


def main_of(counts: Mapping[str, int]) -> str:
    """Return the reason with the most counts, "" if there are none."""
    known = Counter({name: counts[name] for name in NAMES[1:] if counts.get(name, 0) > 0})
    return known.most_common(1)[0][0] if known else ""
