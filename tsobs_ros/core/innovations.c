/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "estimator.h"

#include <string.h>

#include "matrices.h"

enum { LINK_VELOCITY = 1, MOTOR_VELOCITY = 3 };

/* pi/2: v / sqrt(v^2 + pi/2) has the slope of the mean sign of a normal variable at v = 0. */
static const double HALF_PI = 1.5707963267948966;

size_t innovations_scratch_size(const model *m)
{
    const size_t n = (size_t)m->s.n;
    return n * n + 2 * n + (size_t)m->s.scratch;
}

/* Slow a velocity, whose distribution is normal, by Coulomb friction over half a step.
 *
 * The mean changes by that of the velocity's sign, and not beyond rest; deviations shrink by the
 * slope of that mean (statistical linearisation), implicitly, as it may be steep. */
static void rub(double change, long place, long n, double *x, double *P)
{
    const double variance = P[place * n + place];
    double root, slope;
    if (!(change > 0.0) || !(variance > 0.0)) {
        return;
    }
    root = sqrt(x[place] * x[place] + HALF_PI * variance);
    slope = 1.0 / (1.0 + change * HALF_PI * variance / (root * root * root));
    x[place] -= copysign(fmin(change * fabs(x[place]) / root, fabs(x[place])), x[place]);
    for (long i = 0; i < n; i++) {
        P[place * n + i] *= slope;
    }
    for (long i = 0; i < n; i++) {
        P[i * n + place] *= slope;
    }
}

/* Correct by one output. */
static void use_output(
    const model *m, long output, double y, const filter_options *options, double *x, double *P,
    double *crossed, double *innovation, double *variance)
{
    const long n = (long)m->s.n, p = (long)m->s.p;
    const double *C = m->C + output * m->s.width;
    const double e = y - dot(C, x, n);
    double s;
    for (long i = 0; i < n; i++) {
        crossed[i] = dot(P + i * n, C, n);
    }
    s = dot(C, crossed, n) + m->R[output * p + output];
    *innovation = e;
    *variance = s;
    if (!(e * e <= options->gate * options->gate * s)) {
        return;
    }
    for (long i = 0; i < n; i++) {
        const double gain = crossed[i] / s;
        x[i] += gain * e;
        for (long j = 0; j <= i; j++) {
            P[i * n + j] -= gain * crossed[j];
            P[j * n + i] = P[i * n + j];
        }
    }
}

void write_innovations(
    const model *m, const sample_log *log, const filter_options *options, int64_t corrected_until,
    double *innovations, double *variances, double *states, double *scratch)
{
    const long n = (long)m->s.n, p = (long)m->s.p;
    double *x = scratch, *crossed = x + n, *P = crossed + n, *work = P + n * n;
    int begins = 1;
    state initial;
    hypothesis designed;
    state_bind(&initial, &m->s, m->initial);
    designed = hypothesis_of(m, &initial, 0);
    for (int64_t k = 0; k < log->count; k++) {
        const double *y = log->y + k * p;
        const double duration = log->durations[k];
        if (begins) {
            memcpy(x, designed.x, (size_t)n * sizeof *x);
            copy_matrix(designed.covariance, (long)m->s.width, P, n, n, n);
        }
        if (states != NULL) {
            memcpy(states + k * n, x, (size_t)n * sizeof *x);
        }
        for (long i = 0; i < p; i++) {
            double *e = innovations + k * p + i, *s = variances + k * p + i;
            *e = *s = NAN;
            if (!isfinite(y[i])) {
                continue;
            }
            if (k < corrected_until) {
                use_output(m, i, y[i], options, x, P, crossed, e, s);
            } else {
                *e = y[i] - dot(m->C + i * m->s.width, x, n);
            }
        }
        begins = duration < 0.0;
        if (!begins) {
            rub(0.5 * duration * options->link_friction, LINK_VELOCITY, n, x, P);
            rub(0.5 * duration * options->motor_friction, MOTOR_VELOCITY, n, x, P);
            flow_advance(
                &m->design_flow, x, NULL, P, n, NULL, NULL, y, log->u + k * m->s.m, duration, work);
            rub(0.5 * duration * options->motor_friction, MOTOR_VELOCITY, n, x, P);
            rub(0.5 * duration * options->link_friction, LINK_VELOCITY, n, x, P);
        }
    }
}
