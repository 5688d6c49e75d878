/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "kalman.h"

#include <string.h>

#include "matrices.h"
#include "outcomes.h"
#include "trigonometry.h"

#define LINK_VELOCITY 1
#define MOTOR_VELOCITY 3

/* Share of the samples of a window beyond which the covariance starts again if they are left out. */
static const double MOST_LEFT_OUT = 0.6;

/* --- prediction --- */

/* Give half a kick by gravity and by the parameters, and write its Jacobian J.
 *
 * Both accelerations are  -g sin x_1 (the link's) + sum theta_i E_i [x; sin x_1; u + d_m; d_l],  so
 * that dJ/dx has the entries of E, and dJ/dtheta_i is what E_i makes of the signals. */
static void kick(const kalman *of, double duration, double torque, double *x, double *jacobian)
{
    const flow *f = &of->flow;
    const long n = (long)of->sizes.n, k = (long)of->sizes.k, size = n + k;
    const double half = 0.5 * duration, gravity = half * *f->gravity_gain;
    double sine_1, cosine_1, drive = torque, external = 0.0;
    double changes[2];
    sine_and_cosine(x[0], &sine_1, &cosine_1);
    for (long i = 0; i < size; i++) {
        for (long j = 0; j < size; j++) {
            jacobian[i * size + j] = i == j ? 1.0 : 0.0;
        }
    }
    jacobian[LINK_VELOCITY * size] -= gravity * cosine_1;
    for (long j = 0; *f->has_unknown && j < n; j++) {
        drive += f->motor_torque[j] * x[j];
        external += f->link_torque[j] * x[j];
    }
    changes[0] = -gravity * sine_1;
    changes[1] = 0.0;
    for (long side = 0; side < 2; side++) {
        double *row = jacobian + (side == 0 ? LINK_VELOCITY : MOTOR_VELOCITY) * size;
        for (long i = 0; i < k; i++) {
            const double *effects = f->effects + i * EFFECTS, *by_x = effects + 4 * side;
            const double by_sine = effects[LINK_SINE + side];
            const double by_torque = effects[LINK_TORQUE + side];
            const double by_external = effects[LINK_EXTERNAL + side];
            const double share = half * x[n + i];
            double push = by_sine * sine_1 + by_torque * drive + by_external * external;
            for (long j = 0; j < 4; j++) {
                push += by_x[j] * x[j];
                row[j] += share * by_x[j];
            }
            row[0] += share * by_sine * cosine_1;
            for (long j = 4; *f->has_unknown && j < n; j++) {
                row[j] += share * (by_torque * f->motor_torque[j] + by_external * f->link_torque[j]);
            }
            row[n + i] = half * push;
            changes[side] += share * push;
        }
    }
    x[LINK_VELOCITY] += changes[0];
    x[MOTOR_VELOCITY] += changes[1];
}

/* Take the linear flow, x <- Phi x + Gamma u for [x; w], while theta stays; write its Jacobian and
 * what it adds to the covariance, to the variance of each theta `wander`. */
static void drift(
    const kalman *of, const double *phi, const double *gamma, const double *noise, double wander,
    double torque, double *x)
{
    const kalman_scratch *s = &of->scratch;
    const long n = (long)of->sizes.n, size = kalman_states(&of->sizes);
    for (long i = 0; i < size; i++) {
        for (long j = 0; j < size; j++) {
            const int inner = i < n && j < n;
            s->jacobian[i * size + j] = inner ? phi[i * n + j] : (i == j ? 1.0 : 0.0);
            s->added[i * size + j] = inner ? noise[i * n + j] : (i == j ? wander : 0.0);
        }
    }
    for (long i = 0; i < n; i++) {
        double total = gamma[i] * torque;
        for (long j = 0; j < n; j++) {
            total += phi[i * n + j] * x[j];
        }
        s->cross[i] = total;
    }
    memcpy(x, s->cross, (size_t)n * sizeof *x);
}

/* Write J P J' + added, or none if NULL, into P. */
static void spread(const kalman *of, const double *added, double *P)
{
    const kalman_scratch *s = &of->scratch;
    const long size = kalman_states(&of->sizes);
    congruence(s->jacobian, size, P, size, added, s->product, P, size, size, size);
}

/* Move the states and their covariance over a time [s]: half a kick, the linear flow, half a kick
 * in each step. */
static void move(const kalman *of, double duration, double torque, double *x, double *P)
{
    const flow *f = &of->flow;
    const kalman_scratch *s = &of->scratch;
    double rest;
    const int64_t whole = cut_into_steps(duration, *f->period, &rest);
    for (int64_t step = 0; step <= whole; step++) {
        const int nominal = step < whole;
        const double length = nominal ? *f->period : rest;
        if (!(length > 0.0)) {
            return;
        }
        if (!nominal) {
            flow_over(f->series, (long)*f->terms, *f->reach, length, s->phi, s->gamma, s->noise,
                      s->over, (long)of->sizes.n, 1);
        }
        kick(of, length, torque, x, s->jacobian);
        spread(of, NULL, P);
        /* In a step that is not nominal the parameters do not wander. */
        drift(of, nominal ? f->phi : s->phi, nominal ? f->gamma : s->gamma,
              nominal ? f->noise : s->noise, nominal ? *of->model.wander * length : 0.0, torque, x);
        spread(of, s->added, P);
        kick(of, length, torque, x, s->jacobian);
        spread(of, NULL, P);
    }
}

/* --- correction --- */

/* What became of a sample's outputs. */
typedef struct {
    int64_t *codes;
    double *innovations, *expected;
} report;

/* Return the variance C P C' + R of an output's innovation; write P C' and the innovation. */
static double expect(
    const kalman *of, const double *x, const double *P, double y, long output, double *innovation)
{
    const long size = kalman_states(&of->sizes);
    const double *C = of->model.output + output * size;
    double variance = of->model.variances[output];
    *innovation = y;
    for (long i = 0; i < size; i++) {
        of->scratch.cross[i] = dot(P + i * size, C, size);
        variance += C[i] * of->scratch.cross[i];
        *innovation -= C[i] * x[i];
    }
    return variance;
}

/* Hold each output against the gate, and return whether none is to be used. */
static int examine(
    const kalman *of, const double *x, const double *P, const double *y, const report *to)
{
    int none = 1;
    for (long j = 0; j < (long)of->sizes.p; j++) {
        to->codes[j] = NON_FINITE;
        to->innovations[j] = to->expected[j] = (double)NAN;
        if (isfinite(y[j])) {
            to->expected[j] = sqrt(expect(of, x, P, y[j], j, &to->innovations[j]));
            to->codes[j] =
                fabs(to->innovations[j]) > *of->model.gate * to->expected[j] ? GATED : USED;
            none = none && to->codes[j] != USED;
        }
    }
    return none;
}

/* Correct by those outputs that passed the gate, one after the other:
 * x <- x + P C' r / s,  P <- P - P C' C P / s. */
static void take_in(
    const kalman *of, double *x, double *P, const double *y, const int64_t *codes)
{
    const long size = kalman_states(&of->sizes);
    const double *cross = of->scratch.cross;
    for (long output = 0; output < (long)of->sizes.p; output++) {
        double innovation, variance;
        if (codes[output] != USED) {
            continue;
        }
        variance = expect(of, x, P, y[output], output, &innovation);
        for (long i = 0; i < size; i++) {
            x[i] += cross[i] / variance * innovation;
            for (long j = 0; j < size; j++) {
                P[i * size + j] -= cross[i] * cross[j] / variance;
            }
        }
    }
}

/* Return the place in the ring of a state by its age order; that of one before the oldest too. */
static int64_t slot_of(const kalman *of, int64_t place)
{
    return (*of->memory.first + place + of->sizes.ring) % of->sizes.ring;
}

/* Return the bytes that say which samples of the window were left out at a state of the ring. */
static unsigned char *window_of(const kalman *of, int64_t slot)
{
    return (unsigned char *)(of->memory.left_out + slot * ((of->sizes.window + 7) / 8));
}

/* Note in a state's window whether its sample was left out, and return whether most were. */
static int most_are_out(const kalman *of, int64_t slot, int is_out)
{
    const int64_t window = of->sizes.window;
    unsigned char *left_out = window_of(of, slot);
    int64_t *seen = of->memory.seen + slot, gone = 0;
    left_out[*seen % window] = (unsigned char)is_out;
    *seen += 1;
    for (int64_t i = 0; i < window; i++) {
        gone += left_out[i];
    }
    return *seen >= window && (double)gone > MOST_LEFT_OUT * (double)window;
}

/* Start the covariance of a state, and its window. */
static void start_covariance(const kalman *of, int64_t slot)
{
    const size_t size = (size_t)kalman_states(&of->sizes);
    memcpy(of->memory.P + (size_t)slot * size * size, of->model.initial,
           size * size * sizeof(double));
    memset(window_of(of, slot), 0, (size_t)of->sizes.window);
    of->memory.seen[slot] = 0;
}

/* Begin a state at x = 0, or at that after the newest sample, moved to a stamp. Return its place in
 * the ring, and write the torque that is held. */
static int64_t begin(const kalman *of, int64_t stamp, double *torque)
{
    const kalman_memory *m = &of->memory;
    const size_t size = (size_t)kalman_states(&of->sizes), p = (size_t)of->sizes.p;
    const size_t last = (size_t)slot_of(of, *m->length - 1);
    const int64_t slot = slot_of(of, *m->length);
    double *x = m->x + (size_t)slot * size, *P = m->P + (size_t)slot * size * size;
    *torque = 0.0;
    if (*m->length == 0 || stamp - m->stamps[last] > *of->model.restart_after) {
        *m->length = 0;
        memset(m->x + (size_t)*m->first * size, 0, size * sizeof *x);
        start_covariance(of, *m->first);
        return *m->first;
    }
    *torque = m->samples[last * (p + 1) + p];
    memcpy(x, m->x + last * size, size * sizeof *x);
    memcpy(P, m->P + last * size * size, size * size * sizeof *P);
    memcpy(window_of(of, slot), window_of(of, (int64_t)last), (size_t)of->sizes.window);
    m->seen[slot] = m->seen[last];
    move(of, (double)(stamp - m->stamps[last]) / 1e9, *torque, x, P);
    return slot;
}

/* Predict to a sample from the newest state, correct by what is near enough, and remember. `sample`
 * has the outputs and the torque. Return whether it was used. */
static int64_t correct_by(const kalman *of, int64_t stamp, const double *sample, const report *to)
{
    const kalman_memory *m = &of->memory;
    const size_t size = (size_t)kalman_states(&of->sizes), p = (size_t)of->sizes.p;
    double torque;
    const int64_t slot = begin(of, stamp, &torque);
    double *x = m->x + (size_t)slot * size, *P = m->P + (size_t)slot * size * size;
    double *kept = m->samples + (size_t)slot * (p + 1);
    const int is_out = examine(of, x, P, sample, to);
    if (most_are_out(of, slot, is_out)) {
        start_covariance(of, slot);
    } else if (!is_out) {
        take_in(of, x, P, sample, to->codes);
    }
    memcpy(kept, sample, p * sizeof *kept);
    kept[p] = isfinite(sample[p]) ? sample[p] : torque;
    m->stamps[slot] = stamp;
    *m->length += 1;
    if (*m->length == of->sizes.ring) {
        *m->first = (*m->first + 1) % of->sizes.ring;
        *m->length -= 1;
    }
    return is_out ? GATED : USED;
}

/* Return why a sample is refused, or USED; write how many states there are after it. */
static int64_t judge(
    const kalman *of, int64_t stamp, const double *y, int64_t now, int64_t *later)
{
    const kalman_memory *m = &of->memory;
    const int64_t length = *m->length, newest = m->stamps[slot_of(of, length - 1)];
    *later = 0;
    while (*later < length && m->stamps[slot_of(of, length - 1 - *later)] > stamp) {
        *later += 1;
    }
    if (!has_finite(y, (long)of->sizes.p)) {
        return NON_FINITE;
    }
    if (stamp <= 0) {
        return ZERO_STAMP;
    }
    if (stamp - *of->model.future_tolerance > now) {
        return FROM_FUTURE;
    }
    if (*later < length && m->stamps[slot_of(of, length - 1 - *later)] == stamp) {
        return DUPLICATE;
    }
    /* Before a ring that has turned there were others, which it does not remember. */
    if (*later > 0 &&
        ((*later == length && *m->first != 0) || newest - stamp > *of->model.history)) {
        return TOO_OLD;
    }
    return USED;
}

/* Use a sample in its place, and those after it again. Return its outcome. */
static int64_t use(const kalman *of, const kalman_samples *samples, long sample, int64_t now)
{
    const kalman_memory *m = &of->memory;
    const kalman_scratch *s = &of->scratch;
    const long p = (long)of->sizes.p;
    const report own = {samples->codes + sample * p, samples->innovations + sample * p,
                        samples->expected + sample * p};
    const report again = {s->codes, s->innovations, s->expected};
    double *hand = s->samples, *next = hand + p + 1;
    int64_t stamp = samples->stamps[sample], slot, later;
    const double *y = samples->y + sample * p;
    const int64_t refused = judge(of, stamp, y, now, &later);
    int64_t outcome = refused;
    for (long j = 0; refused != USED && j < p; j++) {
        own.codes[j] = refused;
    }
    if (refused != USED) {
        return refused;
    }
    memcpy(hand, y, (size_t)p * sizeof *hand);
    hand[p] = samples->u[sample];
    *m->rewinds += later > 0;
    *m->length -= later;
    slot = slot_of(of, *m->length);
    for (int64_t i = 0; i <= later; i++) {
        /* What is in hand takes the place of the next one, or one before if the ring restarts. */
        const int64_t next_stamp = m->stamps[slot];
        double *const free = hand;
        int64_t code;
        memcpy(next, m->samples + slot * (p + 1), (size_t)(p + 1) * sizeof *next);
        code = correct_by(of, stamp, hand, i == 0 ? &own : &again);
        outcome = i == 0 ? code : outcome;
        slot = (slot + 1) % of->sizes.ring;
        stamp = next_stamp;
        hand = next;
        next = free;
    }
    return outcome;
}

/* --- estimates --- */

/* Return the square root of a variance, NaN of one below zero. */
static double deviation(double variance)
{
    return variance >= 0.0 ? sqrt(variance) : (double)NAN;
}

long kalman_row_size(const kalman_sizes *s)
{
    return (long)(2 * (4 + s->reads + s->k) + KALMAN_CONDITIONS + 2);
}

/* Write an estimate; return whether its states and disturbances are finite. */
static int write_estimate(const kalman *of, double age, double *row)
{
    const double *x = of->scratch.x, *P = of->scratch.P;
    const long n = (long)of->sizes.n, k = (long)of->sizes.k, size = n + k;
    const long reads = (long)of->sizes.reads, width = kalman_row_size(&of->sizes);
    double *read = row + 8, *theta = read + 2 * reads;
    for (long i = 0; i < 4; i++) {
        row[i] = of->model.scale[i] * x[i];
        row[4 + i] = of->model.scale[i] * deviation(P[i * size + i]);
    }
    for (long a = 0; a < reads; a++) {
        const double *reader = of->model.read + a * size;
        read[a] = dot(reader, x, size);
        read[reads + a] = deviation(quadratic(P, size, reader, size));
    }
    for (long i = 0; i < k; i++) {
        theta[i] = x[n + i];
        theta[k + i] = deviation(P[(n + i) * size + n + i]);
    }
    memcpy(theta + 2 * k, of->model.conditions, KALMAN_CONDITIONS * sizeof *row);
    row[width - 2] = fabs(row[0]) <= *of->model.x_max ? 1.0 : 0.0;
    row[width - 1] = age;
    return is_finite(row, 8 + 2 * reads);
}

/* Estimate at a stamp, from the newest state that is not after it, and return the stamp of the
 * newest sample; 0 without an estimate. After one that is not finite what follows starts over. */
static int64_t estimate(const kalman *of, int64_t stamp, double *row)
{
    const kalman_memory *m = &of->memory;
    const kalman_scratch *s = &of->scratch;
    const size_t size = (size_t)kalman_states(&of->sizes);
    int64_t place = *m->length - 1, slot;
    double age;
    while (place >= 0 && m->stamps[slot_of(of, place)] > stamp) {
        place--;
    }
    slot = slot_of(of, place);
    if (place < 0 || stamp - m->stamps[slot] > *of->model.restart_after) {
        return 0;
    }
    age = (double)(stamp - m->stamps[slot]) / 1e9;
    memcpy(s->x, m->x + (size_t)slot * size, size * sizeof *s->x);
    memcpy(s->P, m->P + (size_t)slot * size * size, size * size * sizeof *s->P);
    move(of, age, m->samples[slot * (of->sizes.p + 1) + of->sizes.p], s->x, s->P);
    if (!write_estimate(of, age, row)) {
        *m->length = 0;
        *m->failures += 1;
        return 0;
    }
    return m->stamps[slot_of(of, *m->length - 1)];
}

void kalman_advance(
    const kalman *of, const kalman_ticks *ticks, long count, const kalman_samples *samples)
{
    const long width = kalman_row_size(&of->sizes);
    int64_t begun = 0;
    for (long tick = 0; tick < count; tick++) {
        const int64_t end = ticks->ends[tick], reset = ticks->resets[tick];
        for (int64_t sample = begun; sample < end; sample++) {
            if (sample == reset) {
                *of->memory.length = 0;
            }
            if (samples->outcomes[sample] >= 0) {
                samples->outcomes[sample] = use(of, samples, (long)sample, ticks->now[tick]);
            }
        }
        if (reset >= 0 && !(begun <= reset && reset < end)) {
            *of->memory.length = 0;
        }
        begun = end > begun ? end : begun;
        ticks->newest[tick] = estimate(of, ticks->stamps[tick], ticks->rows + tick * width);
    }
}
