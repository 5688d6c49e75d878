/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The extended Kalman filter of an arm that others are compared with, over stamped samples in any
 * order.
 *
 * Its states are [x; w] of a prediction model, and with k > 0 behind them its parameters theta, as
 * states that wander slowly. An output beyond so many sigmas is left out; with an infinite gate
 * none is. If most samples of a window were, the covariance starts again. A ring has the states
 * after the newest samples, so that late ones are put in their place.
 */
#ifndef TSOBS_KALMAN_H
#define TSOBS_KALMAN_H

#include "flow.h"
#include "layout.h"

/* Sizes of a filter, the first numbers of its model record: states [x; w] and theta, outputs, what
 * is read of the states besides x, samples of the window, and samples that are remembered. */
#define KALMAN_SIZES 6
#define KALMAN_CONDITIONS 7 /* numbers of a row that say what the others are worth */
typedef struct {
    int64_t n, k, p, reads, window, ring;
} kalman_sizes;

/* Length of the states. */
static inline long kalman_states(const kalman_sizes *s)
{
    return (long)(s->n + s->k);
}

/* history, future_tolerance, restart_after: longest lateness, the clock's tolerance and the longest gap [ns].
 * gate: sigmas beyond which an output is left out. x_max: half width of the domain [rad]. wander:
 * growth of the variance of each theta [1/s]. variances: of the outputs' noise. output: states to
 * outputs. read: states to the outputs' disturbances and the unknown torques. scale: physical units
 * of the arm's states. initial: covariance before any sample. conditions: in each row, what the
 * others are worth. */
#define KALMAN_FIELDS(F, s)                                   \
    F(COUNT, n, 1, 1)                                         \
    F(COUNT, k, 1, 1)                                         \
    F(COUNT, p, 1, 1)                                         \
    F(COUNT, reads, 1, 1)                                     \
    F(COUNT, window, 1, 1)                                    \
    F(COUNT, ring, 1, 1)                                      \
    F(COUNT, history, 1, 1)                                   \
    F(COUNT, future_tolerance, 1, 1)                          \
    F(COUNT, restart_after, 1, 1)                             \
    F(NUMBER, gate, 1, 1)                                     \
    F(NUMBER, x_max, 1, 1)                                    \
    F(NUMBER, wander, 1, 1)                                   \
    F(VECTOR, variances, s->p, 1)                             \
    F(MATRIX, output, s->p, kalman_states(s))                 \
    F(MATRIX, read, s->reads, kalman_states(s))               \
    F(VECTOR, scale, 4, 1)                                    \
    F(MATRIX, initial, kalman_states(s), kalman_states(s))    \
    F(VECTOR, conditions, KALMAN_CONDITIONS, 1)
LAYOUT_DECLARE(kalman_model, KALMAN_FIELDS, kalman_sizes)

/* All that a filter remembers: the ring, its oldest state and how many there are, numbers of late
 * samples and of estimates that were not finite. Of each state in the ring, stamps: of its sample
 * [ns]; seen: samples since the covariance was started; samples: the outputs, NaN of one that is
 * missing, and the torque from then on; left_out: a byte for each sample of the window. */
#define KALMAN_MEMORY_FIELDS(F, s)                                    \
    F(COUNT, first, 1, 1)                                             \
    F(COUNT, length, 1, 1)                                            \
    F(COUNT, rewinds, 1, 1)                                           \
    F(COUNT, failures, 1, 1)                                          \
    F(COUNTS, stamps, s->ring, 1)                                     \
    F(COUNTS, seen, s->ring, 1)                                       \
    F(MATRIX, samples, s->ring, s->p + 1)                             \
    F(MATRIX, x, s->ring, kalman_states(s))                           \
    F(MATRIX, P, s->ring * kalman_states(s), kalman_states(s))        \
    F(COUNTS, left_out, s->ring * ((s->window + 7) / 8), 1)
LAYOUT_DECLARE(kalman_memory, KALMAN_MEMORY_FIELDS, kalman_sizes)

/* x, P: of an estimate. cross: covariance of the states with an output. jacobian, product, added:
 * of a step, and what it adds to P. phi to noise: the linear flow over a step that is not nominal;
 * over: scratch of it. samples: that in hand and the next; codes to expected: of those that are
 * used again. */
#define KALMAN_SCRATCH_FIELDS(F, s)                                   \
    F(VECTOR, x, kalman_states(s), 1)                                 \
    F(MATRIX, P, kalman_states(s), kalman_states(s))                  \
    F(VECTOR, cross, kalman_states(s), 1)                             \
    F(MATRIX, jacobian, kalman_states(s), kalman_states(s))           \
    F(MATRIX, product, kalman_states(s), kalman_states(s))            \
    F(MATRIX, added, kalman_states(s), kalman_states(s))              \
    F(MATRIX, phi, s->n, s->n)                                        \
    F(VECTOR, gamma, s->n, 1)                                         \
    F(MATRIX, noise, s->n, s->n)                                      \
    F(VECTOR, over, flow_over_scratch_size((long)s->n, 1), 1)         \
    F(MATRIX, samples, 2, s->p + 1)                                   \
    F(COUNTS, codes, s->p, 1)                                         \
    F(VECTOR, innovations, s->p, 1)                                   \
    F(VECTOR, expected, s->p, 1)
LAYOUT_DECLARE(kalman_scratch, KALMAN_SCRATCH_FIELDS, kalman_sizes)

/* A filter: its sizes, and views of its records and of its prediction model, an arm's. */
typedef struct {
    kalman_sizes sizes;
    kalman_model model;
    kalman_memory memory;
    kalman_scratch scratch;
    flow flow;
} kalman;

/* Samples in the order of arrival: stamps [ns], outputs (p each), NaN of one that is missing, and
 * torques, NaN of one that is unknown. Outcomes below 0 are of samples that are skipped; the others
 * and the codes of each output are written, and its innovation and the 1 sigma expected of it. */
typedef struct {
    const int64_t *stamps;
    const double *y, *u;
    int64_t *outcomes, *codes;
    double *innovations, *expected;
} kalman_samples;

/* Ticks: stamps, and times on the clock [ns]; ends of the samples that each includes; the sample
 * before which the filter forgets everything, or -1. Written are the stamp of the newest sample in
 * use, 0 without an estimate, and rows of `kalman_row_size` where there is one. */
typedef struct {
    const int64_t *stamps, *now, *ends, *resets;
    int64_t *newest;
    double *rows;
} kalman_ticks;

/* Length of a row: x, its 1 sigma, what is read and its 1 sigma, theta and its 1 sigma, what the
 * others are worth, whether the link is in the domain, and the age of the newest sample [s]. */
long kalman_row_size(const kalman_sizes *s);

/* Use samples and estimate, tick by tick. */
void kalman_advance(
    const kalman *of, const kalman_ticks *ticks, long count, const kalman_samples *samples);

#endif
