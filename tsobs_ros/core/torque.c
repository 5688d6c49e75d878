/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The torque of a measurement, judged like its angle.
 *
 * A torque that no drive of the arm can have is not used, its angle is. From that sample on the
 * torque is unknown, as in a gap: u + d, u being the last plausible one, with d and its rate as two
 * more states of the estimate. Angles go on correcting all of them.
 *
 * A torque that is plausible may be wrong, too. A step of it is a suspect for a second. What it has
 * done to the estimate, the response, follows from the linear model, and the likelihoods of the
 * innovations with and without it decide whether the arm made the step. Until then nothing is
 * certified, and for a while the bounds have room for the response. If the arm did not make the
 * step, the response is taken back.
 */
#include "filter.h"

/* Steps count from this share of `torque_doubt` on. */
#define SMALL_STEP 0.25

/* A step is a suspect for so long, at most so long, and open at least for so long [s]. */
#define SUSPECT 1.0
#define LONGEST_SUSPECT 10.0
#define OPEN_WINDOW 0.1

/* Logarithm of likelihoods from which on it is certain. */
#define CERTAIN 8.0

/* Innovations count up to so many sigmas, and are strange beyond so many. */
#define CLIP 5.0
#define STRANGE 2.5

/* For so long a torque is distrusted, at least for so long [s]. */
#define DISTRUST 5.0
#define LEAST_DISTRUST 0.5

/* Return whether a torque is still contradicted, a while after one of its steps was. */
static int is_distrusted(const model *m, const state *at, double torque)
{
    const long n = (long)m->s.n, width = (long)m->s.width;
    double departure, spread;
    if (*at->distrust <= 0.0 || *at->in_gap == 0) {
        return 0;
    }
    if (*at->distrust > DISTRUST - LEAST_DISTRUST) {
        return 1;
    }
    departure = torque - at->held[0] - at->x[n];
    spread = 9.0 * larger(at->covariance[n * width + n], 0.0);
    return departure * departure > spread + *m->torque_doubt * *m->torque_doubt;
}

/* Remember a step of the torque, which a smooth one does not make, while it is a suspect. */
static void note_step(const model *m, state *at, double step)
{
    const double sudden = fabs(step - *at->torque_change);
    const double least = SMALL_STEP * *m->torque_doubt, size = minimum(fabs(step), sudden);
    *at->torque_change = step;
    if (!(size > (is_suspected(at) ? least : 2.0 * least)) || *m->torque_doubt <= 0.0) {
        return;
    }
    if (fabs(*at->departure + step) <= least) {
        *at->departure = 0.0;
        *at->step_age = 0.0;
    } else {
        /* If there is one before it, it is not decided whether the arm made that. */
        *at->torque_step = step;
    }
}

void take_torque(const model *m, state *at, const double *u)
{
    long i;
    if (*m->torque_limit > 0.0) {
        const double step = u[0] - at->held[0];
        /* A first torque has none before it: its age is infinite. Late samples and those of two
         * sensors may be as close as can be. */
        const double elapsed = larger(*at->torque_age, *m->period);
        const int legal = isfinite(u[0]) && fabs(u[0]) <= *m->torque_limit
                          && !(fabs(step) > *m->torque_rate_limit * elapsed);
        if (!legal || is_distrusted(m, at, u[0])) {
            *at->torque_unknown = 1;
            return;
        }
        if (isfinite(*at->torque_age)) {
            note_step(m, at, step);
        }
    }
    for (i = 0; i < m->s.m; i++) {
        at->held[i] = u[i];
    }
    *at->torque_unknown = 0;
    *at->torque_age = 0.0;
    *at->distrust = 0.0;
}

/* Add to the covariance what the suspected steps have done, of all states or also of d. */
static void add_response(const model *m, state *at, long states)
{
    const long n = (long)m->s.n, width = (long)m->s.width;
    const long count = states < n + 1 ? states : n + 1;
    long i, j;
    for (i = 0; i < count; i++) {
        const double first = i < n ? at->response[i] : *at->departure;
        for (j = 0; j < count; j++) {
            at->covariance[i * width + j] += first * (j < n ? at->response[j] : *at->departure);
        }
    }
}

/* Suspect the newest step, and leave one before it to the covariance. */
void begin_step(const model *m, state *at)
{
    if (is_suspected(at)) {
        add_response(m, at, (long)m->s.n);
    }
    forget_step(m, at);
    *at->departure = *at->torque_step;
    *at->torque_step = 0.0;
    *at->step_age = 0.0;
}

/* Suspect the last step of the torque no longer. */
void forget_step(const model *m, state *at)
{
    long i;
    for (i = 0; i < m->s.n; i++) {
        at->response[i] = 0.0;
    }
    *at->departure = 0.0;
    *at->evidence = 0.0;
    *at->step_age = INFINITY;
}

/* Give the response half a kick, by gravity and by what theta adds to both accelerations. */
static void kick_response(const model *m, state *at)
{
    const flow *f = &m->design_flow;
    const double *response = at->response;
    const double angle = cosine(at->x[0]) * response[0], departure = *at->departure;
    double link = -*f->gravity_gain * angle, motor = 0.0;
    long i;
    for (i = 0; i < m->s.k; i++) {
        const double *effect = f->effects + i * EFFECTS;
        const double theta = at->theta[i];
        link += theta
                * (dot(effect, response, 4) + effect[LINK_SINE] * angle
                   + effect[LINK_TORQUE] * departure);
        motor += theta
                 * (dot(effect + 4, response, 4) + effect[MOTOR_SINE] * angle
                    + effect[MOTOR_TORQUE] * departure);
    }
    at->response[1] += 0.5 * *f->period * link;
    at->response[3] += 0.5 * *f->period * motor;
}

/* Move what the suspected steps have done to the estimate over a regular step. */
void follow_step(const model *m, state *at, double duration, work *scratch)
{
    const flow *f = &m->design_flow;
    const long n = (long)m->s.n;
    double *moved = scratch->moved;
    long i;
    if (!is_suspected(at)) {
        return;
    }
    if (duration > *m->longest || *at->torque_unknown != 0) {
        forget_step(m, at);
        return;
    }
    kick_response(m, at);
    apply(f->phi, at->response, moved, n, n);
    for (i = 0; i < n; i++) {
        at->response[i] = moved[i] + f->gamma[i * *f->inputs] * *at->departure;
    }
    kick_response(m, at);
    *at->step_age += duration;
    if (*at->step_age >= SUSPECT) {
        const int over = *at->departure == 0.0 && *at->step_age < LONGEST_SUSPECT;
        if (!over || quadratic(m->P, (long)m->s.width, at->response, n) < 1.0 / 9.0) {
            forget_step(m, at);
        }
    }
}

/* Weigh by an innovation whether the arm made the suspected steps of the torque. Return whether it
 * is as good as certain that it did not. */
int weigh_step(const model *m, state *at, const correction *effect)
{
    const long p = (long)m->s.p;
    int weighed = 0;
    long i;
    if (!is_suspected(at) || *at->torque_unknown != 0) {
        return 0;
    }
    for (i = 0; i < p; i++) {
        const double innovation = effect->innovation[i];
        const double variance = effect->innovation_covariance[i * p + i];
        double expected, spread, made, not_made;
        if (!(isfinite(innovation) && variance > 0.0)) {
            continue;
        }
        expected = dot(m->C + i * m->s.width, at->response, (long)m->s.n);
        spread = sqrt(variance) * larger(*sensor_of(m, at, i).noise_scale, 1.0);
        made = minimum(fabs(innovation) / spread, CLIP);
        not_made = minimum(fabs(innovation + expected) / spread, CLIP);
        /* If both are strange, it is the sensor's fault, which says nothing of the torque. */
        if (!(made > STRANGE && not_made > STRANGE)) {
            *at->evidence += 0.5 * (made * made - not_made * not_made);
            weighed = 1;
        }
    }
    if (!weighed) {
        return 0;
    }
    if (*at->evidence < -CERTAIN) {
        forget_step(m, at);
        return 0;
    }
    return *at->evidence > CERTAIN;
}

/* Correct what the suspected steps have done to the estimate, as that is. */
void correct_response(const model *m, state *at, correction *effect)
{
    const long n = (long)m->s.n, p = (long)m->s.p;
    double *moved = effect->vectors;
    long i, j;
    if (!is_suspected(at)) {
        return;
    }
    for (i = 0; i < n; i++) {
        moved[i] = 0.0;
    }
    for (j = 0; j < p; j++) {
        if (effect->weight[j] > 0.0) {
            const double expected
                = effect->weight[j] * dot(m->C + j * m->s.width, at->response, n);
            for (i = 0; i < n; i++) {
                moved[i] += effect->gain[i * p + j] * expected;
            }
        }
    }
    for (i = 0; i < n; i++) {
        at->response[i] -= moved[i];
    }
}

/* Return whether the bounds cover both answers to whether the arm made the suspected steps. They do
 * for a while after a step, and once the torque is back where it was. */
int is_open(const state *at)
{
    return *at->step_age <= OPEN_WINDOW || (is_suspected(at) && *at->departure == 0.0);
}

/* Go back to the torque before the suspected steps, and take it to be unknown for a while; the
 * state is corrected, with Riccati gains. That the arm made them after all remains possible: the
 * covariance has both. */
void distrust_torque(const model *m, state *at)
{
    const long n = (long)m->s.n;
    long i;
    for (i = 0; i < n; i++) {
        at->x[i] -= at->response[i];
    }
    if (m->s.n_gap > 0 && *at->departure != 0.0) {
        *at->torque_unknown = 1;
        *at->distrust = DISTRUST;
        *at->torque_age = 0.0;
        at->held[0] -= *at->departure;
        enter_gap(m, at);
        *at->in_gap = 1;
    } else {
        add_response(m, at, n);
    }
    forget_step(m, at);
}

/* Append the unknown torque and its rate to the estimate and its covariance. The torque's departure
 * begins at zero, or, if the last plausible torque is from some time ago, with all that it may have
 * become since. Suspected steps remain possible, and so does that the arm did not make them. */
void enter_gap(const model *m, state *at)
{
    const long n = (long)m->s.n, wide = (long)m->s.n_gap, width = (long)m->s.width;
    long i, j;
    for (i = n; i < wide; i++) {
        at->x[i] = 0.0;
        for (j = 0; j < wide; j++) {
            at->covariance[i * width + j] = 0.0;
            at->covariance[j * width + i] = 0.0;
        }
        for (j = 0; j < m->s.k; j++) {
            at->upsilon[j * width + i] = 0.0;
        }
    }
    if (*at->torque_unknown != 0) {
        const double spread
            = minimum(sqrt(*m->rate_variance) * *at->torque_age, *m->torque_spread);
        at->covariance[n * width + n] = spread * spread;
    }
    at->covariance[(wide - 1) * width + wide - 1] = *m->rate_variance;
    if (is_suspected(at)) {
        add_response(m, at, wide);
    }
}
