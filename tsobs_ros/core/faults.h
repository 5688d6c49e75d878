/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * What the fault monitor adds up at each sample and estimate of a sensor; `estimation/faults.py`
 * judges it ten times a second.
 */
#ifndef TSOBS_FAULTS_H
#define TSOBS_FAULTS_H

#include "layout.h"

enum {
    BLOCKS = 150, /* tenths of a second that are remembered */
    LEAST_BLOCKS = 10 /* of them to judge by */
};

/* What is remembered of a sensor.
 *
 * std: 1 sigma of the noise [rad]. value to repeats: see repeats.h. since: stamp of the first
 * sample with the present value [ns]. stuck: whether it has come for a tenth of a second, with ten
 * repetitions that count. lacking: stamp from which samples lack a value [ns], 0 if the newest has
 * one; missing: whether that is a tenth of a second.
 * stamp: of the latest innovation in order [ns], 0 before it. normalised: that one in sigmas,
 * clipped at 5. square, product: averages over a second of its square, 1 if the model fits, and of
 * its product with the one before. period: between the last two [s]. seen, last: stamp of the
 * latest sample in order, gated or not [ns], and its innovation as `normalised`. outliers: share of
 * lone samples beyond 5 sigmas, an average over five seconds. predicted: latest predicted output
 * [rad].
 * estimated: stamp of the latest estimate [ns], 0 before it. begun: stamp of the history's first
 * estimate [ns], 0 before it. block, in_block, sums: the tenth of a second since then, its
 * estimates' number and sums of disturbance, motion and bound. blocks, count: the last quarter of a
 * minute, a row a tenth of a second: its end [s] and the means. least: number of rows to judge by.
 * renewed: whether the history was forgotten, after a gap 1, after a stuck sensor 2. complete:
 * whether the latest estimate ended a tenth of a second. */
#define WATCH_FIELDS(F, s)      \
    F(NUMBER, std, 1, 1)        \
    F(NUMBER, value, 1, 1)      \
    F(NUMBER, step, 1, 1)       \
    F(NUMBER, rough, 1, 1)      \
    F(NUMBER, before, 1, 1)     \
    F(NUMBER, nearest, 1, 1)    \
    F(COUNT, repeats, 1, 1)     \
    F(COUNT, since, 1, 1)       \
    F(COUNT, stuck, 1, 1)       \
    F(COUNT, lacking, 1, 1)     \
    F(COUNT, missing, 1, 1)     \
    F(COUNT, stamp, 1, 1)       \
    F(NUMBER, normalised, 1, 1) \
    F(NUMBER, square, 1, 1)     \
    F(NUMBER, product, 1, 1)    \
    F(NUMBER, period, 1, 1)     \
    F(COUNT, seen, 1, 1)        \
    F(NUMBER, last, 1, 1)       \
    F(NUMBER, outliers, 1, 1)   \
    F(NUMBER, predicted, 1, 1)  \
    F(COUNT, estimated, 1, 1)   \
    F(COUNT, begun, 1, 1)       \
    F(COUNT, block, 1, 1)       \
    F(COUNT, in_block, 1, 1)    \
    F(VECTOR, sums, 3, 1)       \
    F(MATRIX, blocks, BLOCKS, 4) \
    F(COUNT, count, 1, 1)       \
    F(COUNT, least, 1, 1)       \
    F(COUNT, renewed, 1, 1)     \
    F(COUNT, complete, 1, 1)
LAYOUT_DECLARE(watch, WATCH_FIELDS, void)

/* Samples of k sensors, m of each, in the order of their stamps.
 *
 * stamps: [ns]. values: raw ones. codes: outcomes, see outcomes.h. innovations: y - C x, and the
 * 1 sigma expected of each. All but the stamps have m numbers for each sensor. */
typedef struct {
    int64_t sensors, count;
    const int64_t *stamps, *codes;
    const double *values, *innovations, *expected_std;
} sensor_samples;

/* Take in samples, those of them that were used, gated for their value or missing. */
void add_samples(double *watches, const sensor_samples *samples);

/* Take in an estimate of each of k sensors; return whether there is something to judge.
 *
 * stamp: [ns]; one that does not rise is passed over. disturbances: estimated ones, NaN without
 * [rad]. bounds: of 1 sigma [rad]. */
int add_estimates(
    double *watches, int64_t sensors, int64_t stamp, const double *disturbances,
    const double *bounds);

#endif
