/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The published estimate: the mixture of the hypotheses, its bounds in physical units, and the
 * basis of the bounds.
 *
 * The bounds include the distance of the hypotheses from their mean, and the uncertainty of the
 * parameters: x - x^ is the filter's own error plus Upsilon (theta - theta^), whose covariance is
 * Upsilon Gamma Upsilon'.
 */
#include "bank.h"

#include <string.h>

/* Return the factor by which a hypothesis' 1 sigma grows with the power of slow innovations, which
 * a wrong model makes. If they last, it grows with the square of that power, as the model errs most
 * in what is not measured. The factor is limited, as this is not true of large innovations. */
static double growth_of(const model *m, const hypothesis *h)
{
    const double slowness = slowness_of(m, *h->slow_power, *h->nis);
    const double lasting = slowness_of(m, *h->lasting, *h->nis), most = 1.5 * m->constants[VOID];
    return clip(maximum(slowness, 0.6 * lasting * lasting), 1.0, most);
}

/* Return whether a fork supposes a hit, a moved arm or a stuck sensor, and its parent still counts.
 * At first such a fork has little evidence: it widens the bound, but does not move the estimate. */
static int is_undecided(const model *m, const state *at, const hypothesis *h)
{
    const hypothesis parent = hypothesis_of(m, at, *h->kind);
    return *h->fork >= HIT && *h->fork <= STUCK && counts(m, &parent);
}

/* Find the hypotheses that count in the bounds, and return how many there are. Write their places;
 * their weights there; their weights in the estimate (decided), 0 for undecided forks and if they
 * do not count; and the growth of their bounds, first of unknown torques, which explain slow
 * innovations, then of all else. */
static long weigh(const model *m, const state *at, work *scratch)
{
    double total = 0.0, decided = 0.0; /* both above 0: parents of undecided forks count */
    long count = 0;
    hypothesis h;
    for (long i = 0; find_live(m, at, &i, &h); i++) {
        if (counts_in_bounds(m, at, i, &h)) {
            const double weight = exponential(minimum(*h.score, 0.0));
            const int is_decided = counts(m, &h) && !is_undecided(m, at, &h);
            scratch->places[count] = i;
            scratch->weights[count] = maximum(weight, least_weight(m, at, i, &h));
            scratch->decided[count] = is_decided ? weight : 0.0;
            scratch->growth[2 * count] = sqrt(maximum(*h.nis, 1.0));
            scratch->growth[2 * count + 1] = scratch->growth[2 * count] * growth_of(m, &h);
            total += scratch->weights[count];
            decided += scratch->decided[count++];
        }
    }
    for (long i = 0; i < count; i++) {
        scratch->weights[i] /= total;
        scratch->decided[i] /= decided;
    }
    return count;
}

/* Return the basis of the bounds if a kind is named; write whether they are claimed to hold. They
 * are not while a system's inputs are unknown, and so is how much they move. */
static int64_t basis_of(
    const model *m, const state *at, const hypothesis *best, int64_t named, double *claimed)
{
    const int is_void = is_contradicted(m, best);
    const int is_blind = *at->in_gap != 0 && *m->design_flow.kind == KIND_SYSTEM;
    *claimed = !is_void && !is_blind && *m->gain_mode != GAIN_OPEN;
    if (is_void) {
        return BASIS_CONTRADICTED;
    }
    if (named != AS_DESIGNED) {
        return BASIS_HYPOTHESIS;
    }
    if (*best->certified == 0) {
        return *best->settling > 0.0 || *best->age < 1.0 ? *best->cause : BASIS_COVARIANCE;
    }
    return m->s.k > 0 && *m->covered == 0 ? BASIS_LEARNT : BASIS_CERTIFIED;
}

/* Return whether the motion has been rich enough for the parameters to be valid. */
static int is_excited(const model *m, const hypothesis *h, double *gram)
{
    const long k = m->s.k;
    copy_matrix(h->gram, k, gram, k, k, k);
    for (long i = 0; i < k; i++) {
        gram[i * k + i] -= *m->excitation;
    }
    return is_nonnegative(gram, k);
}

/* Quantities of an estimate: plant states, parameters, disturbances of outputs, and torques. */
enum { STATE, PARAMETER, DISTURBANCE, TORQUE };

/* Return a quantity by a hypothesis: a parameter, or a linear function of the states in use. Write
 * its variance by the hypothesis' covariance and, for disturbances and torques, the function. */
static double value_of(
    const model *m, const state *at, const hypothesis *h, int what, long place, double *variance,
    double *functional)
{
    const long width = m->s.width;
    if (what == STATE || what == PARAMETER) {
        *variance = what == STATE ? h->covariance[place * (width + 1)] : 0.0;
        return what == STATE ? h->x[place] : h->theta[place];
    }
    const long used = states_in_use(m, h);
    const int is_fault = what == DISTURBANCE && is_stuck(m, at, place);
    const double *map = what == TORQUE ? m->torque_map : m->disturbance_map;
    memcpy(functional, map + place * width, (size_t)width * sizeof *functional);
    if (is_fault) { /* all that a stuck sensor shows except the arm */
        add_scaled(functional, -1.0, m->C + place * width, m->s.n);
    } else if (what == DISTURBANCE && *h->kind != COLOURED_NOISE) {
        add_parts(m, h, place, functional);
    }
    *variance = *h->certified != 0 ? 0.0 : quadratic(h->covariance, width, functional, used);
    const double value = dot(functional, h->x, used) + (is_fault ? at->sample[place] : 0.0);
    return what == TORQUE ? value
                          : value + dot(m->disturbance_direct + place * m->s.p, at->sample, m->s.p);
}

/* Return the derivative of a quantity by a parameter. Derivatives are not kept in an array: to read
 * as vectors, as `quadratic` does, numbers just stored one by one takes a tenth of a step. */
static double slope_of(
    const model *m, const hypothesis *h, int what, long place, const double *functional, long a)
{
    const double *slopes = h->sensitivity + a * m->s.width;
    if (what == STATE || what == PARAMETER) {
        return what == STATE ? slopes[place] : a == place;
    }
    return dot(functional, slopes, states_in_use(m, h));
}

/* Return the 1-sigma error due to a wrong stiffness of an arm's state that only the spring shows: a
 * share of the twist, or of the twist's rate. Other states have none. */
static double error_by_spring(const model *m, const hypothesis *h, long place)
{
    const long other = (place + 2) % 4;
    if (m->hidden[place] == 0 || *m->design_flow.kind != KIND_ARM) {
        return 0.0;
    }
    const double twist = h->x[place] - h->x[other] * m->scale[other] / m->scale[place];
    return m->constants[SPRING] * twist;
}

/* Write the mean of a quantity over the decided hypotheses, and its bound: the root of the mean,
 * over all, of variance plus squared distance from that mean. Return their sum. A learnt change of
 * theta is wrong by a share of itself, as regressors move with x^, and what noise has taught is as
 * wrong as the prior. */
static double read_one(
    const model *m, const state *at, int what, long place, double *values, double *bounds,
    work *scratch, long count)
{
    const long k = m->s.k;
    const double unit = what == STATE ? m->scale[place] : 1.0;
    /* The quantity's 1 sigma by the certificate. */
    const double least = what == STATE         ? sqrt(m->X[place * (m->s.width + 1)])
                         : what == DISTURBANCE ? m->disturbance_std[place]
                         : what == TORQUE      ? m->torque_std[place]
                                               : 0.0;
    /* Distances are from one hypothesis, as squares of a large quantity would hide small ones. */
    double from = 0.0, mean = 0.0, mean_of_all = 0.0, mean_square = 0.0, within = 0.0;
    for (long j = 0; j < count; j++) {
        const double weight = scratch->weights[j];
        const hypothesis h = hypothesis_of(m, at, scratch->places[j]);
        const double sprung = what == STATE ? error_by_spring(m, &h, place) : 0.0;
        double variance, spread = 0.0, shift = 0.0, curved = 0.0, prior = 0.0;
        const double own_value = value_of(m, at, &h, what, place, &variance, scratch->functional);
        double own = sqrt(variance);
        if (*h.certified != 0) {
            own = least * scale_of(m, at) * (*at->late != 0 ? *m->late_factor : 1.0);
        }
        for (long a = 0; a < k; a++) {
            const double moved = h.theta[a] + h.pending[a] - h.anchor[a];
            const double slope = slope_of(m, &h, what, place, scratch->functional, a);
            const double first = slope * m->theta_deviation[a];
            for (long b = 0; slope != 0.0 && b < k; b++) {
                const double other = slope_of(m, &h, what, place, scratch->functional, b);
                spread += slope * h.gamma[a * k + b] * other;
            }
            shift += slope * h.pending[a];
            curved += slope * (m->constants[CURVED] * moved);
            prior += first * first;
        }
        const double growth = scratch->growth[2 * j + (what != TORQUE)];
        const double added = maximum(spread, 0.0);
        const double noise = *h.noise_share * *h.noise_share * prior;
        /* Parameters are known at least as well as in the beginning. */
        const double grown = maximum(minimum(growth * growth * (added + noise), prior), added);
        const double std
            = sqrt(growth * growth * (own * own)
                   + (grown + shift * shift + curved * curved + sprung * sprung));
        from = j == 0 ? own_value : from;
        const double distance = own_value - from;
        mean += scratch->decided[j] * distance;
        mean_of_all += weight * distance;
        mean_square += weight * distance * distance;
        within += weight * std * std;
    }
    const double between = mean_square - mean * (2.0 * mean_of_all - mean);
    values[place] = unit * (from + mean);
    bounds[place] = fabs(unit) * sqrt(within + (between > 0.0 ? between : 0.0));
    if (*m->gain_mode == GAIN_OPEN) { /* it has no bound */
        bounds[place] = (double)NAN;
        return values[place];
    }
    return values[place] + bounds[place];
}

int read_out(const model *m, const state *at, const estimate *row, work *scratch)
{
    const hypothesis best = best_of(m, at), designed = hypothesis_of(m, at, AS_DESIGNED);
    /* The design is named until it is half a FLOOR behind the likeliest hypothesis. */
    const int is_designed = *designed.score >= -0.5 * m->constants[FLOOR];
    const int64_t named = is_designed ? AS_DESIGNED : *best.kind;
    const long count = weigh(m, at, scratch);
    double total = 0.0;
    for (long i = 0; i < m->s.plant; i++) {
        total += read_one(m, at, STATE, i, row->state, row->state_bound, scratch, count);
    }
    for (long i = 0; i < m->s.k; i++) {
        total += read_one(
            m, at, PARAMETER, i, row->parameters, row->parameter_bound, scratch, count);
    }
    for (long i = 0; i < m->s.t; i++) {
        total += read_one(
            m, at, TORQUE, i, row->torque_disturbance, row->torque_disturbance_bound, scratch,
            count);
    }
    for (long i = 0; i < m->s.p; i++) {
        total += read_one(
            m, at, DISTURBANCE, i, row->disturbance, row->disturbance_bound, scratch, count);
        row->disturbance_rate[i] = 0.0;
        for (long j = 0; j < count; j++) {
            const double *x = hypothesis_of(m, at, scratch->places[j]).x;
            row->disturbance_rate[i]
                += scratch->decided[j] * dot(m->rate_map + i * m->s.width, x, m->s.n);
        }
        total += row->disturbance_rate[i];
    }
    *row->basis = (double)basis_of(m, at, &best, named, row->claimed);
    *row->noise_scale = scale_of(m, at);
    *row->coloured_power = *best.colour;
    total += *row->noise_scale + *row->coloured_power;
    *row->learning = m->s.k > 0 ? LEARNING_ACTIVE : LEARNING_NONE;
    *row->hypothesis = (double)named;
    *row->parameters_valid
        = m->s.k > 0 && *best.kind == AS_DESIGNED && is_excited(m, &best, scratch->small);
    *row->in_domain = 1.0;
    *row->age = 0.0;
    return count > 0 && isfinite(total);
}
