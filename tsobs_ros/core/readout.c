/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * What an estimator says: the mixture of its hypotheses, its bounds in physical units, and what they
 * rest on.
 *
 * The bounds include the uncertainty of the parameters, for x - x^ is the filter's own error plus
 * Upsilon (theta - theta^), of covariance Upsilon Gamma Upsilon', and the distance of hypotheses
 * from their mean.
 */
#include "bank.h"

#include <string.h>

static double root(double variance)
{
    return variance >= 0.0 ? sqrt(variance) : (double)NAN;
}

/* Return the power of slow innovations relative to what white noise leaves of it. */
static double slowness_of(const model *m, const hypothesis *h)
{
    return *h->slow_power / (m->constants[QUIET] * *h->nis);
}

/* Return by how much the errors of a hypothesis are larger than it says: by white noise where the
 * bound is the certificate's, and by slow innovations, which a wrong model makes. */
static double spread_of(const model *m, const state *at, const hypothesis *h, int slow)
{
    double spread = 1.0;
    if (*m->supervised == 0) {
        return *at->late != 0 ? *m->late_factor : 1.0;
    }
    if (*h->certified != 0) {
        spread = scale_of(m, at);
        spread *= *at->late != 0 ? *m->late_factor : 1.0;
    }
    return spread * sqrt(larger(*h->nis, 1.0)) * (slow ? larger(slowness_of(m, h), 1.0) : 1.0);
}

/* Return the 1-sigma bound of a linear function of a hypothesis' error.
 *
 * least: of the certificate. functional: of the states in use. slow: whether slow innovations widen
 * it, which those of an unknown torque do not: it is what explains them. */
static double bound_of(
    const model *m, const state *at, const hypothesis *h, double least, const double *functional,
    int slow, double *share)
{
    const long k = (long)m->s.k, width = (long)m->s.width, used = states_in_use(m, h);
    double own = least, added = 0.0, shift = 0.0, curved = 0.0;
    if (*m->gain_mode == GAIN_OPEN) {
        return least;
    }
    if (*h->certified == 0) {
        own = root(quadratic(h->covariance, width, functional, used));
    }
    own *= spread_of(m, at, h, slow);
    for (long a = 0; a < k; a++) {
        const double moved = h->theta[a] + h->pending[a] - h->anchor[a];
        share[a] = dot(functional, h->upsilon + a * width, used);
        shift += share[a] * h->pending[a];
        curved += share[a] * (m->constants[CURVED] * moved);
    }
    if (k > 0) {
        added = larger(quadratic(h->gamma, k, share, k), 0.0) + shift * shift + curved * curved;
    }
    return root(own * own + added);
}

/* What a function of the hypotheses is made of. */
typedef struct {
    double mean, square, own; /* of values, of their squares, and of the bounds' squares */
} moments;

/* Add a function of a hypothesis with its bound, weighed. */
static void add_moments(moments *to, double weight, double value, double bound)
{
    to->mean += weight * value;
    to->square += weight * value * value;
    to->own += weight * bound * bound;
}

/* Return the mixture's 1-sigma: the mean of the variances, and the variance of the means. */
static double mixed_bound(const moments *of)
{
    const double apart = of->square - of->mean * of->mean;
    return root(of->own + (apart > 0.0 ? apart : 0.0));
}

/* Write the weights of the hypotheses, 0 of those that do not count. */
static void weigh_all(const model *m, const state *at, double *weights)
{
    double total = 0.0;
    for (long i = 0; i < m->s.hypotheses; i++) {
        const hypothesis h = hypothesis_of(m, at, i);
        weights[i] = counts(m, &h) ? exponential(minimum(*h.score, 0.0)) : 0.0;
        total += weights[i];
    }
    for (long i = 0; i < m->s.hypotheses; i++) {
        weights[i] /= total;
    }
}

/* Return what a state's bounds rest on, and whether they are claimed to hold. */
static int64_t basis_of(const model *m, const hypothesis *best, double *claimed)
{
    const int calm = *best->nis <= m->constants[VOID] && slowness_of(m, best) <= 4.0 * m->constants[VOID];
    *claimed = *m->supervised == 0 || calm;
    if (*m->supervised != 0 && !calm) {
        return BASIS_CONTRADICTED;
    }
    if (*best->kind != AS_DESIGNED) {
        return BASIS_HYPOTHESIS;
    }
    if (*best->certified == 0) {
        return *best->settling > 0.0 || *best->age < 1.0 ? *best->cause : BASIS_COVARIANCE;
    }
    return m->s.k > 0 && *m->covered == 0 ? BASIS_LEARNT : BASIS_CERTIFIED;
}

/* Return whether the motion has been rich enough for the parameters to count. */
static int is_excited(const model *m, const hypothesis *h, double *gram)
{
    const long k = (long)m->s.k;
    copy_matrix(h->gram, k, gram, k, k, k);
    for (long i = 0; i < k; i++) {
        gram[i * k + i] -= *m->excitation;
    }
    return is_nonnegative(gram, k);
}

/* Write the functional that an output's disturbance is of a hypothesis. */
static void disturbance_of(
    const model *m, const hypothesis *h, long output, double *functional)
{
    const long width = (long)m->s.width, place = part_of(m, h, output);
    memcpy(functional, m->disturbance_map + output * width, (size_t)width * sizeof(double));
    if (place >= 0 && *h->kind != COLOURED_NOISE) {
        functional[place] = 1.0;
    }
}

/* Add what one hypothesis says, times its weight. */
static double mix_states(
    const model *m, const state *at, const double *weights, const estimate *said, work *scratch)
{
    const long width = (long)m->s.width;
    double total = 0.0;
    for (long i = 0; i < m->s.plant; i++) {
        moments mixed = {0.0, 0.0, 0.0};
        memset(scratch->functional, 0, (size_t)width * sizeof(double));
        scratch->functional[i] = 1.0;
        for (long j = 0; j < m->s.hypotheses; j++) {
            if (weights[j] > 0.0) {
                const hypothesis h = hypothesis_of(m, at, j);
                const double bound = bound_of(
                    m, at, &h, m->state_std[i], scratch->functional, 1, scratch->share);
                add_moments(&mixed, weights[j], h.x[i], bound);
            }
        }
        said->state[i] = m->scale[i] * mixed.mean;
        said->state_bound[i] = fabs(m->scale[i]) * mixed_bound(&mixed);
        total += said->state[i] + said->state_bound[i];
    }
    return total;
}

static double mix_disturbances(
    const model *m, const state *at, const double *weights, const estimate *said, work *scratch)
{
    const long p = (long)m->s.p, n = (long)m->s.n, width = (long)m->s.width;
    double total = 0.0;
    for (long i = 0; i < p + m->s.t; i++) {
        const int is_output = i < p;
        moments mixed = {0.0, 0.0, 0.0};
        double rate = 0.0;
        for (long j = 0; j < m->s.hypotheses; j++) {
            const hypothesis h = hypothesis_of(m, at, j);
            double value, bound;
            if (weights[j] <= 0.0) {
                continue;
            }
            if (is_output) {
                disturbance_of(m, &h, i, scratch->functional);
                rate += weights[j] * dot(m->rate_map + i * width, h.x, n);
            } else {
                memcpy(
                    scratch->functional, m->torque_map + (i - p) * width,
                    (size_t)width * sizeof(double));
            }
            value = dot(scratch->functional, h.x, states_in_use(m, &h));
            if (is_output && *m->gain_mode == GAIN_OPEN) {
                value += dot(m->disturbance_direct + i * p, at->sample, p);
            }
            bound = bound_of(
                m, at, &h, is_output ? m->disturbance_std[i] : m->torque_std[i - p],
                scratch->functional, is_output, scratch->share);
            add_moments(&mixed, weights[j], value, bound);
        }
        if (is_output) {
            said->disturbance[i] = mixed.mean;
            said->disturbance_bound[i] = mixed_bound(&mixed);
            said->disturbance_rate[i] = rate;
        } else {
            said->torque_disturbance[i - p] = mixed.mean;
            said->torque_disturbance_bound[i - p] = mixed_bound(&mixed);
        }
        total += mixed.mean + mixed_bound(&mixed) + rate;
    }
    return total;
}

int read_out(const model *m, const state *at, const estimate *said, work *scratch)
{
    const long k = (long)m->s.k;
    const hypothesis best = hypothesis_of(m, at, (long)*at->best);
    double total;
    weigh_all(m, at, scratch->weights);
    total = mix_states(m, at, scratch->weights, said, scratch);
    total += mix_disturbances(m, at, scratch->weights, said, scratch);
    for (long a = 0; a < k; a++) {
        /* What was learnt over a distance is wrong by a share of it: regressors move with x^. */
        moments mixed = {0.0, 0.0, 0.0};
        for (long j = 0; j < m->s.hypotheses; j++) {
            const hypothesis h = hypothesis_of(m, at, j);
            const double pending = h.pending[a];
            const double moved = m->constants[CURVED] * (h.theta[a] + pending - h.anchor[a]);
            if (scratch->weights[j] > 0.0) {
                add_moments(
                    &mixed, scratch->weights[j], h.theta[a],
                    root(h.gamma[a * k + a] + pending * pending + moved * moved));
            }
        }
        said->parameters[a] = mixed.mean;
        said->parameter_bound[a] = mixed_bound(&mixed);
        total += mixed.mean + said->parameter_bound[a];
    }
    *said->basis = (double)basis_of(m, &best, said->claimed);
    *said->noise_scale = scale_of(m, at);
    *said->coloured_power = *best.colour;
    *said->learning = k == 0                                       ? LEARNING_NONE
                      : *best.learning >= *m->adaptation_start ? LEARNING_ACTIVE
                                                                   : LEARNING_STARTING;
    *said->hypothesis = (double)*best.kind;
    *said->parameters_valid
        = k > 0 && *best.kind == AS_DESIGNED && is_excited(m, &best, scratch->small);
    *said->in_domain = 1.0;
    *said->age = 0.0;
    return isfinite(total) != 0;
}
