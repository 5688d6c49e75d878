/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * What an estimator says: its estimate and bounds in physical units, and what they rest on.
 *
 * The bounds include the uncertainty of the parameters, for x - x^ is the observer's own error plus
 * Upsilon (theta - theta^), of covariance Upsilon Gamma Upsilon'.
 */
#include "filter.h"

/* A bound's square by which suspected steps of the torque matter. */
#define MATTERS (1.0 / 9.0)

/* The share of a distance that regressors are wrong by. */
#define CURVED 0.3

/* What a bound is made of besides the covariance. */
typedef struct {
    double spread;        /* factor of the estimate's own bound */
    const double *gamma;  /* covariance of the parameters */
    const double *share;  /* what the function gains by each parameter */
    const double *pending; /* changes of the parameters that are not used yet */
    long k;               /* number of parameters */
} bound_parts;

static double root(double variance)
{
    return variance >= 0.0 ? sqrt(variance) : (double)NAN;
}

/* Return the 1-sigma bound of a linear function of the estimate: least: of the certificate;
 * variance: along the estimate, 0 if that does not count; doubtful: what suspected steps of the
 * torque have done to the function. */
static double bound_of(
    const bound_parts *parts, double least, double variance, double doubtful)
{
    const double own = larger(root(variance), least) * parts->spread;
    const double shift = dot(parts->share, parts->pending, parts->k);
    const double added = larger(quadratic(parts->gamma, parts->k, parts->share, parts->k), 0.0)
                         + shift * shift + doubtful * doubtful;
    return root(own * own + added);
}

/* Return what a state's bounds rest on. */
static int64_t basis_of(const model *m, const state *at)
{
    if (*at->hypothesis != AS_DESIGNED) {
        const double nis = *alternative_of(m, at, (long)*at->hypothesis - 1).nis;
        return nis > MAX_NIS ? BASIS_CONTRADICTED : BASIS_HYPOTHESIS;
    }
    if (*at->doubt > 0.0) {
        return *at->doubted;
    }
    if (*at->certified == 0) {
        return *at->cause;
    }
    if (is_suspected(at)
        && quadratic(m->P, (long)m->s.width, at->response, (long)m->s.n) > MATTERS) {
        return BASIS_TORQUE;
    }
    return m->s.k > 0 && *m->covered == 0 ? BASIS_LEARNT : BASIS_CERTIFIED;
}

/* Return what a state's learning does. */
static int64_t learning_of(const model *m, const state *at)
{
    if (m->s.k == 0) {
        return LEARNING_NONE;
    }
    if (*at->resting != 0) {
        return LEARNING_STRAINED;
    }
    if (*at->pause > 0.0) {
        return LEARNING_AFTER_JUMP;
    }
    return *at->age >= *m->adaptation_start ? LEARNING_ACTIVE : LEARNING_STARTING;
}

/* Return whether the motion has been rich enough for the parameters to count. */
static int is_excited(const model *m, const state *at, double *gram)
{
    const long k = (long)m->s.k;
    long i;
    copy_rows(at->gram, gram, k, k, k);
    for (i = 0; i < k; i++) {
        gram[i * k + i] -= *m->excitation;
    }
    return is_nonnegative(gram, k);
}

void read_out(const model *m, const state *at, readout *said, work *scratch)
{
    const long n = (long)m->s.n, p = (long)m->s.p, k = (long)m->s.k, width = (long)m->s.width;
    const double noise = *m->supervised != 0 ? larger(*at->noise_scale, 1.0) : 1.0;
    const double *x = at->x, *covariance = at->covariance, *upsilon = at->upsilon;
    const int designed = *at->hypothesis == AS_DESIGNED, open_torque = is_open(at);
    int uncertain = *m->gain_mode != GAIN_OPEN && *at->certified == 0;
    double *share = scratch->share, total = 0.0, doubtful = 0.0;
    bound_parts parts = {0.0, at->gamma, share, at->pending, k};
    long i, a;
    parts.spread = *at->late != 0 ? noise * *m->late_factor : noise;
    if (!designed) {
        const alternative chosen = alternative_of(m, at, (long)*at->hypothesis - 1);
        x = chosen.x;
        covariance = chosen.covariance;
        upsilon = chosen.upsilon;
        parts.spread *= sqrt(larger(*chosen.nis, 1.0));
        uncertain = 1;
    }
    for (i = 0; i < m->s.plant; i++) {
        const double variance = uncertain ? covariance[i * width + i] : 0.0;
        for (a = 0; a < k; a++) {
            share[a] = upsilon[a * width + i];
        }
        if (open_torque) {
            doubtful = at->response[i];
        }
        said->state[i] = m->scale[i] * x[i];
        said->state_bound[i]
            = m->scale[i] * bound_of(&parts, m->state_std[i], variance, doubtful);
        total += said->state[i] + said->state_bound[i];
    }
    for (i = 0; i < p + m->s.t; i++) {
        const int is_output = i < p;
        const double *h
            = is_output ? m->disturbance_map + i * width : m->torque_map + (i - p) * width;
        const double least = is_output ? m->disturbance_std[i] : m->torque_std[i - p];
        double variance, value, bound;
        for (a = 0; a < k; a++) {
            share[a] = dot(h, upsilon + a * width, n);
        }
        if (open_torque) {
            doubtful = dot(h, at->response, n);
        }
        variance = uncertain ? quadratic(covariance, width, h, n) : 0.0;
        value = dot(h, x, n);
        bound = bound_of(&parts, least, variance, doubtful);
        if (is_output) {
            const double rate = dot(m->rate_map + i * width, x, n);
            if (*m->gain_mode == GAIN_OPEN) {
                value += dot(m->disturbance_direct + i * p, at->sample, p);
            }
            said->disturbance[i] = value;
            said->disturbance_bound[i] = bound;
            said->disturbance_rate[i] = rate;
            total += rate;
            said->designed_disturbance[i] = designed ? value : dot(h, at->x, n);
            said->designed_bound[i] = designed ? bound : noise * least;
        } else {
            said->torque_disturbance[i - p] = value;
            said->torque_disturbance_bound[i - p] = bound;
        }
        total += value + bound;
    }
    for (i = 0; i < k; i++) {
        /* What was learnt over a distance is wrong by a share of it: regressors move with x^. */
        const double pending = at->pending[i];
        const double moved = CURVED * (at->theta[i] + pending - at->anchor[i]);
        said->parameters[i] = at->theta[i];
        said->parameter_bound[i]
            = root(at->gamma[i * k + i] + pending * pending + moved * moved);
        total += said->parameters[i] + said->parameter_bound[i];
    }
    *said->basis = basis_of(m, at);
    *said->noise_scale = noise;
    *said->coloured_power = *at->coloured_power;
    *said->learning = learning_of(m, at);
    *said->hypothesis = *at->hypothesis;
    *said->parameters_valid = k > 0 && designed && *at->resting == 0
                              && *at->coloured_power <= MAX_COLOUR
                              && is_excited(m, at, scratch->small);
    *said->finite = isfinite(total) != 0;
}

/* Write numbers at a place, and return the place behind them. */
static double *put(double *row, const double *numbers, int64_t count)
{
    int64_t i;
    for (i = 0; i < count; i++) {
        row[i] = numbers[i];
    }
    return row + count;
}

long write_row(const model *m, const readout *said, double *row)
{
    const int64_t plant = m->s.plant, p = m->s.p, k = m->s.k, t = m->s.t;
    double *at = row;
    at = put(at, said->state, plant);
    at = put(at, said->state_bound, plant);
    at = put(at, said->disturbance, p);
    at = put(at, said->disturbance_rate, p);
    at = put(at, said->disturbance_bound, p);
    at = put(at, said->parameters, k);
    at = put(at, said->parameter_bound, k);
    at = put(at, said->designed_disturbance, p);
    at = put(at, said->designed_bound, p);
    at = put(at, said->torque_disturbance, t);
    at = put(at, said->torque_disturbance_bound, t);
    *at++ = (double)*said->basis;
    *at++ = (double)*said->parameters_valid;
    *at++ = *said->noise_scale;
    *at++ = *said->coloured_power;
    *at++ = (double)*said->learning;
    *at++ = (double)*said->hypothesis;
    return (long)(at - row);
}
