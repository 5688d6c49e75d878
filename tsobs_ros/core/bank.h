/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Functions shared by filter.c (one hypothesis), bank.c (all of them) and readout.c.
 */
#ifndef TSOBS_BANK_H
#define TSOBS_BANK_H

#include "arithmetic.h"
#include "estimator.h"

/* Return the time that a sample counts for in averages: that since the last one, but at least a
 * period, and at most the longest regular step or, for a slower output, the interval before, so
 * that a gap does not erase the averages. */
static inline double counted_time(const model *m, double since, double interval)
{
    return clip(since, *m->period, maximum(*m->longest, interval));
}

/* Return the weight, in an average over `time`, of a value that stands for `duration`. */
static inline double share_of(double duration, double time)
{
    return minimum(duration / time, 1.0);
}

/* Return the size of an output's white noise relative to the design's, at least 1. */
static inline double noise_of(const model *m, const state *at, long output)
{
    return maximum(*sensor_of(m, at, output).noise_scale, 1.0);
}

/* Return the largest such size of all outputs. */
static inline double scale_of(const model *m, const state *at)
{
    double scale = 1.0;
    for (long i = 0; i < m->s.p; i++) {
        scale = maximum(scale, noise_of(m, at, i));
    }
    return scale;
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

/* Return whether a hypothesis is likely enough to count in the published estimate. */
static inline int counts(const model *m, const hypothesis *h)
{
    return *h->live != 0 && *h->score >= -0.8 * m->constants[FLOOR];
}

/* Return a power of slow innovations relative to the power that white noise leaves in them; nis is
 * that of all innovations. */
static inline double slowness_of(const model *m, double power, double nis)
{
    return power > 0.0 ? power / (m->constants[QUIET] * nis) : 0.0; /* at rest, 0 of 0 */
}

/* Return whether a hypothesis' own innovations contradict it, so that its bounds do not hold. */
static inline int is_contradicted(const model *m, const hypothesis *h)
{
    const double most = m->constants[VOID], scale = m->constants[LEAST_SCALE];
    const double slowness = slowness_of(m, *h->slow_power, maximum(*h->nis, scale * scale));
    return !(*h->nis <= most && slowness <= 7.0 * most);
}

/* Return whether the hypothesis of a place may explain the same samples as the design. */
static inline int is_rival(long place)
{
    return place == FORCE || place == IMPERFECT || place == DRIFT;
}

/* Return the least weight of a hypothesis in the bounds, relative to the likeliest one's. Unless
 * that is the design and has no slow sign, FORCE, IMPERFECT and DRIFT may explain the same samples,
 * and their likelihood decides only if the rest of the model is right. With 1/6 each, three bounds
 * reach all of them. In a tone of an arm's sensor, they count only until their innovations
 * contradict them. */
static inline double least_weight(
    const model *m, const state *at, long place, const hypothesis *h)
{
    const hypothesis best = best_of(m, at);
    const int is_needed = *best.kind != AS_DESIGNED || *best.slow_power > m->constants[SIGN_SLOW];
    const int is_failed
        = *best.kind == TONE && *m->design_flow.kind == KIND_ARM && is_contradicted(m, h);
    return is_rival(place) && is_needed && !is_failed ? 1.0 / 6.0 : 0.0;
}

/* Return whether the live hypothesis h counts in the published bounds. */
static inline int counts_in_bounds(
    const model *m, const state *at, long place, const hypothesis *h)
{
    return counts(m, h) || least_weight(m, at, place, h) > 0.0;
}

/* Return half the distance from a frequency to the next one at which tones are looked for. */
static inline double halfway_from(const model *m, double frequency)
{
    return 0.5 * (m->constants[TONE_RATIO] - 1.0) * frequency;
}

/* --- bank.c: torques --- */

/* Return the mean torque at the motor over a duration that begins `ahead` from now. The state must
 * have past torques. */
double mean_torque(const model *m, const state *at, double ahead, double duration);

/* --- filter.c: one hypothesis --- */

/* Return the number of states in use: the design's and the auxiliary ones that may not be 0. */
long states_in_use(const model *m, const hypothesis *h);

/* Add to an output's row of C the auxiliary states that are part of the output. */
void add_parts(const model *m, const hypothesis *h, long output, double *row);

/* Leave the certified gain: Riccati gains go on from the certified bound as the covariance. */
void leave_certified(const model *m, const state *at, const hypothesis *h, int64_t cause);

/* Write the outlook of each output by a hypothesis. */
void expect_outputs(const model *m, const state *at, const hypothesis *h, correction *effect);

/* Correct by the outputs that `expect_outputs`, called just before, has marked as used, and learn.
 * Return the sample's log-likelihood. */
double correct_hypothesis(const model *m, const state *at, hypothesis *h, correction *effect);

/* Correct by one output, even if it is an outlier; return its log-likelihood. is_expected: whether
 * `effect` has the output's present outlook. */
double correct_by(
    const model *m, const state *at, hypothesis *h, long output, int is_expected, int adapt,
    correction *effect);

/* A prediction's duration in steps: `whole` nominal ones, and one for the rest unless that is 0.
 * left: decay factors over either step, by the place of the time constant, 0 until computed.
 * forgotten: variance that an unknown torque gains per second, 0 if the torque is known. */
typedef struct {
    double duration, forgotten;
    int64_t whole;
    linear_step steps[2];
    double left[2][TONE_TIME + 1];
    flow_step work;
} course;

/* Return the steps of a duration; scratch keeps their linear flow. */
course course_over(const model *m, double duration, double forgotten, work *scratch);

/* Predict with held inputs; if simple, without the covariance and the auxiliary states. */
void predict_hypothesis(
    const model *m, const state *at, hypothesis *h, course *along, int simple, work *scratch);

#endif
