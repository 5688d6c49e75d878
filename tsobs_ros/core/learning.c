/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Parameters are learnt by a filtered-regressor (two-stage) adaptive observer after Q. Zhang
 * (2002): the regressor Upsilon = dx/dtheta is filtered through the observer's own error dynamics,
 * so that the innovation is explained as e = Omega (theta - theta^) + noise with Omega = C Upsilon,
 * whatever the relative degree of the sensor. A change of theta follows by recursive least squares
 * with a bounded gain, projected on its known bounds. It is used from when it is significant. The
 * regressor is taken at the estimate, so innovations count for less while that is uncertain, and
 * what was learnt far from the truth is learnt again. Learning rests if the model is wrong in other
 * ways, and comes back with time.
 */
#include "filter.h"

/* Samples between two times that what was learnt is kept, as many as a jump's window has. */
#define KEPT 8

/* A state moves if its deviation over some seconds exceeds so many bounds. */
#define MOVING 6.0

/* How often parameters are learnt again along better regressors. */
#define PASSES 4

/* Return whether the plant has moved by more than its bounds in the last seconds. At rest,
 * regressors follow the noise of the estimate: what they show is false. */
int moves(const model *m, state *at)
{
    const double share = *at->age >= *m->adaptation_start ? *m->motion_share : 1.0;
    const double noise = larger(*at->noise_scale, 1.0);
    int moving = 0;
    long i;
    for (i = 0; i < m->s.plant; i++) {
        const double off = at->x[i] - at->centre[i];
        double least;
        at->centre[i] += share * off;
        at->spread[i] = (1.0 - share) * (at->spread[i] + share * off * off);
        least = MOVING * noise * m->state_std[i];
        moving = moving || at->spread[i] > least * least;
    }
    return moving;
}

/* Add +- a' b, which is symmetric, to a symmetric k x k matrix; a and b are p x k. */
static void add_square(
    double *s, const double *a, const double *b, double sign, long p, long k)
{
    long i, j, c;
    for (i = 0; i < k; i++) {
        for (j = i; j < k; j++) {
            double total = 0.0;
            for (c = 0; c < p; c++) {
                total += a[c * k + i] * b[c * k + j];
            }
            s[i * k + j] += sign * total;
            s[j * k + i] = s[i * k + j];
        }
    }
}

/* Use the pending change of the parameters, and change the estimate with them. */
static void use_pending(const model *m, state *at, long n)
{
    const long width = (long)m->s.width;
    long i, j;
    for (i = 0; i < m->s.k; i++) {
        for (j = 0; j < n; j++) {
            at->x[j] += at->upsilon[i * width + j] * at->pending[i];
        }
        at->theta[i] += at->pending[i];
        at->pending[i] = 0.0;
    }
}

/* Correct the parameters' covariance and the pending change of them by recursive least squares. */
static void adapt_parameters(const model *m, state *at, correction *effect, double inflation)
{
    const long p = (long)m->s.p, k = (long)m->s.k;
    double *known = effect->known, *shift = effect->shift, *pending = at->pending;
    long a, b, i;
    for (a = 0; a < p; a++) {
        for (b = 0; b < p; b++) {
            known[a * p + b] = known[a * p + b] * inflation + effect->explained[a * p + b];
        }
    }
    /* The transposed gain of theta. */
    solve(known, effect->cross, effect->factor, effect->turned, p, k);
    add_square(at->gamma, effect->cross, effect->turned, -1.0, p, k);
    for (i = 0; i < k; i++) {
        shift[i] = 0.0;
    }
    for (a = 0; a < p; a++) {
        if (effect->weight[a] > 0.0) {
            const double left = effect->innovation[a] - dot(effect->omega + a * k, pending, k);
            for (i = 0; i < k; i++) {
                shift[i] += effect->turned[a * k + i] * left;
            }
        }
    }
    for (i = 0; i < k; i++) {
        const double moved = at->theta[i] + pending[i] + shift[i];
        pending[i] = minimum(maximum(moved, -m->limits[i]), m->limits[i]) - at->theta[i];
    }
    if (*at->significant == 0) {
        double total = 0.0;
        solve(at->gamma, pending, effect->root, effect->scaled, k, 1);
        for (i = 0; i < k; i++) {
            total += pending[i] * effect->scaled[i];
        }
        if (total > *m->significance) {
            *at->significant = 1;
        }
    }
}

/* Correct the regressor and, if wanted, the parameters and with them the estimate. */
void learn(const model *m, state *at, correction *effect, int adapt, double inflation)
{
    const long n = width_in_use(m, at), p = (long)m->s.p, k = (long)m->s.k;
    const long width = (long)m->s.width;
    long a, i, j;
    for (a = 0; a < p; a++) {
        for (i = 0; i < k; i++) {
            for (j = 0; j < n; j++) {
                at->upsilon[i * width + j] -= effect->omega[a * k + i] * effect->gain[j * p + a];
            }
        }
    }
    solve(effect->known, effect->omega, effect->factor, effect->turned, p, k);
    add_square(at->gram, effect->omega, effect->turned, 1.0, p, k);
    if (adapt) {
        adapt_parameters(m, at, effect, inflation);
        if (*at->significant != 0) {
            use_pending(m, at, n);
        }
    }
}

/* Go back to the parameters of before a jump, of which the first samples were learnt from. */
void unlearn(const model *m, state *at)
{
    const long k = (long)m->s.k, width = (long)m->s.width;
    long i, j;
    for (i = 0; i < k; i++) {
        const double change = at->theta_before[k + i] - at->theta[i];
        at->theta[i] += change;
        at->pending[i] = at->pending_before[k + i];
        for (j = 0; j < m->s.n; j++) {
            at->x[j] += at->upsilon[i * width + j] * change;
        }
        for (j = 0; j < k; j++) {
            at->gamma[i * k + j] = at->gamma_before[k * k + i * k + j];
        }
    }
    keep_nothing_else(m, at);
}

/* Remember what was learnt, the last two times that as many samples as a window had passed. */
static void keep(const model *m, state *at)
{
    const long k = (long)m->s.k;
    long i;
    if (*at->kept > 0) {
        *at->kept -= 1;
        return;
    }
    *at->kept = KEPT;
    for (i = 0; i < k; i++) {
        at->theta_before[k + i] = at->theta_before[i];
        at->theta_before[i] = at->theta[i];
        at->pending_before[k + i] = at->pending_before[i];
        at->pending_before[i] = at->pending[i];
    }
    for (i = 0; i < k * k; i++) {
        at->gamma_before[k * k + i] = at->gamma_before[i];
        at->gamma_before[i] = at->gamma[i];
    }
}

void keep_nothing_else(const model *m, state *at)
{
    int time;
    for (time = 0; time < 2; time++) {
        *at->kept = 0;
        keep(m, at);
    }
}

/* Forget how well the parameters are known, but not the parameters. */
static void relearn(const model *m, state *at)
{
    const long k = (long)m->s.k;
    state initial;
    long i;
    state_bind(&initial, &m->s, m->initial);
    copy_rows(initial.gamma, at->gamma, k, k, k);
    copy_rows(initial.upsilon, at->upsilon, k, (long)m->s.n, (long)m->s.width);
    *at->pass_age = 0.0;
    for (i = 0; i < k; i++) {
        at->anchor[i] = at->theta[i];
        at->pending[i] = 0.0;
    }
    keep_nothing_else(m, at);
}

/* Learn from the start if learning goes astray; let it rest if that happens too often. */
void guard(const model *m, state *at)
{
    const long k = (long)m->s.k;
    const double budget = (double)*m->relearn_budget;
    int far = 0, at_limit = 0, astray;
    double reach;
    long i;
    if (k == 0) {
        return;
    }
    keep(m, at);
    reach = *m->pass_reach * sqrt(*m->theta_variance);
    for (i = 0; i < k; i++) {
        at_limit = at_limit || fabs(at->theta[i]) >= m->limits[i];
        far = far || fabs(at->theta[i] - at->anchor[i]) > reach;
    }
    *at->pinned = at_limit ? *at->pinned + *m->period : 0.0;
    if (*at->relearned <= budget - 1.0) {
        *at->resting = 0;
    }
    if (far && *at->passes < PASSES && *at->pass_age > *m->pass_time) {
        /* What was learnt far from the truth was learnt along wrong regressors. */
        *at->passes += 1;
        relearn(m, at);
    }
    if (*at->pass_age < *m->pass_time) {
        *at->strained = 0.0;
        *at->pinned = 0.0;
    }
    astray = *at->strained >= *m->strain || *at->pinned >= *m->strain;
    if (*at->hypothesis != AS_DESIGNED || !astray || *at->resting != 0) {
        return;
    }
    *at->pinned = 0.0;
    *at->strained = 0.0;
    if (*at->relearned > budget - 1.0) {
        state initial;
        state_bind(&initial, &m->s, m->initial);
        *at->resting = 1;
        for (i = 0; i < k; i++) {
            at->theta[i] = 0.0;
        }
        copy_rows(initial.gram, at->gram, k, k, k);
        relearn(m, at);
        return;
    }
    *at->relearned += 1.0;
    *at->adaptation_resets += 1;
    *at->passes = 0;
    relearn(m, at);
}

/* Let the excitation fade and Gamma grow, but no variance beyond the initial one. */
void forget_slowly(const model *m, state *at, double duration)
{
    const long k = (long)m->s.k;
    const double fade = exponential(-duration / *m->memory);
    long i, j;
    for (i = 0; i < k; i++) {
        at->gamma[i * k + i] += *m->random_walk * duration;
        for (j = 0; j < k; j++) {
            at->gram[i * k + j] *= fade;
        }
    }
    for (i = 0; i < k; i++) {
        const double variance = at->gamma[i * k + i];
        if (variance > *m->theta_variance) {
            const double shrink = sqrt(*m->theta_variance / variance);
            for (j = 0; j < k; j++) {
                at->gamma[i * k + j] *= shrink;
                at->gamma[j * k + i] *= shrink;
            }
        }
    }
    *at->age += duration;
    if (*at->age >= *m->adaptation_start) {
        *at->pass_age += duration;
    }
}
