/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * What the parts of the estimator share: filter.c (one hypothesis), bank.c (all of them), readout.c.
 */
#ifndef TSOBS_BANK_H
#define TSOBS_BANK_H

#include "arithmetic.h"
#include "estimator.h"

/* The smaller and the larger of two numbers; the first if one of them is NaN. */
static inline double minimum(double a, double b)
{
    return b < a ? b : a;
}

static inline double maximum(double a, double b)
{
    return b > a ? b : a;
}

/* Return the share that a duration has in an average over a time constant. */
static inline double share_of(double duration, double time)
{
    return minimum(duration / time, 1.0);
}

/* Size of an output's white noise relative to the design's, at least 1. */
static inline double noise_of(const model *m, const state *at, long output)
{
    return *m->supervised != 0 ? maximum(*sensor_of(m, at, output).noise_scale, 1.0) : 1.0;
}

/* The largest of these sizes. */
static inline double scale_of(const model *m, const state *at)
{
    return *m->supervised != 0 ? maximum(*at->noise_scale, 1.0) : 1.0;
}

/* Return whether a hypothesis counts in what is read. */
static inline int counts(const model *m, const hypothesis *h)
{
    return *h->live != 0 && *h->score >= -0.8 * m->constants[FLOOR];
}

/* Return the power of slow innovations relative to what white noise leaves of it. */
static inline double slowness_of(const model *m, const hypothesis *h)
{
    return *h->slow_power / (m->constants[QUIET] * *h->nis);
}

/* --- bank.c: torques --- */

/* Return the mean of the torque at the motor over a time that begins `ahead` from now; there are past
 * ones. */
double mean_torque(const model *m, const state *at, double ahead, double duration);

/* --- filter.c: one hypothesis --- */

/* Return the states in use: the design's, and of the auxiliary ones those that can differ from 0. */
long states_in_use(const model *m, const hypothesis *h);

/* Return the auxiliary state that is part of an output, or -1. */
long part_of(const model *m, const hypothesis *h, long output);

/* Take the certificate's bound for the covariance, from where Riccati gains go on. */
void leave_certified(const model *m, const state *at, const hypothesis *h, int64_t cause);

/* Write the innovation, its variance and the logarithm of its likelihood for each output, in sigmas
 * clipped where the sample is an outlier, and which are used. */
void weigh(const model *m, const state *at, const hypothesis *h, correction *effect);

/* Correct by the outputs that `weigh` found in use, and learn; return the logarithm of the
 * likelihood of the sample. */
double correct_hypothesis(const model *m, const state *at, hypothesis *h, correction *effect);

/* Correct by one output, whatever it is; return the logarithm of its likelihood. */
double correct_by(
    const model *m, const state *at, hypothesis *h, long output, int adapt, correction *effect);

/* Predict over a time with held inputs; `forgotten`: variance that an unknown torque gains in a
 * second, 0 if the torque is known. */
void predict_hypothesis(
    const model *m, const state *at, hypothesis *h, double duration, int simple, double forgotten,
    work *scratch);

/* Forget the auxiliary states from a place on, up to another. */
void clear_auxiliary(const model *m, hypothesis *h, long first, long end);

#endif
