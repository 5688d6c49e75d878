/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * A bank of hypotheses about what the design lacks, each an extended Kalman filter.
 *
 * The certified gain answers slow innovations at once, so a low-passed one stays small if the model
 * is right, and grows if the arm is pushed by a force that the model lacks, long before single
 * innovations look odd. Noise that is alike from sample to sample shows in the product of
 * neighbours. Either sign wakes the alternatives, which begin from the estimate.
 *
 * They take theta and Gamma of the estimator, with a regressor of their own. The logarithm of each
 * innovation's likelihood adds up to a score that is forgotten slowly. The best hypothesis is
 * selected, if its score exceeds the design's clearly; its estimate and covariance are published.
 * The estimator goes on as designed meanwhile. While the design is selected and the signs are gone,
 * the bank sleeps and costs nothing.
 */
#include "filter.h"

/* What the selected design gains, and how far a score can fall behind the best. */
#define HYSTERESIS 1.0
#define MAX_SCORE 9.0

/* Powers of the slow and of the coloured innovations, either of which wakes the bank. */
#define WAKING_SLOW 0.7
#define WAKING_COLOUR 0.3

/* The same below which both let it sleep. */
#define CALM_SLOW 0.5
#define CALM_COLOUR 0.2

/* Times from a start to the earliest waking, from there to a selection, and to sleep [s]. */
#define SETTLED 4.0
#define SURE_TIME 1.0
#define LEAST_TIME 5.0

/* Ages of learning, and of learning again, before which theta may be wrong [s]. */
#define LEARNT 10.0
#define PASS 2.5

/* The largest innovation that counts [sigma], and the white power above which none does. */
#define CLIP 3.0
#define MAX_WHITE 2.0

/* Coloured powers: of coloured noise as assumed, and the least that counts in its favour. */
#define DESIGNED_COLOUR 0.6
#define LEAST_COLOUR 0.05

/* A noise scale below it means that neighbours differ by less than white noise. */
#define SMOOTH 0.8

/* Return whether an output's newest sample shows what arm and sensor are. */
static int shows(const model *m, const state *at, long i)
{
    const sensor of = sensor_of(m, at, i);
    const int stuck = 0 < *m->stuck_samples && *m->stuck_samples <= *of.repeats;
    return m->s.p == 1 || (at->y[i] == at->y[i] && *of.excluded == 0 && !stuck);
}

/* Low-pass an output's innovation, scaled to a variance, and follow the power of that. */
static void follow_slow(const model *m, sensor *of, double innovation, double variance)
{
    const double share = *m->sign_share;
    const double r = minimum(maximum(innovation / sqrt(variance), -CLIP), CLIP);
    double slow;
    *of->slow += share * (r - *of->slow);
    slow = *of->slow * *of->slow * ((2.0 - share) / share);
    *of->slow_power += *m->sign_power_share * (slow - *of->slow_power);
}

/* Follow the slow innovations; return the logarithm of the sample's likelihood as designed. The
 * outputs are weighed one after the other, each given those before it. */
static double weigh_design(const model *m, state *at, correction *effect)
{
    const long p = (long)m->s.p;
    const double *expected = effect->innovation_covariance;
    double *factor = effect->factor, *whitened = effect->whitened;
    double likelihood = 0.0, power = -INFINITY;
    long i, j, a;
    for (i = 0; i < p; i++) {
        sensor of = sensor_of(m, at, i);
        double scale, variance, innovation, r;
        if (!shows(m, at, i)) {
            for (j = 0; j <= i; j++) {
                factor[i * p + j] = 0.0;
            }
            whitened[i] = 0.0;
            continue;
        }
        scale = maximum(*of.noise_scale, 1.0);
        variance = scale * scale * expected[i * p + i];
        innovation = effect->innovation[i];
        follow_slow(m, &of, innovation, variance);
        power = maximum(power, *of.slow_power);
        for (j = 0; j < i; j++) {
            const double other = maximum(*sensor_of(m, at, j).noise_scale, 1.0);
            double entry = scale * other * expected[i * p + j];
            for (a = 0; a < j; a++) {
                entry -= factor[i * p + a] * factor[j * p + a];
            }
            factor[i * p + j] = factor[j * p + j] > 0.0 ? entry / factor[j * p + j] : 0.0;
            innovation -= factor[i * p + j] * whitened[j];
            variance -= factor[i * p + j] * factor[i * p + j];
        }
        factor[i * p + i] = sqrt(variance);
        whitened[i] = innovation / factor[i * p + i];
        r = minimum(maximum(whitened[i], -CLIP), CLIP);
        likelihood += -0.5 * (r * r + logarithm(variance));
    }
    if (power >= 0.0) {
        *at->slow_power = power;
    }
    return likelihood;
}

/* Correct an alternative by one output; return the logarithm of the sample's likelihood, and add
 * the square of its innovation in sigmas, clipped. */
static double correct_by(
    const model *m, state *at, long place, long output, correction *effect, double *total)
{
    const alternative_model *assumed = &m->hypotheses[place];
    const alternative other = alternative_of(m, at, place);
    const sensor of = sensor_of(m, at, output);
    const long n = (long)*assumed->n, k = (long)m->s.k, width = (long)m->s.width;
    const double *C = assumed->C + output * width;
    double *crossed = effect->vectors, *gain = crossed + width, *omega = effect->turned;
    double scale = maximum(*of.noise_scale, 1.0), weight = 1.0;
    double known, variance, innovation, ratio;
    long i, j, a;
    if (place == COLOURED_NOISE - 1) {
        /* The white scale is of differences, which coloured noise hardly has. */
        scale *= sqrt(maximum(*of.coloured_power / DESIGNED_COLOUR, 1.0));
    }
    for (j = 0; j < n; j++) {
        crossed[j] = 0.0;
    }
    for (i = 0; i < n; i++) {
        for (j = 0; j < n; j++) {
            crossed[j] += other.covariance[i * width + j] * C[i];
        }
    }
    known = dot(C, crossed, n) + assumed->variances[output];
    for (a = 0; a < k; a++) {
        omega[a] = dot(C, other.upsilon + a * width, n);
    }
    variance = scale * scale * (known + quadratic(at->gamma, k, omega, k));
    other.variances[output] = variance;
    innovation = at->y[output] - dot(C, other.x, n);
    ratio = innovation * innovation / variance;
    if (ratio > *m->gate * *m->gate) {
        weight = *m->gate * *m->gate / ratio;
    }
    for (i = 0; i < n; i++) {
        gain[i] = crossed[i] / known;
        other.x[i] += gain[i] * (weight * innovation);
    }
    for (i = 0; i < n; i++) {
        double *row = other.covariance + i * width;
        for (j = 0; j < n; j++) {
            row[j] -= crossed[i] * crossed[j] / known;
        }
    }
    for (a = 0; a < k; a++) {
        for (i = 0; i < n; i++) {
            other.upsilon[a * width + i] -= omega[a] * gain[i];
        }
    }
    ratio = minimum(ratio, CLIP * CLIP);
    *total += ratio;
    return -0.5 * (ratio + logarithm(variance));
}

/* Correct an alternative by one output after the other. Return the logarithm of the sample's
 * likelihood, and write the mean square of its innovations in sigmas, each clipped. */
static double correct_alternative(
    const model *m, state *at, long place, correction *effect, double *ratio)
{
    double likelihood = 0.0, total = 0.0;
    long count = 0, output;
    for (output = 0; output < m->s.p; output++) {
        if (shows(m, at, output)) {
            likelihood += correct_by(m, at, place, output, effect, &total);
            count += 1;
        }
    }
    *ratio = total / (double)(count > 1 ? count : 1);
    return likelihood;
}

/* Begin the alternatives from the estimate. */
static void wake(const model *m, state *at)
{
    const long n = (long)m->s.n, k = (long)m->s.k, width = (long)m->s.width;
    const double *bound = *at->certified != 0 ? m->posterior : at->covariance;
    long i, a, b;
    for (i = 0; i < ALTERNATIVES; i++) {
        const alternative_model *assumed = &m->hypotheses[i];
        const alternative other = alternative_of(m, at, i);
        /* Whole rows, so that there is no trace of numbers that were not finite. */
        for (a = 0; a < width; a++) {
            other.x[a] = a < n ? at->x[a] : 0.0;
            for (b = 0; b < width; b++) {
                other.covariance[a * width + b] = 0.0;
            }
            other.covariance[a * width + a] = assumed->added[a];
            for (b = 0; b < k; b++) {
                other.upsilon[b * width + a] = a < n ? at->upsilon[b * width + a] : 0.0;
            }
        }
        if (*assumed->n > 0) {
            copy_rows(bound, other.covariance, n, n, width);
        }
        *other.score = 0.0;
        *other.nis = 1.0;
    }
    *at->awake = 1;
    *at->awake_time = 0.0;
    *at->score = 0.0;
}

/* Take arm and sensor for what the design says, until there are new signs. */
void bank_sleep(const model *m, state *at)
{
    long i;
    *at->awake = 0;
    *at->hypothesis = AS_DESIGNED;
    *at->slow_power = 0.0;
    for (i = 0; i < m->s.p; i++) {
        const sensor of = sensor_of(m, at, i);
        *of.slow = 0.0;
        *of.slow_power = 0.0;
    }
}

/* Take the selected hypothesis' estimate and covariance for those of the estimator. */
void adopt(const model *m, state *at)
{
    const alternative chosen = alternative_of(m, at, (long)*at->hypothesis - 1);
    const long n = (long)m->s.n;
    copy_rows(chosen.x, at->x, 1, n, n);
    copy_rows(chosen.covariance, at->covariance, n, n, (long)m->s.width);
    *at->certified = 0;
    *at->corrected = 1;
    *at->in_gap = 0;
}

/* Predict the alternatives over a time [s]; the state is predicted over it, but not older yet. */
void predict_alternatives(
    const model *m, state *at, const double *u, double duration, work *scratch)
{
    const double begin = *at->torque_unknown != 0 ? *at->torque_age : *at->since;
    const long width = (long)m->s.width;
    double wider = 0.0;
    long i;
    if (*at->in_gap != 0 && isfinite(begin)) {
        /* The known torque moves unseen. */
        wider = *m->rate_variance * (2.0 * begin + duration) * duration;
    }
    for (i = 0; i < ALTERNATIVES; i++) {
        const alternative other = alternative_of(m, at, i);
        const long force = (long)*m->hypotheses[i].n - 1;
        if (force < 0) {
            continue;
        }
        other.covariance[force * width + force] += wider;
        flow_advance(
            &m->bank_flows[i], other.x, other.upsilon, other.covariance, width, at->theta, at->y,
            u, duration, scratch->flow);
    }
    *at->awake_time += duration;
}

/* Return the hypothesis whose score is best by a clear margin. */
static int64_t select_best(const model *m, const state *at)
{
    int64_t selected = AS_DESIGNED;
    double most = *at->score;
    long i;
    if (*at->hypothesis == AS_DESIGNED) {
        most += HYSTERESIS;
    }
    for (i = 0; i < ALTERNATIVES; i++) {
        double value;
        if (*m->hypotheses[i].n == 0) {
            continue;
        }
        value = *alternative_of(m, at, i).score - *m->hypotheses[i].prior;
        if (*at->hypothesis == i + 1) {
            value += *m->hypotheses[i].hysteresis;
        }
        if (value > most) {
            selected = i + 1;
            most = value;
        }
    }
    return selected;
}

/* Add to the scores of the alternatives, and make them relative to the best. Return whether they
 * are finite. */
static int score_alternatives(
    const model *m, state *at, correction *effect, double designed, int bursting, int smooth)
{
    /* A wrong theta looks like a force until it is learnt, and like noise if that is not small
     * between neighbours. */
    const int young = m->s.k > 0 && (*at->age < LEARNT || *at->pass_age < PASS)
                      && !(0 < *at->hypothesis && *at->hypothesis <= STRONG_FORCE);
    double best;
    int finite = 1;
    long i;
    *at->score = *at->score * *m->score_fade + designed;
    best = *at->score;
    for (i = 0; i < ALTERNATIVES; i++) {
        const alternative other = alternative_of(m, at, i);
        const int coloured = i == COLOURED_NOISE - 1;
        double gain, ratio;
        if (*m->hypotheses[i].n == 0) {
            continue;
        }
        gain = correct_alternative(m, at, i, effect, &ratio);
        if (bursting || (young && !(smooth && coloured))) {
            gain = designed;
        }
        if (coloured && *at->coloured_power < LEAST_COLOUR) {
            /* Its white part is small, which is likely of any sensor quieter than designed. */
            gain = minimum(gain, designed);
        }
        *other.nis += *m->second_share * (ratio - *other.nis);
        *other.score = *other.score * *m->score_fade + gain;
        finite = finite && isfinite(*other.score);
        best = maximum(best, *other.score);
    }
    if (!finite) {
        return 0;
    }
    *at->score = maximum(*at->score - best, -MAX_SCORE);
    for (i = 0; i < ALTERNATIVES; i++) {
        const alternative other = alternative_of(m, at, i);
        *other.score = maximum(*other.score - best, -MAX_SCORE);
    }
    return 1;
}

/* Weigh the hypotheses by one measurement, which the state is corrected by, and correct those that
 * are awake. */
void weigh(const model *m, state *at, correction *effect)
{
    const long p = (long)m->s.p;
    int bursting, smooth = 1;
    double designed;
    long i;
    for (i = 0; i < p; i++) {
        if (shows(m, at, i)
            && !(effect->innovation_covariance[i * p + i] > 0.0
                 && isfinite(effect->innovation[i]))) {
            return;
        }
    }
    /* White noise that has just grown is not in the scale yet, and a jump not in the estimate. */
    bursting = *at->nis - maximum(*at->coloured_power, 0.0) > MAX_WHITE;
    if (*at->awake == 0 && (bursting || *at->pause > 0.0)) {
        return;
    }
    designed = weigh_design(m, at, effect);
    for (i = 0; i < p; i++) {
        smooth = smooth && *sensor_of(m, at, i).noise_scale < SMOOTH;
    }
    if (*at->awake == 0) {
        const int suspicious
            = *at->slow_power > WAKING_SLOW || *at->coloured_power > WAKING_COLOUR;
        /* They begin from an estimate that has settled. */
        if (suspicious && *at->watch_age > SETTLED) {
            wake(m, at);
        }
        return;
    }
    if (!score_alternatives(m, at, effect, designed, bursting, smooth)) {
        bank_sleep(m, at);
        return;
    }
    /* A jump or a loss of track is found sooner. */
    if (*at->awake_time < SURE_TIME) {
        return;
    }
    *at->hypothesis = select_best(m, at);
    if (*at->slow_power < CALM_SLOW && *at->coloured_power < CALM_COLOUR
        && *at->hypothesis == AS_DESIGNED && *at->awake_time > LEAST_TIME) {
        bank_sleep(m, at);
    }
}
