/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include <string.h>

#include "bank.h"

enum { LINK_VELOCITY = 1, MOTOR_VELOCITY = 3 };

/* pi/2: v / sqrt(v^2 + pi/2) has the slope of the mean sign of a normal variable at v = 0. */
static const double HALF_PI = 1.5707963267948966;

/* Slow a velocity, whose distribution is normal, by Coulomb friction over half a step.
 *
 * The mean changes by that of the velocity's sign, and not beyond rest; deviations shrink by the
 * slope of that mean (statistical linearisation), implicitly, as it may be steep. */
static void rub(double change, long place, long n, long width, double *x, double *P)
{
    const double variance = P[place * width + place];
    double root, slope;
    if (!(change > 0.0) || !(variance > 0.0)) {
        return;
    }
    root = sqrt(x[place] * x[place] + HALF_PI * variance);
    slope = 1.0 / (1.0 + change * HALF_PI * variance / (root * root * root));
    x[place] -= copysign(fmin(change * fabs(x[place]) / root, fabs(x[place])), x[place]);
    for (long i = 0; i < n; i++) {
        P[place * width + i] *= slope;
    }
    for (long i = 0; i < n; i++) {
        P[i * width + place] *= slope;
    }
}

void write_innovations(
    const model *m, state *at, const sample_log *log, const filter_options *options,
    int64_t corrected_until, double *innovations, double *variances, double *states,
    correction *effect, work *scratch)
{
    const long n = (long)m->s.n, p = (long)m->s.p, width = (long)m->s.width;
    hypothesis h = hypothesis_of(m, at, 0);
    int begins = 1;
    for (int64_t k = 0; k < log->count; k++) {
        const double half = 0.5 * log->durations[k];
        if (begins) {
            memcpy(at->stamp, m->initial, state_size(&m->s) * sizeof(double));
        }
        memcpy(states + k * n, h.x, (size_t)n * sizeof *states);
        memcpy(at->y, log->y + k * p, (size_t)p * sizeof *at->y);
        for (long i = 0; i < p; i++) {
            double *e = innovations + k * p + i, *s = variances + k * p + i;
            *e = expect(m, at, &h, i, effect, s);
            if (!isfinite(at->y[i])) {
                *e = *s = NAN;
            } else if (k >= corrected_until) {
                *s = NAN;
            } else if (*e * *e <= options->gate * options->gate * *s) {
                correct_covariance(m, &h, effect->crossed, *e, *s, n);
            }
        }
        begins = half < 0.0;
        if (!begins) {
            rub(half * options->link_friction, LINK_VELOCITY, n, width, h.x, h.covariance);
            rub(half * options->motor_friction, MOTOR_VELOCITY, n, width, h.x, h.covariance);
            memcpy(at->held, log->u + k * m->s.m, (size_t)m->s.m * sizeof *at->held);
            predict_hypothesis(m, at, &h, 2.0 * half, 0, 0.0, scratch);
            rub(half * options->motor_friction, MOTOR_VELOCITY, n, width, h.x, h.covariance);
            rub(half * options->link_friction, LINK_VELOCITY, n, width, h.x, h.covariance);
        }
    }
}
