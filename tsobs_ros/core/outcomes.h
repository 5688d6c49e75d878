/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Outcomes of measurements, in the order of `estimation.records.RejectReason`.
 */
#ifndef TSOBS_OUTCOMES_H
#define TSOBS_OUTCOMES_H

enum {
    USED,
    NON_FINITE,
    WRONG_JOINT,
    DUPLICATE,
    TOO_OLD,
    FROM_FUTURE,
    GATED,
    ZERO_STAMP,
    IMPLAUSIBLE_TORQUE, /* of which the outputs were used */
    MISSING_INPUT,      /* of a message that lacks one */
    UNKNOWN_INPUT,      /* one is NaN; the outputs were used */
    OUTCOMES
};

#endif
