# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What to do about samples that are not used, by the tracker's reasons."""

from collections import Counter
from collections.abc import Mapping

from tsobs_ros.estimation.health import meaning
from tsobs_ros.estimation.history import IMPLAUSIBLE_TORQUE, REASONS, UNKNOWN_INPUT
from tsobs_ros.estimation.records import RejectReason

WRONG = REASONS.index(RejectReason.WRONG_JOINT)
MISSING = REASONS.index(RejectReason.MISSING_INPUT)
NAMES = tuple(reason.value if reason else "" for reason in REASONS)
"""Names of the reasons by their codes."""
OF_INPUT = (IMPLAUSIBLE_TORQUE, UNKNOWN_INPUT)
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
