# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Why samples are not used: the tracker's reasons, and two that only messages tell apart.

A missing input is no wrong shape, and one that is NaN is not implausible but unknown.
"""

from collections import Counter
from collections.abc import Mapping

from tsobs_ros.bag.estimate_topics import MISSING_INPUT, UNKNOWN_INPUT
from tsobs_ros.estimation.history import IMPLAUSIBLE_TORQUE, REASONS
from tsobs_ros.estimation.records import RejectReason

WRONG = REASONS.index(RejectReason.WRONG_JOINT)
MISSING, UNKNOWN = len(REASONS), len(REASONS) + 1
NAMES = (*(reason.value if reason else "" for reason in REASONS), MISSING_INPUT, UNKNOWN_INPUT)
"""Names of the reasons by their codes."""
COUNTED_AS = {MISSING: WRONG, UNKNOWN: IMPLAUSIBLE_TORQUE}
"""What the tracker counts the two further ones as."""
OF_INPUT = (IMPLAUSIBLE_TORQUE, UNKNOWN)
"""Of such a sample the outputs are used all the same."""

ADVICE: Mapping[str, str] = {
    RejectReason.NON_FINITE.value: "the driver has no reading; see what it logs",
    RejectReason.WRONG_JOINT.value: "compare the names in the messages with the parameter `joints`",
    RejectReason.DUPLICATE.value: "does a second publisher, or a bridge, send the same samples?",
    RejectReason.TOO_OLD.value: "compare the clocks of sensor and node; `history` is the limit",
    RejectReason.FROM_FUTURE.value: (
        "compare the clocks of sensor and node; in simulations, `use_sim_time`"
    ),
    RejectReason.GATED.value: "is the design this arm's, the unit rad, the sign right?",
    RejectReason.ZERO_STAMP.value: (
        "let the driver stamp with the time of sampling, or republish its messages with stamps"
    ),
    RejectReason.IMPLAUSIBLE_TORQUE.value: "is the unit N m? `torque_limit` has what is plausible",
    MISSING_INPUT: (
        "publish it in the same messages; `assume_zero_torque` takes a missing effort as 0"
    ),
    UNKNOWN_INPUT: "the outputs are used; publish numbers to have narrower bounds",
}
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
