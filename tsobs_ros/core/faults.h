/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * What the fault monitor adds up at each sample and estimate of a sensor; `estimation/faults.py`
 * judges it ten times a second.
 */
#ifndef TSOBS_FAULTS_H
#define TSOBS_FAULTS_H

#include "repeats.h"

enum {
    BLOCKS = 150, /* tenths of a second that are remembered */
    LEAST_BLOCKS = 10 /* of them to judge by */
};

/* What is remembered of a sensor. Innovations are in sigmas, clipped at 5; stamps are 0 before the
 * first. */
#define WATCH_FIELDS(F, s)                                                                       \
    F(NUMBER, std, 1, 1)         /* 1 sigma of the noise */                                      \
    REPETITION_FIELDS(F, s)                                                                      \
    F(COUNT, since, 1, 1)        /* stamp of the first sample with the present value [ns] */     \
    F(COUNT, stuck, 1, 1)        /* whether that repeats for a tenth of a second, ten times */   \
    F(COUNT, lacking, 1, 1)      /* stamp since which samples lack a value [ns], */              \
    F(COUNT, missing, 1, 1)      /* and whether that is a tenth of a second ago */               \
    F(COUNT, stamp, 1, 1)        /* of the latest innovation in order [ns], */                   \
    F(NUMBER, normalised, 1, 1)  /* and that one */                                              \
    F(NUMBER, square, 1, 1)      /* average of its square over a second, 1 if the model fits, */ \
    F(NUMBER, product, 1, 1)     /* and of its product with the one before */                    \
    F(NUMBER, period, 1, 1)      /* between the last two [s] */                                  \
    F(COUNT, seen, 1, 1)         /* stamp of the latest sample in order, gated or not [ns], */   \
    F(NUMBER, last, 1, 1)        /* and its innovation */                                        \
    F(NUMBER, outliers, 1, 1)    /* share of lone samples beyond 5 sigmas, over five seconds */  \
    F(NUMBER, predicted, 1, 1)   /* latest predicted output */                                   \
    F(COUNT, estimated, 1, 1)    /* stamp of the latest estimate [ns], */                        \
    F(COUNT, begun, 1, 1)        /* and of the first one in the history */                       \
    F(COUNT, block, 1, 1)        /* tenth of a second since then, */                             \
    F(COUNT, in_block, 1, 1)     /* number of its estimates, */                                  \
    F(VECTOR, sums, 3, 1)        /* and sums of disturbance, motion and bound */                 \
    F(MATRIX, blocks, BLOCKS, 4) /* their ends [s] and means */                                  \
    F(COUNT, count, 1, 1)        /* number of these rows, */                                     \
    F(COUNT, least, 1, 1)        /* and of those to judge by */                                  \
    F(COUNT, renewed, 1, 1)      /* why the history was forgotten: 1 a gap, 2 a stuck sensor */  \
    F(COUNT, complete, 1, 1)     /* whether the latest estimate ended a block */
LAYOUT_DECLARE(watch, WATCH_FIELDS, void)

/* Samples of k sensors, m of each, in the order of their stamps.
 *
 * stamps: [ns]. values: raw ones. codes: outcomes, see estimator.h. innovations: y - C x, and the
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
