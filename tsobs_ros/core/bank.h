/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * What the parts of the estimator share: filter.c (one hypothesis), bank.c (all), readout.c.
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

static inline double clip(double value, double least, double most)
{
    return minimum(maximum(value, least), most);
}

/* Return the time since a sample for which it counts in averages: after a gap they go on where they
 * were. */
static inline double counted_time(const model *m, double since)
{
    return clip(since, *m->period, *m->longest);
}

/* Return the share that a duration has in an average over a time constant. */
static inline double share_of(double duration, double time)
{
    return minimum(duration / time, 1.0);
}

/* Size of an output's white noise relative to the design's, at least 1. */
static inline double noise_of(const model *m, const state *at, long output)
{
    return maximum(*sensor_of(m, at, output).noise_scale, 1.0);
}

/* The largest of these sizes. */
static inline double scale_of(const state *at)
{
    return maximum(*at->noise_scale, 1.0);
}

/* Return the likeliest hypothesis. */
static inline hypothesis best_of(const model *m, const state *at)
{
    return hypothesis_of(m, at, *at->best);
}

/* Return whether the sensor of an output is known to be stuck. */
static inline int is_stuck(const model *m, const state *at, long output)
{
    const int64_t repeats = *sensor_of(m, at, output).repeats;
    return *m->supervised != 0 && 0 < *m->stuck_samples && *m->stuck_samples <= repeats;
}

/* Return whether a hypothesis counts in what is read. */
static inline int counts(const model *m, const hypothesis *h)
{
    return *h->live != 0 && *h->score >= -0.8 * m->constants[FLOOR];
}

/* Return a power of slow innovations relative to what white noise leaves of it. */
static inline double slowness_of(const model *m, const hypothesis *h, double power)
{
    return power / (m->constants[QUIET] * *h->nis);
}

/* Return half the way from a frequency to the next one that is looked for. */
static inline double halfway_from(const model *m, double frequency)
{
    return 0.5 * (m->constants[TONE_RATIO] - 1.0) * frequency;
}

/* Return the place of FORCE's state: that of the unknown torque, or behind it if it is at the link,
 * so that it stays in a gap. */
static inline long force_place(const model *m)
{
    return m->s.n + (*m->at_link != 0);
}

/* --- bank.c: torques --- */

/* Return the mean of the torque at the motor over a time that begins `ahead` from now; there are
 * past ones. */
double mean_torque(const model *m, const state *at, double ahead, double duration);

/* --- filter.c: one hypothesis --- */

/* Return the states in use: the design's, and the auxiliary ones that can differ from 0. */
long states_in_use(const model *m, const hypothesis *h);

/* Add the auxiliary states that are part of an output to its row of the others. */
void add_parts(const model *m, const hypothesis *h, long output, double *row);

/* Take the certificate's bound for the covariance, from where Riccati gains go on. */
void leave_certified(const model *m, const state *at, const hypothesis *h, int64_t cause);

/* Write how a hypothesis expects each output. */
void expect_outputs(const model *m, const state *at, const hypothesis *h, correction *effect);

/* Correct by the outputs that `expect_outputs`, called just before, found in use, and learn; return
 * the logarithm of the likelihood of the sample. */
double correct_hypothesis(const model *m, const state *at, hypothesis *h, correction *effect);

/* Correct by one output, whatever it is; return the logarithm of its likelihood. is_expected:
 * whether `effect` has what is expected of it. */
double correct_by(
    const model *m, const state *at, hypothesis *h, long output, int is_expected, int adapt,
    correction *effect);

/* A time in steps: whole nominal ones, and one of another length unless that is 0; what is left
 * after each of what decays, by the place of its time constant in the bank's, 0 if not known yet;
 * and the variance that an unknown torque gains in a second, 0 if the torque is known. */
typedef struct {
    double duration, forgotten;
    int64_t whole;
    linear_step steps[2];
    double left[2][TONE_TIME + 1];
    flow_step work;
} course;

/* Return the steps of a time; their linear flow is kept in scratch. */
course course_over(const model *m, double duration, double forgotten, work *scratch);

/* Predict with held inputs. */
void predict_hypothesis(
    const model *m, const state *at, hypothesis *h, course *along, int simple, work *scratch);

#endif
