/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * One tracker over ticks and samples of a recorded or live stream; see `replay/passes.py`.
 */
#ifndef TSOBS_REPLAY_H
#define TSOBS_REPLAY_H

#include "history.h"

enum {
    CERTAIN = 2 /* evidence of a sample's reception: it was received for certain */
};

/* Samples in the order in which ticks use them, `given.count` of them. evidence: of reception.
 * begins: whether the recorded innovations are those of an estimator without a past. */
typedef struct {
    measurements given;
    const int64_t *evidence, *begins;
} replay_samples;

/* A schedule's ticks. stamps, now: [ns]. min_known, max_known: numbers of samples that a tick
 * includes at least and at most. reset_after: number of samples after which the tracker is reset
 * before a tick, below 0 if it is not. estimates: recorded states and their bounds, NaN without,
 * (ticks, width); the width is 0 if no observer was recorded. */
typedef struct {
    const int64_t *stamps, *now, *min_known, *max_known, *reset_after;
    const double *estimates;
    int64_t width;
} replay_ticks;

/* What comes out. of_samples: their outcomes. ticks_of_use: tick that took a sample. newest: stamp
 * of the newest sample in use at a tick [ns]. there: whether it has an estimate. counts: numbers of
 * samples taken for certain, and at all. rows: the estimates from tick `begin` on. */
typedef struct {
    outcomes of_samples;
    int64_t *ticks_of_use, *newest, *there, *counts;
    double *rows;
} replay_results;

/* Make the ticks from `begin` to before `end`, as far as there is nothing to decide, and return the
 * first that was not made, or not finished. stale_after: age of the newest sample after which
 * nothing is estimated [ns]. */
int64_t make_ticks(
    tracker *t, const replay_samples *samples, const replay_ticks *ticks,
    const replay_results *results, int64_t begin, int64_t end, int64_t stale_after);

#endif
