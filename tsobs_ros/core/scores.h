/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * What scores of estimates are made of: sums over the samples of simulated runs.
 */
#ifndef TSOBS_SCORES_H
#define TSOBS_SCORES_H

#include <stdint.h>

/* Runs, what is true in them and what was estimated, by rows.
 *
 * times: of the samples [s]. truths, columns: states, disturbances and torques, (runs, samples,
 * columns). last_measured: the last sample with a measurement of each run, which does not count.
 * rows, width: estimates, (runs, samples, width); basis: the place in a row of what it rests on,
 * behind which there is whether it is claimed. */
typedef struct {
    int64_t runs, samples, columns[3], width, basis;
    const double *times, *truths[3], *rows;
    const int64_t *last_measured;
} scored_runs;

/* What is scored, and by which limits.
 *
 * places: of each quantity the kind of its truth and its column, and its place in a row and that of
 * its bound, or -1, (quantities, 4). jumps: size above which a step of the truth is a jump. claims:
 * what a bound is said to be, by the basis, (bases,), of so many. after_start, after_jump: times
 * that do not count [s]. same_jump: jumps so close are one [s]. sigmas: half width of what is
 * inside, in bounds. */
typedef struct {
    int64_t quantities, bases, claim_count;
    const int64_t *places, *claims;
    const double *jumps;
    double after_start, after_jump, same_jump, sigmas;
} score_options;

/* Sums, zero before the first run.
 *
 * settled: over the settled parts error^2, errors, bound^2, bounds, errors inside, (runs,
 * quantities, 5). claimed: errors, errors inside, (error / bound)^2, and the largest |error| /
 * bound by the claim, (runs, claims, quantities, 4). counts: samples by the claim, (runs, claims).
 * reach: the largest size of the first state, (runs,). scratch: (2, quantities). */
typedef struct {
    double *settled, *claimed, *reach, *scratch;
    int64_t *counts;
} score_sums;

void add_up(const scored_runs *runs, const score_options *options, const score_sums *sums);

#endif
