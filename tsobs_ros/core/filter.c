/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * One hypothesis: a filter along the estimate, whatever it supposes.
 *
 * The premise variable is the estimate itself; the flow's closed form of the T-S blend is exact on
 * the domain. The gain is that of Riccati (Kalman), or, as designed and once the certificate's
 * bound X covers the error covariance, the constant certified one until a sample is amiss.
 *
 * Parameters are learnt by a filtered-regressor (two-stage) adaptive observer after Q. Zhang
 * (2002): the regressor Upsilon = dx/dtheta is filtered through the observer's own error dynamics,
 * so that the innovation is explained as e = Omega (theta - theta^) + noise with Omega = C Upsilon.
 * A change of theta follows by recursive least squares, projected on its known bounds, and is used
 * from when it is significant. What was learnt far from the truth, along wrong regressors, is
 * learnt again.
 */
#include "bank.h"

#include <string.h>

long states_in_use(const model *m, const hypothesis *h)
{
    const long n = m->s.n;
    if (m->s.width == m->s.n) {
        return n;
    }
    switch (*h->kind) {
    case COLOURED_NOISE:
    case DRIFT:
        return n + 1 + m->s.p;
    case TONE:
        return n + 4;
    case FORCE:
        return n + 1;
    default:
        return h->covariance[n * m->s.width + n] > 0.0 ? n + 1 : n;
    }
}

long part_of(const model *m, const hypothesis *h, long output)
{
    const long first = m->s.n + 1;
    if (*h->kind == COLOURED_NOISE || *h->kind == DRIFT) {
        return first + output;
    }
    return *h->kind == TONE && *h->output == output ? first : -1;
}

void leave_certified(const model *m, const state *at, const hypothesis *h, int64_t cause)
{
    const long n = m->s.n, width = m->s.width;
    const double *bound = *h->corrected != 0 ? m->posterior : m->X;
    const double square = scale_of(at) * scale_of(at);
    if (*h->certified == 0) {
        return;
    }
    for (long i = 0; i < n; i++) {
        for (long j = 0; j < n; j++) {
            h->covariance[i * width + j] = square * bound[i * width + j];
        }
    }
    *h->certified = 0;
    *h->cause = cause;
}

/* --- correction --- */

/* Return what the filter expects of an output; write the output's row of states in use and, unless
 * the gain is the certified one, the covariance of the innovation with them, `crossed`. */
static outlook expect(
    const model *m, const state *at, const hypothesis *h, long i, correction *effect)
{
    const long p = m->s.p, width = m->s.width;
    const long used = states_in_use(m, h), place = part_of(m, h, i);
    const double scale = noise_of(m, at, i);
    const double factor = *h->kind == LOUD ? m->constants[NOISE_FACTOR] : 1.0;
    double *row = effect->row;
    outlook of = {0.0, 0.0, 0.0, 0.0, 0};
    memcpy(row, m->C + i * width, (size_t)width * sizeof *row);
    if (place >= 0) {
        row[place] = 1.0;
    }
    of.innovation = at->y[i] - (dot(row, h->x, used) + dot(m->D + i * p, at->sample, p));
    if (*h->certified != 0) {
        of.known = scale * scale * m->innovation_covariance[i * p + i];
        return of;
    }
    for (long j = 0; j < used; j++) {
        effect->crossed[j] = dot(row, h->covariance + j * width, used);
    }
    of.known = dot(row, effect->crossed, used) + m->R[i * p + i] * (scale * scale * factor);
    return of;
}

/* Return what a sample costs a hypothesis: one that leaves slow innovations is wrong, however small
 * they are. A tone may leave none, as a wrong model of the arm may look like one. */
static double price_of(const model *m, const hypothesis *h)
{
    const double slowness = slowness_of(m, h, *h->slow_power);
    double price = maximum(1.0, slowness * m->constants[QUIET] / m->constants[SIGN_SLOW]);
    if (*h->kind == TONE) {
        price += 0.5 * (1.0 + maximum(1.0, slowness));
    }
    return m->constants[SLOW_PRICE] * price;
}

/* Look at a sample; write Omega = C Upsilon. The likelihood of an outlier is the same wherever the
 * sample is, and whatever the filter expects. */
static outlook look(
    const model *m, const state *at, const hypothesis *h, long i, correction *effect)
{
    const long k = m->s.k, p = m->s.p, used = states_in_use(m, h);
    const double scale = noise_of(m, at, i);
    double *omega = effect->omega + i * k;
    outlook of = expect(m, at, h, i, effect);
    for (long a = 0; a < k; a++) {
        omega[a] = dot(effect->row, h->upsilon + a * m->s.width, used);
    }
    of.variance = of.known + (k > 0 ? maximum(quadratic(h->gamma, k, omega, k), 0.0) : 0.0);
    if (!effect->heard[i]) {
        return of;
    }
    const double ratio = of.innovation * of.innovation / of.variance;
    of.likelihood = -0.5 * ratio - 0.5 * logarithm(of.variance);
    if (*m->supervised == 0) {
        of.used = !(ratio > *m->gate * *m->gate);
        return of;
    }
    of.likelihood -= price_of(m, h);
    const double level = 0.5 * logarithm(scale * scale * m->innovation_covariance[i * p + i]);
    of.used = of.likelihood >= -0.5 * *m->gate * *m->gate - level;
    of.likelihood = maximum(of.likelihood, -m->constants[OUTLIER_PRICE] - level);
    return of;
}

void weigh(const model *m, const state *at, const hypothesis *h, correction *effect)
{
    for (long i = 0; i < m->s.p; i++) {
        *outlook_of(effect, i) = look(m, at, h, i, effect);
    }
}

/* Follow the innovations: averages over a second, and the slow part. */
static void follow(
    const model *m, const state *at, hypothesis *h, long output, const outlook *of)
{
    const double elapsed = counted_time(m, *sensor_of(m, at, output).since);
    const double share = share_of(elapsed, 1.0) / (double)m->s.p;
    const double slow_share = share_of(elapsed, m->constants[SLOW_TIME]);
    const double r = clip(of->innovation / sqrt(of->variance), -*m->gate, *m->gate);
    double *slow = h->slow + output;
    *h->nis += share * (r * r - *h->nis);
    *h->colour += share * (r * h->previous[output] - *h->colour);
    h->previous[output] = r;
    *slow += slow_share * (r - *slow);
    const double power = *slow * *slow * ((2.0 - slow_share) / slow_share);
    const double time = m->constants[POWER_TIME], longer = clip(*at->age, time, 4.0 * time);
    const double most = 2.0 * m->constants[VOID] * m->constants[QUIET] * *h->nis;
    const double outputs = (double)m->s.p;
    *h->slow_power += share_of(elapsed, time) / outputs * (power - *h->slow_power);
    *h->lasting += share_of(elapsed, longer) / outputs * (minimum(power, most) - *h->lasting);
}

/* Return by how much less than one of the design an innovation says about parameters: by the mean
 * of the covariance relative to the certified bound, as regressors are wrong where x^ is; by what
 * was measured of the innovations; and as neighbours that are alike, by more than the three sigmas
 * of white noise, repeat each other. */
static double inflation_of(const model *m, const hypothesis *h)
{
    const long n = m->s.n, width = m->s.width;
    const double alike
        = maximum(*h->colour / maximum(*h->nis, 1.0) - 3.0 * sqrt(0.5 * *m->period), 0.0);
    double inflation = 1.0;
    if (*h->certified == 0) {
        double total = 0.0;
        for (long i = 0; i < n; i++) {
            total += dot(m->P + i * width, h->covariance + i * width, n);
        }
        inflation = maximum(total / (double)n, 1.0);
    }
    return inflation * (maximum(*h->nis, 1.0) * ((1.0 + alike) / (1.0 - alike)));
}

/* Correct the parameters' covariance and the pending change of them by one output. At rest,
 * regressors are the noise of the estimate: what they show is as likely false. */
static void adapt_by(
    const model *m, const state *at, hypothesis *h, const double *omega, const outlook *of,
    double inflation, double *cross)
{
    const long k = m->s.k;
    /* A filter whose regressors are taken to be right knows of no noise in them. */
    const double stillness = m->constants[CURVED] > 0.0 ? *at->stillness : 0.0;
    double variance = of->known * inflation, left = of->innovation - dot(omega, h->pending, k);
    for (long a = 0; a < k; a++) {
        cross[a] = dot(h->gamma + a * k, omega, k);
    }
    variance += dot(omega, cross, k);
    for (long a = 0; a < k; a++) {
        const double moved = h->theta[a] + h->pending[a] + cross[a] / variance * left;
        const double all = variance * h->gamma[a * (k + 1)];
        const double learnt = all > 0.0 ? cross[a] * cross[a] / all : 0.0;
        *h->noise_share += learnt / (double)k * (stillness - *h->noise_share);
        for (long b = 0; b <= a; b++) {
            h->gamma[a * k + b] -= cross[a] * cross[b] / variance;
            h->gamma[b * k + a] = h->gamma[a * k + b];
        }
        h->pending[a] = clip(moved, -m->limits[a], m->limits[a]) - h->theta[a];
    }
}

/* Use the pending change of the parameters from when it is significant on, or at once if the model
 * is said to be wrong. */
static void use_pending(const model *m, hypothesis *h, correction *effect)
{
    const long k = m->s.k, used = states_in_use(m, h);
    *h->significant |= *h->kind == IMPERFECT;
    if (*h->significant == 0) {
        solve(h->gamma, h->pending, effect->root, effect->scaled, k);
        *h->significant = dot(h->pending, effect->scaled, k) > *m->significance;
    }
    if (*h->significant != 0) {
        for (long a = 0; a < k; a++) {
            add_scaled(h->x, h->pending[a], h->upsilon + a * m->s.width, used);
            h->theta[a] += h->pending[a];
            h->pending[a] = 0.0;
        }
    }
}

/* Correct the regressors by an output's gain, and add to the measure of excitation. */
static void correct_regressors(
    const model *m, hypothesis *h, const double *omega, const double *gain, double known)
{
    const long k = m->s.k, used = states_in_use(m, h);
    for (long a = 0; a < k; a++) {
        add_scaled(h->upsilon + a * m->s.width, -omega[a], gain, used);
        for (long b = 0; b < k; b++) {
            h->gram[a * k + b] += omega[a] * omega[b] / known;
        }
    }
}

/* Correct the estimate by an output with gain K and, unless that is the certified one, the
 * covariance, x <- x + K e,  P <- P - K c'  with K = c / s. */
static void correct_estimate(
    const model *m, hypothesis *h, long output, const outlook *of, correction *effect)
{
    const long width = m->s.width, used = states_in_use(m, h);
    for (long j = 0; j < used; j++) {
        const double gain = *h->certified != 0 ? m->K[j * m->s.p + output]
                                               : effect->crossed[j] / of->known;
        double *row = h->covariance + j * width;
        effect->gain[j] = gain;
        h->x[j] += gain * of->innovation;
        if (*h->certified != 0) {
            continue;
        }
        for (long i = 0; i <= j; i++) {
            row[i] -= gain * effect->crossed[i];
            h->covariance[i * width + j] = row[i];
        }
    }
}

double correct_by(
    const model *m, const state *at, hypothesis *h, long output, int adapt, correction *effect)
{
    const double inflation = adapt ? inflation_of(m, h) : 1.0;
    const double *omega = effect->omega + output * m->s.k;
    /* The certified gain is of all outputs at once; others change what is expected of the next. */
    const outlook of
        = *h->certified != 0 ? *outlook_of(effect, output) : look(m, at, h, output, effect);
    correct_estimate(m, h, output, &of, effect);
    if (*m->supervised != 0) {
        follow(m, at, h, output, &of);
    }
    correct_regressors(m, h, omega, effect->gain, of.known);
    if (adapt) {
        adapt_by(m, at, h, omega, &of, inflation, effect->cross);
    }
    return of.likelihood;
}

/* Begin another pass of learning: what the last one moved is wrong by a share of it, as its
 * regressors were; and what it learnt of noise is learnt again once the plant moves more. */
static void begin_pass(const model *m, const state *at, hypothesis *h)
{
    const long k = m->s.k;
    const double noise = minimum(*h->noise_share, *at->stillness);
    const double doubt = maximum(*h->noise_share * *h->noise_share - noise * noise, 0.0);
    if (*h->pass_age <= *m->pass_time) {
        return;
    }
    *h->pass_age = 0.0;
    *h->noise_share = noise;
    for (long a = 0; a < k; a++) {
        const double wrong = m->constants[CURVED] * (h->theta[a] - h->anchor[a]);
        const double most = m->theta_deviation[a] * m->theta_deviation[a];
        double *variance = h->gamma + a * k + a;
        *variance = minimum(*variance + wrong * wrong + doubt * most, most);
        h->anchor[a] = h->theta[a];
    }
}

double correct_hypothesis(const model *m, const state *at, hypothesis *h, correction *effect)
{
    const int adapt = m->s.k > 0;
    double said = 0.0;
    int64_t used = 0;
    for (long i = 0; i < m->s.p; i++) {
        used += outlook_of(effect, i)->used;
        said += outlook_of(effect, i)->likelihood;
    }
    if (*m->gain_mode == GAIN_OPEN || used == 0) {
        return said;
    }
    if (used < m->s.p) { /* the certified gain is for all outputs together */
        leave_certified(m, at, h, BASIS_GAP);
    }
    for (long i = 0; i < m->s.p; i++) {
        const outlook *of = outlook_of(effect, i);
        if (of->used) {
            said += correct_by(m, at, h, i, adapt, effect) - of->likelihood;
        }
    }
    *h->corrected = 1;
    if (adapt) {
        use_pending(m, h, effect);
        begin_pass(m, at, h);
    }
    return said;
}

/* --- prediction --- */

/* Write the auxiliary states' own motion over a step, a = D a + noise, into D and the noise's
 * covariance, matrices with rows of `stride`. */
static void write_own_motion(
    const model *m, const hypothesis *h, double duration, double forgotten, long stride, double *D,
    double *added)
{
    const double torque = exponential(-duration / m->constants[FORCE_TIME]);
    D[0] = torque;
    if (*h->kind == FORCE) {
        added[0] = *m->force * *m->force * (1.0 - torque * torque);
    }
    if (forgotten > 0.0) {
        added[0] += forgotten * duration;
    }
    if (*h->kind == TONE) {
        const double decay = exponential(-duration / m->constants[TONE_TIME]);
        const double frequency = h->x[m->s.n + 3], wander = halfway_from(m, frequency);
        double sin, cos;
        sine_and_cosine(frequency * duration, &sin, &cos);
        D[stride + 1] = D[2 * stride + 2] = decay * cos;
        D[stride + 2] = decay * sin;
        D[2 * stride + 1] = -(decay * sin);
        D[3 * stride + 3] = 1.0;
        added[stride + 1] = added[2 * stride + 2] = *h->size * *h->size * (1.0 - decay * decay);
        added[3 * stride + 3] = wander * wander * duration / m->constants[TONE_TIME];
    } else if (*h->kind == COLOURED_NOISE || *h->kind == DRIFT) {
        const int is_drift = *h->kind == DRIFT;
        const double size = is_drift ? *h->size : m->constants[COLOUR_SIZE];
        const double time = m->constants[is_drift ? DRIFT_TIME : COLOUR_TIME];
        const double decay = exponential(-duration / time);
        const double noise = size * size * (1.0 - decay * decay);
        for (long j = 0; j < m->s.p; j++) {
            const long place = (j + 1) * (stride + 1);
            D[place] = decay;
            added[place] = noise * m->R[j * (m->s.p + 1)];
        }
    }
}

/* Take a step with signals u: move x, the regressors and, unless it is `simple`, the covariance,
 * by the map of the design's states and the auxiliary ones
 *
 *     F = [J g e'; 0 D],   g what the unknown torque, the first of these, pushes. */
static void step_hypothesis(
    const model *m, hypothesis *h, const linear_step *over, double *u, int simple,
    double forgotten, const flow_step *step, work *scratch)
{
    const long n = m->s.n, k = m->s.k, width = m->s.width;
    const long used = simple ? n : states_in_use(m, h), count = used - n;
    const double *F = step->J, *added = step->Q;
    double *moved = scratch->moved;
    if (count > 0 && m->s.m > 0) {
        u[0] += h->x[n];
    }
    take_step(
        &m->design_flow, over, h->x, h->theta, u,
        simple ? (k > 0 ? DERIVATIVES : NOTHING) : COVARIANCE, step);
    if (count > 0) {
        const long corner = n * (used + 1);
        double *map = scratch->map, *noise = scratch->added;
        memset(map, 0, (size_t)(used * used) * sizeof *map);
        memset(noise, 0, (size_t)(used * used) * sizeof *noise);
        copy_matrix(F, n, map, used, n, n);
        copy_matrix(added, n, noise, used, n, n);
        for (long i = 0; i < n; i++) {
            map[i * used + n] = step->effects[k * n + i];
        }
        write_own_motion(m, h, over->duration, forgotten, used, map + corner, noise + corner);
        for (long i = 0; i < count; i++) {
            moved[i] = dot(map + corner + i * used, h->x + n, count);
        }
        if (*h->kind == TONE) { /* by how much a faster tone would have turned further */
            map[corner + used + 3] = over->duration * moved[2];
            map[corner + 2 * used + 3] = -(over->duration * moved[1]);
        }
        memcpy(h->x + n, moved, (size_t)count * sizeof *moved);
        F = map;
        added = noise;
    }
    for (long a = 0; a < k; a++) {
        double *row = h->upsilon + a * width;
        transform(F, row, moved, used);
        add_scaled(moved, 1.0, step->effects + a * n, n);
        memcpy(row, moved, (size_t)used * sizeof *row);
    }
    if (!simple) {
        copy_matrix(h->covariance, width, scratch->square, used, used, used);
        congruence(F, scratch->square, added, scratch->squares, used);
        copy_matrix(scratch->square, used, h->covariance, width, used, used);
    }
}

/* Return the number of nominal steps in a duration [s], and write the length of a last one, which
 * is 0 or up to STRETCH periods, as stamps jitter. */
#define STRETCH 1.25
static int64_t cut_into_steps(double duration, double period, double *rest)
{
    int64_t whole = (int64_t)floor(duration / period);
    *rest = duration - (double)whole * period;
    if (*rest < 0.0) {
        whole -= 1;
        *rest += period;
    }
    if (whole > 0 && 0.0 < *rest && *rest <= (STRETCH - 1.0) * period) {
        whole -= 1;
        *rest += period;
    }
    return whole;
}

/* Let the excitation fade and Gamma grow, but no variance beyond the initial one. */
static void forget_slowly(const model *m, hypothesis *h, double duration)
{
    const long k = m->s.k;
    const double fade = 1.0 - share_of(duration, *m->memory);
    *h->pass_age += duration;
    for (long i = 0; i < k * k; i++) {
        h->gram[i] *= fade;
    }
    for (long a = 0; a < k; a++) {
        const double most = m->theta_deviation[a] * m->theta_deviation[a];
        double *variance = h->gamma + a * k + a;
        *variance = minimum(*variance + *m->random_walk * duration, most);
    }
}

void predict_hypothesis(
    const model *m, const state *at, hypothesis *h, double duration, int simple, double forgotten,
    work *scratch)
{
    const flow *f = &m->design_flow;
    const flow_sizes sizes = flow_sizes_of(m->flow);
    const flow_step step = flow_step_view(&sizes, scratch->flow);
    const int is_late = m->s.past > 0 && isfinite(at->past[1]);
    double *u = scratch->inputs, rest;
    const int64_t whole = cut_into_steps(duration, *m->period, &rest);
    linear_step over = {*m->period, f->phi, f->gamma, f->noise};
    for (int64_t taken = 0; taken < whole + (rest > 0.0); taken++) {
        if (taken == whole) {
            over = other_step(f, rest, &step);
        }
        memcpy(u, at->held, (size_t)m->s.m * sizeof *u);
        if (is_late) { /* the torque that reaches the motor in this step */
            u[0] = mean_torque(m, at, (double)taken * *m->period, over.duration);
        }
        if (*m->gain_mode == GAIN_OPEN) { /* the newest samples are signals, too */
            memcpy(u + m->s.m, at->sample, (size_t)m->s.p * sizeof *u);
            memcpy(u + m->s.m + m->s.p, at->sample, (size_t)m->s.p * sizeof *u);
        }
        step_hypothesis(m, h, &over, u, simple, forgotten, &step, scratch);
    }
    if ((*h->kind == IMPERFECT || *h->kind == TONE) && !simple) {
        /* What is left of a tone moves the arm's estimate, but its model is not that wrong. */
        const double imperfection = m->constants[IMPERFECTION];
        const double more = ((*h->kind == TONE ? sqrt(sqrt(imperfection)) : imperfection) - 1.0)
                            * (duration / *m->period);
        const double half = *f->kind == KIND_SYSTEM ? 2.0 : 1.0;
        for (long i = 0; i < m->s.plant; i++) {
            add_scaled(
                h->covariance + i * m->s.width, half * more, f->noise + i * m->s.n, m->s.plant);
        }
    }
    *h->corrected = 0;
    *h->age += duration;
    *h->settling = maximum(0.0, *h->settling - duration);
    if (m->s.k > 0) {
        forget_slowly(m, h, duration);
    }
}

/* --- a log, for identification --- */

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
    for (long i = 0; i < n; i++) { /* twice on the diagonal */
        P[place * width + i] *= slope;
        P[i * width + place] *= slope;
    }
}

void write_innovations(
    const model *m, state *at, const sample_log *log, const filter_options *options,
    int64_t corrected_until, double *innovations, double *variances, double *states,
    correction *effect, work *scratch)
{
    const long n = m->s.n, p = m->s.p, width = m->s.width;
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
            const outlook of = expect(m, at, &h, i, effect);
            const double square = of.innovation * of.innovation;
            const int is_there = isfinite(at->y[i]) != 0, is_free = k >= corrected_until;
            innovations[k * p + i] = is_there ? of.innovation : NAN;
            variances[k * p + i] = is_there && !is_free ? of.known : NAN;
            if (is_there && !is_free && square <= options->gate * options->gate * of.known) {
                correct_estimate(m, &h, i, &of, effect);
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
