/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * One hypothesis: a filter along the estimate, the same for all kinds.
 *
 * The premise variable is the estimate itself; the flow equals the T-S blend of the rules on the
 * domain. The gain is Riccati's (Kalman's). AS_DESIGNED takes the constant certified gain instead
 * once the certified bound X covers its error covariance, until a sample is missing or irregular.
 *
 * Parameters are learnt by a filtered-regressor (two-stage) adaptive observer after Q. Zhang
 * (2002): the regressor Upsilon = dx/dtheta is filtered through the observer's own error dynamics,
 * so that the innovation is explained as e = Omega (theta - theta^) + noise with Omega = C Upsilon.
 * A change of theta is estimated by recursive least squares, projected onto theta's known bounds,
 * and used once it is significant. What was learnt far from the truth, along wrong regressors, is
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
        return h->x[n + 6] > 0.0 ? n + 7 : n + 4;
    case FORCE:
        return m->force[1] > 0.0 ? n + 2 : n + 1;
    default:
        return h->covariance[n * m->s.width + n] > 0.0 ? n + 1 : n;
    }
}

void add_parts(const model *m, const hypothesis *h, long output, double *row)
{
    const long first = m->s.n + 1;
    if (*h->kind == COLOURED_NOISE || *h->kind == DRIFT) {
        row[first + output] = 1.0;
    } else if (*h->kind == TONE && *h->output == output) {
        row[first] = row[first + 3] = 1.0;
    }
}

void leave_certified(const model *m, const state *at, const hypothesis *h, int64_t cause)
{
    const long n = m->s.n, width = m->s.width;
    const double *bound = *h->corrected != 0 ? m->posterior : m->X;
    if (*h->certified == 0) {
        return;
    }
    const double scale = scale_of(m, at), square = scale * scale;
    for (long i = 0; i < n; i++) {
        for (long j = 0; j < n; j++) {
            h->covariance[i * width + j] = square * bound[i * width + j];
        }
    }
    *h->certified = 0;
    *h->cause = cause;
}

/* --- correction --- */

/* Return an output's outlook for exact parameters. Write its derivative by the states (row) and,
 * unless the gain is certified, the innovation's covariance with the states in use (crossed). */
static outlook expect(
    const model *m, const state *at, const hypothesis *h, long i, correction *effect)
{
    const long p = m->s.p, width = m->s.width, used = states_in_use(m, h);
    const double scale = noise_of(m, at, i);
    const double factor = *h->kind == LOUD ? m->constants[NOISE_FACTOR] : 1.0;
    double *row = effect->row, *crossed = effect->crossed + i * width;
    outlook of = {0.0, 0.0, 0.0, 0.0, 0};
    memcpy(row, m->C + i * width, (size_t)width * sizeof *row);
    add_parts(m, h, i, row);
    of.innovation = at->y[i] - (dot(row, h->x, used) + dot(m->D + i * p, at->sample, p));
    if (*h->certified != 0) {
        of.known = scale * scale * m->innovation_variance[i];
        return of;
    }
    combine(row, h->covariance, width, crossed, used, used);
    of.known = dot(row, crossed, used) + m->R[i * p + i] * (scale * scale * factor);
    return of;
}

/* Return the price of a sample, whose base is at most 1 nat per second. It rises with slow
 * innovations, which show that a hypothesis is wrong. TONE pays more; and if a sensor has no
 * disturbance that can stay, all but the design do. Section 5 of docs/estimator.md says why. */
static double price_of(const model *m, const hypothesis *h)
{
    const double sign = m->constants[SIGN_SLOW] * maximum(*h->nis, 1.0);
    double price = maximum(1.0, *h->slow_power / sign);
    if (*h->kind == TONE) {
        price += 0.5 * (1.0 + maximum(1.0, slowness_of(m, *h->slow_power, *h->nis)));
    }
    if (*h->kind != AS_DESIGNED && *m->is_clean != 0) {
        price += *h->kind == TONE ? 2.0 : *h->kind == DRIFT ? 1.5 : 1.0;
    }
    return minimum(m->constants[SLOW_PRICE], *m->period) * price;
}

/* Return the outlook of an output; write Omega = C Upsilon. The likelihood of an outlier is the
 * same wherever the sample is, and whatever the filter expects. */
static outlook judge(
    const model *m, const state *at, const hypothesis *h, long i, correction *effect)
{
    const long k = m->s.k, width = m->s.width, used = states_in_use(m, h);
    const double scale = noise_of(m, at, i);
    double *omega = effect->omega + i * k;
    outlook of = expect(m, at, h, i, effect);
    for (long a = 0; a < k; a++) {
        omega[a] = dot(effect->row, h->sensitivity + a * width, used);
    }
    of.variance = of.known + (k > 0 ? maximum(quadratic(h->gamma, k, omega, k), 0.0) : 0.0);
    if (!effect->present[i]) {
        return of;
    }
    const double ratio = of.innovation * of.innovation / of.variance;
    if (*m->supervised == 0) {
        of.used = !(ratio > *m->gate * *m->gate);
        return of;
    }
    const double designed = scale * scale * m->innovation_variance[i];
    of.likelihood = -0.5 * ratio - 0.5 * logarithm(of.variance / designed) - price_of(m, h);
    /* The start may be far less exact than the sensor, so its first sample need not be likely. */
    of.used = of.likelihood >= -0.5 * *m->gate * *m->gate
              || (*at->age == 0.0 && ratio <= *m->gate * *m->gate);
    of.likelihood = maximum(of.likelihood, -m->constants[OUTLIER_PRICE]);
    return of;
}

void expect_outputs(const model *m, const state *at, const hypothesis *h, correction *effect)
{
    for (long i = 0; i < m->s.p; i++) {
        *outlook_of(effect, i) = judge(m, at, h, i, effect);
    }
}

/* Update the averages of innovations over a second, and the power of their slow part. */
static void track_innovations(
    const model *m, const state *at, hypothesis *h, long output, const outlook *of)
{
    const sensor from = sensor_of(m, at, output);
    const double elapsed = counted_time(m, *from.since, *from.interval);
    const double outputs = (double)m->s.p, share = share_of(elapsed, 1.0) / outputs;
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
    *h->slow_power += share_of(elapsed, time) / outputs * (power - *h->slow_power);
    *h->lasting += share_of(elapsed, longer) / outputs * (minimum(power, most) - *h->lasting);
}

/* Return the factor by which the variance of an innovation is larger for learning parameters, by
 * the covariance relative to the certified bound, the measured power of innovations, and their
 * correlation beyond the three sigmas of white noise. Section 7 of docs/estimator.md says why. */
static double inflation_of(const model *m, const hypothesis *h)
{
    const long n = m->s.n, width = m->s.width;
    /* At periods near a second, the averages are of a few innovations, and may be beyond 1. */
    const double alike
        = clip(*h->colour / maximum(*h->nis, 1.0) - 3.0 * sqrt(0.5 * *m->period), 0.0, 0.99);
    double inflation = 1.0;
    if (*h->certified == 0) {
        double total = 0.0;
        for (long i = 0; i < n; i++) {
            total += dot(m->P + i * width, h->covariance + i * width, n);
        }
        inflation = clip(total / (double)n, 1.0, 4.0);
    }
    return inflation * (maximum(*h->nis, 1.0) * ((1.0 + alike) / (1.0 - alike)));
}

/* Correct the parameters' covariance and pending change by one output. At rest the regressors are
 * the noise of the estimate, so noise_share counts what is learnt then as possibly false. */
static void adapt_by(
    const model *m, const state *at, hypothesis *h, const double *omega, const outlook *of,
    double inflation, double *cross)
{
    const long k = m->s.k;
    /* If CURVED is 0, regressors are taken to be right, and so without noise. */
    const double stillness = m->constants[CURVED] > 0.0 ? *at->stillness : 0.0;
    double known = 0.0;
    for (long a = 0; a < k; a++) {
        cross[a] = dot(h->gamma + a * k, omega, k);
        known += omega[a] * cross[a];
    }
    const double variance = of->known * inflation + known;
    const double left = of->innovation - dot(omega, h->pending, k);
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

/* Use the pending change of the parameters once one has been significant, or at once for IMPERFECT,
 * which supposes a wrong model. */
static void use_pending(const model *m, hypothesis *h, correction *effect)
{
    const long k = m->s.k, used = states_in_use(m, h);
    *h->significant |= *h->kind == IMPERFECT;
    if (*h->significant == 0) {
        solve(h->gamma, h->pending, effect->root, effect->cross, k);
        *h->significant = dot(h->pending, effect->cross, k) > *m->significance;
    }
    if (*h->significant != 0) {
        for (long a = 0; a < k; a++) {
            add_scaled(h->x, h->pending[a], h->sensitivity + a * m->s.width, used);
            h->theta[a] += h->pending[a];
            h->pending[a] = 0.0;
        }
    }
}

/* Correct the estimate by an output with gain K and, unless that is the certified one, the
 * covariance, x <- x + K e,  P <- P - K c'  with K = c / s. */
static void correct_estimate(
    const model *m, hypothesis *h, long output, const outlook *of, correction *effect)
{
    const long width = m->s.width, used = states_in_use(m, h);
    const double *crossed = effect->crossed + output * width;
    for (long j = 0; j < used; j++) {
        const double gain = *h->certified != 0 ? m->K[j * m->s.p + output]
                                               : crossed[j] / of->known;
        double *row = h->covariance + j * width;
        effect->gain[j] = gain;
        h->x[j] += gain * of->innovation;
        for (long i = 0; *h->certified == 0 && i <= j; i++) {
            row[i] -= gain * crossed[i];
            h->covariance[i * width + j] = row[i];
        }
    }
}

double correct_by(
    const model *m, const state *at, hypothesis *h, long output, int is_expected, int adapt,
    correction *effect)
{
    const long k = m->s.k;
    const double inflation = adapt ? inflation_of(m, h) : 1.0;
    const double *omega = effect->omega + output * k;
    const outlook of = is_expected ? *outlook_of(effect, output) : judge(m, at, h, output, effect);
    correct_estimate(m, h, output, &of, effect);
    if (*m->supervised != 0) {
        track_innovations(m, at, h, output, &of);
    }
    const long used = states_in_use(m, h);
    for (long a = 0; a < k; a++) { /* the regressors, and the measure of excitation */
        add_scaled(h->sensitivity + a * m->s.width, -omega[a], effect->gain, used);
        for (long b = 0; b < k; b++) {
            h->gram[a * k + b] += omega[a] * omega[b] / of.known;
        }
    }
    if (adapt) {
        adapt_by(m, at, h, omega, &of, inflation, effect->cross);
    }
    return of.likelihood;
}

/* Begin another pass of learning after the last. What that has changed is wrong by a share of it,
 * as its regressors were; what noise has taught is learnt again once the plant moves more. */
static void begin_pass(const model *m, const state *at, hypothesis *h)
{
    const long k = m->s.k;
    const double noise = minimum(*h->noise_share, *at->stillness);
    const double unlearnt = maximum(*h->noise_share * *h->noise_share - noise * noise, 0.0);
    if (*h->pass_age <= *m->pass_time) {
        return;
    }
    *h->pass_age = 0.0;
    *h->noise_share = noise;
    for (long a = 0; a < k; a++) {
        const double wrong = m->constants[CURVED] * (h->theta[a] - h->anchor[a]);
        const double most = m->theta_deviation[a] * m->theta_deviation[a];
        double *variance = h->gamma + a * k + a;
        *variance = minimum(*variance + wrong * wrong + unlearnt * most, most);
        h->anchor[a] = h->theta[a];
    }
}

double correct_hypothesis(const model *m, const state *at, hypothesis *h, correction *effect)
{
    const int adapt = m->s.k > 0;
    double likelihood = 0.0;
    int64_t used = 0;
    for (long i = 0; i < m->s.p; i++) {
        used += outlook_of(effect, i)->used;
        likelihood += outlook_of(effect, i)->likelihood;
    }
    if (*m->gain_mode == GAIN_OPEN || used == 0) {
        return likelihood;
    }
    int is_expected = *h->certified == 0 || used == m->s.p;
    if (used < m->s.p) { /* the certified gain needs all outputs */
        leave_certified(m, at, h, BASIS_GAP);
    }
    for (long i = 0; i < m->s.p; i++) {
        const outlook *of = outlook_of(effect, i);
        if (of->used) {
            likelihood += correct_by(m, at, h, i, is_expected, adapt, effect) - of->likelihood;
            is_expected = *h->certified != 0; /* Riccati gains change the next outlook */
        }
    }
    *h->corrected = 1;
    if (adapt) {
        use_pending(m, h, effect);
        begin_pass(m, at, h);
    }
    return likelihood;
}

/* --- prediction --- */

/* Return the decay factor over a step for a time constant of the bank; `left` keeps it. */
static double left_after(const model *m, double duration, int time, double *left)
{
    if (left[time] == 0.0) {
        left[time] = exponential(-duration / m->constants[time]);
    }
    return left[time];
}

/* Write the auxiliary states' own motion over a step, a+ = D a + noise: D, whose rows begin
 * `stride` numbers apart, and the variances of the noise (added). */
static void write_own_motion(
    const model *m, const hypothesis *h, course *along, int is_rest, long stride, double *D,
    double *added)
{
    const double duration = along->steps[is_rest].duration;
    double *left = along->left[is_rest];
    const double torque = left_after(m, duration, FORCE_TIME, left);
    D[0] = torque;
    added[0] = along->forgotten * duration;
    for (long i = 0; *h->kind == FORCE && m->s.n + i < states_in_use(m, h); i++) {
        const double size = *h->size * m->force[i];
        D[i * (stride + 1)] = torque;
        added[i] += size * size * (1.0 - torque * torque);
    }
    if (*h->kind == TONE) {
        const double decay = left_after(m, duration, TONE_TIME, left);
        for (long i = 1; m->s.n + i < states_in_use(m, h); i += 3) {
            const double frequency = h->x[m->s.n + i + 2], wander = halfway_from(m, frequency);
            double sin, cos, *row = D + i * stride + i;
            sine_and_cosine(frequency * duration, &sin, &cos);
            row[0] = row[stride + 1] = decay * cos;
            row[1] = decay * sin;
            row[stride] = -(decay * sin);
            row[2 * stride + 2] = 1.0;
            added[i] = added[i + 1] = *h->size * *h->size * (1.0 - decay * decay);
            added[i + 2] = wander * wander * duration / m->constants[TONE_TIME];
        }
    } else if (*h->kind == COLOURED_NOISE || *h->kind == DRIFT) {
        const int is_drift = *h->kind == DRIFT;
        const double size = *h->size;
        const double decay = left_after(m, duration, is_drift ? DRIFT_TIME : COLOUR_TIME, left);
        const double noise = size * size * (1.0 - decay * decay);
        for (long j = 0; j < m->s.p; j++) {
            D[(j + 1) * (stride + 1)] = decay;
            added[j + 1] = noise * m->R[j * (m->s.p + 1)];
        }
    }
}

/* Propagate the regressors and, unless simple, the covariance of the states in use by F. */
static inline void move_by(
    const model *m, const double *F, const flow_step *step, hypothesis *h, int simple,
    work *scratch, long used)
{
    const long n = m->s.n, width = m->s.width;
    double few[FEW], *moved = used <= FEW ? few : scratch->moved;
    for (long a = 0; a < m->s.k; a++) {
        double *row = h->sensitivity + a * width;
        for (long i = 0; i < used; i++) {
            moved[i] = dot(F + i * used, row, used);
        }
        for (long i = 0; i < used; i++) {
            row[i] = i < n ? moved[i] + step->effects[a * n + i] : moved[i];
        }
    }
    if (!simple) {
        congruence(F, h->covariance, width, step->Q, n, scratch->half, used);
    }
}

/* Take a step with signals u: propagate x, the regressors and, unless simple, the covariance, by
 *
 *     F = [J g e'; 0 D]
 *
 * for design's and auxiliary states. g is the effect of the first auxiliary state, the unknown
 * torque. FORCE adds that of the second on an arm's link: half a kick at each end of the step. */
static void step_hypothesis(
    const model *m, hypothesis *h, course *along, int is_rest, double *u, int simple, work *scratch)
{
    const linear_step *over = &along->steps[is_rest];
    const flow_step *step = &along->work;
    const long n = m->s.n, k = m->s.k, width = m->s.width;
    const long used = simple ? n : states_in_use(m, h), count = used - n;
    const double *F = count > 0 ? scratch->map : step->J;
    double *moved = scratch->moved, *added = scratch->added, *map = scratch->map;
    const int is_at_link = count > 1 && *h->kind == FORCE;
    const double half = 0.5 * over->duration;
    if (count > 0 && m->s.m > 0) {
        u[0] += h->x[n];
    }
    if (is_at_link) {
        h->x[1] += half * h->x[n + 1];
    }
    take_step(&m->design_flow, over, h->x, h->theta, u, k > 0 || !simple, step);
    if (is_at_link) {
        h->x[1] += half * h->x[n + 1];
    }
    if (count > 0) {
        const long corner = n * (used + 1);
        memset(map, 0, (size_t)(used * used) * sizeof *map);
        memset(added, 0, (size_t)count * sizeof *added);
        copy_matrix(step->J, n, map, used, n, n);
        for (long i = 0; i < n; i++) {
            map[i * used + n] = step->effects[k * n + i];
            if (is_at_link) {
                map[i * used + n + 1] = half * (step->J[i * n + 1] + (i == 1));
            }
        }
        write_own_motion(m, h, along, is_rest, used, map + corner, added);
        for (long i = 0; i < count; i++) {
            moved[i] = dot(map + corner + i * used, h->x + n, count);
        }
        for (long i = 1; *h->kind == TONE && i < count; i += 3) {
            double *row = map + corner + i * used; /* a higher frequency turns it further */
            row[i + 2] = over->duration * moved[i + 1];
            row[used + i + 2] = -(over->duration * moved[i]);
        }
        memcpy(h->x + n, moved, (size_t)count * sizeof *moved);
    }
    WITH_SIZE(used, move_by, m, F, step, h, simple, scratch)
    for (long i = 0; i < count; i++) {
        h->covariance[(n + i) * (width + 1)] += added[i];
    }
}

/* Let the excitation fade, and let Gamma grow, but no variance beyond its prior. */
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

/* The last step may be up to STRETCH periods long, as stamps jitter. */
#define STRETCH 1.25
course course_over(const model *m, double duration, double forgotten, work *scratch)
{
    const flow *f = &m->design_flow;
    const flow_sizes sizes = flow_sizes_of(m->flow_record);
    const double period = *m->period;
    course along = {duration, forgotten, .work = flow_step_view(&sizes, scratch->flow)};
    along.whole = (int64_t)floor(duration / period);
    double rest = duration - (double)along.whole * period;
    if (rest < 0.0 || (along.whole > 0 && 0.0 < rest && rest <= (STRETCH - 1.0) * period)) {
        along.whole -= 1;
        rest += period;
    }
    along.steps[0] = (linear_step){period, f->phi, f->gamma, f->noise};
    if (rest > 0.0) {
        along.steps[1] = other_step(f, rest, &along.work);
    }
    return along;
}

void predict_hypothesis(
    const model *m, const state *at, hypothesis *h, course *along, int simple, work *scratch)
{
    const flow *f = &m->design_flow;
    const double duration = along->duration;
    const int is_late = m->s.past > 0 && isfinite(at->past[1]);
    double *u = scratch->inputs;
    for (int64_t taken = 0; taken < along->whole + (along->steps[1].duration > 0.0); taken++) {
        const int is_rest = taken == along->whole;
        memcpy(u, at->held, (size_t)m->s.m * sizeof *u);
        if (is_late) { /* the torque that reaches the motor in this step */
            u[0] = mean_torque(
                m, at, (double)taken * *m->period, along->steps[is_rest].duration);
        }
        if (*m->gain_mode == GAIN_OPEN) { /* the newest samples are signals, too */
            memcpy(u + m->s.m, at->sample, (size_t)m->s.p * sizeof *u);
            memcpy(u + m->s.m + m->s.p, at->sample, (size_t)m->s.p * sizeof *u);
        }
        step_hypothesis(m, h, along, is_rest, u, simple, scratch);
    }
    if ((*h->kind == IMPERFECT || *h->kind == TONE) && !simple) {
        /* The rest of a tone moves the arm's estimate, but less than IMPERFECT's wrong model. */
        const double imperfection = m->constants[IMPERFECTION];
        const double more = ((*h->kind == TONE ? sqrt(sqrt(imperfection)) : imperfection) - 1.0)
                            * (duration / *m->period);
        const double half = *f->kind == KIND_SYSTEM ? 2.0 : 1.0;
        /* In a long gap the design does not explain the motor, either. */
        const int is_known = along->forgotten == 0.0 || duration < 8.0 * *m->period;
        const int only_link = *m->explains_motor != 0 && *h->kind == IMPERFECT && is_known;
        const long moved = only_link ? 2 : m->s.plant; /* the link's states, or all */
        for (long i = 0; i < moved; i++) {
            add_scaled(h->covariance + i * m->s.width, half * more, f->noise + i * m->s.n, moved);
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

/* pi/2. At v = 0, v / sqrt(v^2 + pi/2) has the slope of the mean sign of a variable of N(v, 1). */
static const double HALF_PI = 1.5707963267948966;

/* Slow a velocity with a normal distribution by Coulomb friction over half a step.
 *
 * The mean changes by `change` times that of the velocity's sign, but not beyond rest. Deviations
 * shrink by the slope of that mean (statistical linearisation), implicitly, as it may be steep. */
static void rub(double change, long place, long n, long width, double *x, double *P)
{
    const double variance = P[place * width + place];
    if (!(change > 0.0) || !(variance > 0.0)) {
        return;
    }
    const double root = sqrt(x[place] * x[place] + HALF_PI * variance);
    const double slope = 1.0 / (1.0 + change * HALF_PI * variance / (root * root * root));
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
            course along = course_over(m, 2.0 * half, 0.0, scratch);
            predict_hypothesis(m, at, &h, &along, 0, scratch);
            rub(half * options->motor_friction, MOTOR_VELOCITY, n, width, h.x, h.covariance);
            rub(half * options->link_friction, LINK_VELOCITY, n, width, h.x, h.covariance);
        }
    }
}
