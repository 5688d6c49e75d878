/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * One step of a prediction model: an arm, a T-S system or an observer that is integrated.
 */
#include "flow.h"

#include <math.h>
#include <string.h>

#include "matrices.h"
#include "trigonometry.h"

#define MOST 4096 /* of any size, so that no product of sizes overflows */

flow_sizes flow_sizes_of(const double *memory)
{
    const int64_t *counts = (const int64_t *)(const void *)memory;
    flow_sizes s;
    s.n = (long)counts[1];
    s.m = (long)counts[2];
    s.inputs = (long)counts[3];
    s.p = (long)counts[4];
    s.k = (long)counts[5];
    s.plant = (long)counts[6];
    s.rules = (long)counts[7];
    s.premises = (long)counts[8];
    return s;
}

flow flow_view(const double *memory)
{
    const flow_sizes s = flow_sizes_of(memory);
    flow view;
    flow_bind(&view, &s, (double *)memory);
    return view;
}

/* Return whether the sizes in the first counts of a record are possible and belong together. */
static int sizes_are_valid(const int64_t *counts)
{
    const int64_t kind = counts[0], n = counts[1], m = counts[2], inputs = counts[3];
    const int64_t plant = counts[6], rules = counts[7], premises = counts[8];
    for (int place = 1; place < 9; place++) {
        if (counts[place] < 0 || counts[place] > MOST) {
            return 0;
        }
    }
    if (inputs > m || plant > n) {
        return 0;
    }
    switch (kind) {
    case KIND_ARM:
        return n >= 4 && inputs >= 1;
    case KIND_SYSTEM:
        return rules >= 1 && premises >= 1;
    case KIND_INTEGRATED:
        return n >= 2 && rules >= 1 && premises <= counts[4];
    default:
        return 0;
    }
}

int flow_is_valid(const double *memory, size_t length)
{
    flow_sizes s;
    flow f;
    if (length < 12 || !sizes_are_valid((const int64_t *)(const void *)memory)) {
        return 0;
    }
    s = flow_sizes_of(memory);
    if (flow_size(&s) > length) {
        return 0;
    }
    f = flow_view(memory);
    if (*f.kind == KIND_INTEGRATED && !(*f.max_step >= SHORTEST)) {
        return 0;
    }
    return *f.period >= SHORTEST && isfinite(*f.period) && *f.reach >= 0.0 && *f.terms >= 0
           && *f.terms <= SERIES_TERMS;
}

/* --- arms --- */

/* The linear flow over a step: nominal, or of another length. */
typedef struct {
    const double *phi, *turned, *gamma, *noise;
} linear_step;

/* What a kick of half a step sees: the state before it, torques, and the sum of all effects. */
typedef struct {
    const double *before;
    double sin, drive, external, half;
} kick;

/* Return what effects (four by x, the others by place) add to an acceleration in a unit of time. */
static double added(
    const double *by_state, const double *effects, long by_sine, long by_torque, long by_external,
    const kick *now)
{
    return dot(by_state, now->before, 4) + effects[by_sine] * now->sin
           + effects[by_torque] * now->drive + effects[by_external] * now->external;
}

/* Write the sum of all parameters' effects and of gravity's over half a step. */
static void sum_effects(const flow *f, const double *theta, double half, double *total)
{
    for (long place = 0; place < EFFECTS; place++) {
        total[place] = 0.0;
        for (long i = 0; i < *f->k; i++) {
            total[place] += half * (theta[i] * f->effects[i * EFFECTS + place]);
        }
    }
    total[LINK_SINE] -= half * *f->gravity_gain;
}

/* Write J S J' into S, for J = I + the two kicks as rows of x_2 and x_4. */
static void shear(long n, const double *kicks, double *changes, double *S)
{
    const double *link = kicks, *motor = kicks + n;
    double *at_link = S + n, *at_motor = S + 3 * n;
    double corner, both;
    multiply(kicks, S, changes, 2, n, n);
    for (long j = 0; j < n; j++) {
        at_link[j] += changes[j];
        at_motor[j] += changes[n + j];
    }
    /* Of the columns only what is in these rows is not known yet, as S is symmetric. */
    corner = dot(link, at_link, n);
    both = dot(link, at_motor, n);
    at_motor[3] += dot(motor, at_motor, n);
    at_link[1] += corner;
    at_motor[1] += both;
    at_link[3] = at_motor[1];
    for (long j = 0; j < n; j++) {
        S[j * n + 3] = at_motor[j];
    }
    for (long j = 0; j < n; j++) {
        S[j * n + 1] = at_link[j];
    }
}

/* Kick both velocities by gravity and by theta for half a step, the regressor and the covariance
 * with them, by the Jacobian of the kick. */
static void kick_arm(
    const flow *f, const double *total, double torque, double half, int with_covariance,
    const tangents *along, flow_scratch *work)
{
    const long n = *f->n, k = *f->k;
    double *x = work->stack, *link = work->kicks, *motor = work->kicks + n;
    const double before[4] = {x[0], x[1], x[2], x[3]};
    kick now = {before, 0.0, torque, 0.0, half};
    double cos;
    sine_and_cosine(x[0], &now.sin, &cos);
    if (*f->has_unknown) {
        /* What theta does to the known torque, it does to its unknown part. */
        now.drive += dot(f->motor_torque, x, n);
        now.external = dot(f->link_torque, x, n);
    }
    x[1] += added(total, total, LINK_SINE, LINK_TORQUE, LINK_EXTERNAL, &now);
    x[3] += added(total + 4, total, MOTOR_SINE, MOTOR_TORQUE, MOTOR_EXTERNAL, &now);
    memcpy(link, total, 4 * sizeof *link);
    memcpy(motor, total + 4, 4 * sizeof *motor);
    link[0] += total[LINK_SINE] * cos;
    motor[0] += total[MOTOR_SINE] * cos;
    for (long j = 4; j < n; j++) {
        const double share = f->motor_torque[j], other = f->link_torque[j];
        link[j] = total[LINK_TORQUE] * share + total[LINK_EXTERNAL] * other;
        motor[j] = total[MOTOR_TORQUE] * share + total[MOTOR_EXTERNAL] * other;
    }
    for (long i = 0; i < k; i++) {
        const double *effect = f->effects + i * EFFECTS;
        double *row = work->stack + (i + 1) * n;
        const double on_link = dot(link, row, n), on_motor = dot(motor, row, n);
        row[1] += on_link
                  + half * added(effect, effect, LINK_SINE, LINK_TORQUE, LINK_EXTERNAL, &now);
        row[3] += on_motor
                  + half
                        * added(
                            effect + 4, effect, MOTOR_SINE, MOTOR_TORQUE, MOTOR_EXTERNAL, &now);
    }
    for (long i = 0; i < along->count; i++) {
        double *row = work->stack + (1 + k + i) * n;
        const double on_link = dot(link, row, n), on_motor = dot(motor, row, n);
        row[1] += on_link + total[LINK_TORQUE] * along->drives[i];
        row[3] += on_motor + total[MOTOR_TORQUE] * along->drives[i];
    }
    if (with_covariance) {
        shear(n, work->kicks, work->changes, work->covariance);
    }
}

/* Write Phi S Phi' + Q into S. */
static void carry(long n, const linear_step *step, flow_scratch *work)
{
    double *half = work->squares, *whole = half + n * n, *S = work->covariance;
    multiply(step->phi, S, half, n, n, n);
    multiply(half, step->turned, whole, n, n, n);
    for (long i = 0; i < n; i++) {
        for (long j = i; j < n; j++) {
            S[i * n + j] = S[j * n + i] = whole[i * n + j] + step->noise[i * n + j];
        }
    }
}

/* Kick both velocities by gravity and by theta, take the linear flow, and kick again. */
static void step_arm(
    const flow *f, const linear_step *step, const double *theta, double torque, double duration,
    int with_covariance, const tangents *along, flow_scratch *work)
{
    const long n = *f->n, k = *f->k, rows = k + 1 + along->count;
    const double half = 0.5 * duration;
    double total[EFFECTS];
    sum_effects(f, theta, half, total);
    kick_arm(f, total, torque, half, with_covariance, along, work);
    if (with_covariance) {
        carry(n, step, work);
    }
    multiply(work->stack, step->turned, work->moved, rows, n, n);
    memcpy(work->stack, work->moved, (size_t)(rows * n) * sizeof *work->stack);
    for (long j = 0; j < n; j++) {
        const double by_torque = step->gamma[j * *f->inputs];
        work->stack[j] += by_torque * torque;
        for (long i = 0; i < along->count; i++) {
            work->stack[(1 + k + i) * n + j] += by_torque * along->drives[i];
        }
    }
    kick_arm(f, total, torque, half, with_covariance, along, work);
}

/* --- T-S systems --- */

/* Add one rule's part of what enters x, and of its Jacobian as far as its weight does not change:
 * (D + sum of theta times directions) [x; u]. */
static void enter_rule(
    const flow *f, long rule, const double *theta, const double *signal, double weight,
    double *each, double *rate, double *jacobian)
{
    const long n = *f->n, plant = *f->plant, signals = plant + *f->inputs;
    for (long i = 0; i < plant; i++) {
        const long row = (rule * plant + i) * signals;
        double total = 0.0;
        for (long j = 0; j < signals; j++) {
            double entry = f->deviations[row + j];
            for (long p = 0; p < *f->k; p++) {
                entry += theta[p] * f->directions[p * *f->rules * plant * signals + row + j];
            }
            total += entry * signal[j];
            if (j < plant) {
                jacobian[i * n + j] += weight * entry;
            }
        }
        each[i] = total;
        rate[i] += weight * total;
    }
}

/* Add to the Jacobian what the weights of the rules change by. */
static void turn_weights(
    const flow *f, const double *slopes, const double *each, double *turning, double *jacobian)
{
    const long n = *f->n, plant = *f->plant, premises = *f->premises;
    for (long rule = 0; rule < *f->rules; rule++) {
        for (long j = 0; j < plant; j++) {
            turning[j] = 0.0;
            for (long q = 0; q < premises; q++) {
                turning[j] += slopes[rule * premises + q] * f->premise[q * plant + j];
            }
        }
        for (long i = 0; i < plant; i++) {
            for (long j = 0; j < plant; j++) {
                jacobian[i * n + j] += each[rule * plant + i] * turning[j];
            }
        }
    }
}

/* Write what enters x (`rate`) and Y (`entering`) besides the linear flow, and its Jacobian. */
static void enter(
    const flow *f, const double *x, const double *upsilon, long rows, const double *theta,
    const double *u, double *rate, double *entering, double *jacobian, flow_scratch *work)
{
    const long n = *f->n, k = *f->k, rules = *f->rules, premises = *f->premises;
    const long plant = *f->plant, inputs = *f->inputs, signals = plant + inputs;
    const long scheduled = *f->m - inputs;
    double *signal = work->signals;
    memcpy(signal, x, (size_t)plant * sizeof *signal);
    memcpy(signal + plant, u, (size_t)inputs * sizeof *signal);
    for (long j = 0; j < premises; j++) {
        work->premises[j] = dot(f->premise + j * plant, x, plant)
                            + dot(f->schedule + j * scheduled, u + inputs, scheduled);
    }
    rule_weights_and_slopes(
        f->shapes, f->parameters, work->premises, work->weights, work->slopes, rules, premises);
    memset(rate, 0, (size_t)n * sizeof *rate);
    memset(jacobian, 0, (size_t)(n * n) * sizeof *jacobian);
    for (long rule = 0; rule < rules; rule++) {
        enter_rule(
            f, rule, theta, signal, work->weights[rule], work->rates + rule * plant, rate,
            jacobian);
    }
    turn_weights(f, work->slopes, work->rates, work->vectors + 5 * n, jacobian);
    for (long p = 0; p < rows; p++) {
        apply(jacobian, upsilon + p * n, entering + p * n, n, n);
        for (long rule = 0; p < k && rule < rules; rule++) {
            const double *direction = f->directions + (p * rules + rule) * plant * signals;
            for (long i = 0; i < plant; i++) {
                entering[p * n + i]
                    += work->weights[rule] * dot(direction + i * signals, signal, signals);
            }
        }
    }
}

/* Move the covariance by the error's map over a step of a T-S system, with Jacobians N1, N2:
 * e+ = Phi [Phi + T N2 Phi (I + (T/2) N1)] e + Phi (I + T N2) n1 + n2. Overwrites both. */
static void carry_system(
    long n, const linear_step *step, double duration, double *N1, double *N2, flow_scratch *work)
{
    double *inner = work->squares + 2 * n * n, *outer = inner + n * n;
    for (long i = 0; i < n; i++) {
        for (long j = 0; j < n; j++) {
            N1[i * n + j] *= 0.5 * duration;
            N2[i * n + j] *= duration;
        }
        N1[i * n + i] += 1.0;
    }
    multiply(step->phi, N1, inner, n, n, n);
    multiply(N2, inner, outer, n, n, n);
    for (long i = 0; i < n; i++) {
        for (long j = 0; j < n; j++) {
            outer[i * n + j] += step->phi[i * n + j];
        }
        N2[i * n + i] += 1.0;
    }
    multiply(step->phi, outer, inner, n, n, n);
    multiply(step->phi, N2, outer, n, n, n);
    congruence(outer, n, step->noise, n, step->noise, N1, N2, n, n, n);
    congruence(inner, n, work->covariance, n, N2, N1, work->covariance, n, n, n);
}

/* Take the exponential midpoint step: what enters is evaluated in the middle, which half a step
 * from the start leads to; `step` is the linear flow over half a step. */
static void step_system(
    const flow *f, const linear_step *step, const double *theta, const double *u, double duration,
    int with_covariance, long tangent_count, flow_scratch *work)
{
    const long n = *f->n, k = *f->k + tangent_count;
    double *x = work->stack, *upsilon = work->stack + n;
    double *forced = work->vectors, *coasted = forced + n, *rate = coasted + n;
    double *middle = rate + n, *turned = middle + n;
    double *carried = work->rows, *half_way = carried + k * n, *entering = half_way + k * n;
    double *first = work->squares, *second = first + n * n;
    apply(step->gamma, u, forced, n, *f->inputs);
    apply(step->phi, x, coasted, n, n);
    for (long p = 0; p < k; p++) {
        apply(step->phi, upsilon + p * n, carried + p * n, n, n);
    }
    for (long j = 0; j < n; j++) {
        coasted[j] += forced[j];
    }
    /* First at the start, for half a step. */
    enter(f, x, upsilon, k, theta, u, rate, entering, first, work);
    apply(step->phi, rate, turned, n, n);
    for (long j = 0; j < n; j++) {
        middle[j] = coasted[j] + 0.5 * duration * turned[j];
    }
    for (long p = 0; p < k; p++) {
        apply(step->phi, entering + p * n, turned, n, n);
        for (long j = 0; j < n; j++) {
            half_way[p * n + j] = carried[p * n + j] + 0.5 * duration * turned[j];
        }
    }
    /* Then in the middle, for the whole. */
    enter(f, middle, half_way, k, theta, u, rate, entering, second, work);
    for (long j = 0; j < n; j++) {
        middle[j] = coasted[j] + duration * rate[j];
    }
    apply(step->phi, middle, x, n, n);
    for (long p = 0; p < k; p++) {
        for (long j = 0; j < n; j++) {
            carried[p * n + j] += duration * entering[p * n + j];
        }
        apply(step->phi, carried + p * n, upsilon + p * n, n, n);
    }
    for (long j = 0; j < n; j++) {
        x[j] += forced[j];
    }
    if (with_covariance) {
        carry_system(n, step, duration, first, second, work);
    }
}

/* --- observers that are integrated --- */

/* Take one step of Runge and Kutta's of x' = matrix x + constant - g sin x_1 in the row of x_2. */
static void step_integrated(
    const double *matrix, const double *constant, double gravity_gain, double h, double *x,
    double *vectors, long n)
{
    double *at = vectors, *start = at + n, *sum_of_slopes = start + n, *slope = sum_of_slopes + n;
    for (long i = 0; i < n; i++) {
        start[i] = at[i] = x[i];
        sum_of_slopes[i] = 0.0;
    }
    for (int stage = 0; stage < 4; stage++) {
        const double share = stage < 2 ? 0.5 * h : h;
        const double weight = stage == 1 || stage == 2 ? 2.0 : 1.0;
        apply(matrix, at, slope, n, n);
        if (gravity_gain != 0.0) {
            slope[1] -= gravity_gain * sine(at[0]);
        }
        for (long i = 0; i < n; i++) {
            slope[i] += constant[i];
            sum_of_slopes[i] += weight * slope[i];
            at[i] = start[i] + share * slope[i];
        }
    }
    for (long i = 0; i < n; i++) {
        x[i] = start[i] + (h / 6.0) * sum_of_slopes[i];
    }
}

/* Integrate x' = sum of h_i(y) (F_i x + Y_i y + U_i u) - g sin x_1 in the row of x_2. */
static void integrate(
    const flow *f, double *x, const double *y, const double *u, double duration,
    flow_scratch *work)
{
    const long n = *f->n, p = *f->p, m = *f->m, rules = *f->rules;
    double *matrix = work->squares, *constant = work->vectors;
    double steps = ceil(duration / *f->max_step - 1e-9);
    rule_weights(f->shapes, f->parameters, y, work->weights, rules, *f->premises);
    memset(constant, 0, (size_t)n * sizeof *constant);
    memset(matrix, 0, (size_t)(n * n) * sizeof *matrix);
    for (long rule = 0; rule < rules; rule++) {
        const double weight = work->weights[rule];
        for (long i = 0; i < n; i++) {
            const long row = rule * n + i;
            constant[i] += weight * (dot(f->Y + row * p, y, p) + dot(f->U + row * m, u, m));
            for (long j = 0; j < n; j++) {
                matrix[i * n + j] += weight * f->F[row * n + j];
            }
        }
    }
    steps = steps > 1.0 ? steps : 1.0;
    for (double step = 0.0; step < steps; step += 1.0) {
        step_integrated(
            matrix, constant, *f->gravity_gain, duration / steps, x, work->vectors + n, n);
    }
}

/* --- all kinds --- */

/* Write the linear flow over a step that is not nominal; a step of a T-S system has two equal
 * halves. */
static linear_step fill_step(
    const flow *f, double duration, int with_covariance, flow_scratch *work)
{
    const linear_step step = {work->phi, work->turned, work->gamma, work->noise};
    const long n = *f->n;
    flow_over(
        f->series, (long)*f->terms, *f->reach, *f->kind == KIND_SYSTEM ? 0.5 * duration : duration,
        work->phi, work->gamma, with_covariance ? work->noise : NULL, work->over, n, *f->inputs);
    for (long i = 0; i < n; i++) {
        for (long j = 0; j < n; j++) {
            work->turned[j * n + i] = work->phi[i * n + j];
        }
    }
    return step;
}

/* Move what is in the scratch by one step. */
static void take_step(
    const flow *f, const linear_step *step, const double *theta, const double *u, double duration,
    int with_covariance, const tangents *along, flow_scratch *work)
{
    if (*f->kind == KIND_ARM) {
        step_arm(f, step, theta, u[0], duration, with_covariance, along, work);
    } else {
        step_system(f, step, theta, u, duration, with_covariance, along->count, work);
    }
}

/* Move what is in the scratch over a time, in nominal steps and a last one. */
static void move(
    const flow *f, const double *theta, const double *u, double duration, int with_covariance,
    const tangents *along, flow_scratch *work)
{
    const linear_step nominal = {f->phi, f->turned, f->gamma, f->noise};
    double rest;
    const int64_t whole = cut_into_steps(duration, *f->period, &rest);
    for (int64_t step = 0; step < whole; step++) {
        take_step(f, &nominal, theta, u, *f->period, with_covariance, along, work);
    }
    if (rest > 0.0) {
        const linear_step last = fill_step(f, rest, with_covariance, work);
        take_step(f, &last, theta, u, rest, with_covariance, along, work);
    }
}

void flow_advance(
    const flow *f, double *x, double *upsilon, double *covariance, long width, tangents *along,
    const double *theta, const double *y, const double *u, double duration, double *scratch)
{
    static const tangents none = {NULL, NULL, 0};
    const tangents *moving = along == NULL ? &none : along;
    const long n = *f->n, k = *f->k;
    const flow_sizes s = {n,     *f->m,     *f->inputs, *f->p,
                          k,     *f->plant, *f->rules,  *f->premises};
    flow_scratch work;
    flow_scratch_bind(&work, &s, scratch);
    if (*f->kind == KIND_INTEGRATED) {
        integrate(f, x, y, u, duration, &work);
        return;
    }
    copy_matrix(x, n, work.stack, n, 1, n);
    copy_matrix(upsilon, width, work.stack + n, n, k, n);
    copy_matrix(moving->rows, n, work.stack + (k + 1) * n, n, moving->count, n);
    if (covariance != NULL) {
        copy_matrix(covariance, width, work.covariance, n, n, n);
    }
    move(f, theta, u, duration, covariance != NULL, moving, &work);
    copy_matrix(work.stack, n, x, n, 1, n);
    copy_matrix(work.stack + n, n, upsilon, width, k, n);
    copy_matrix(work.stack + (k + 1) * n, n, moving->rows, n, moving->count, n);
    if (covariance != NULL) {
        copy_matrix(work.covariance, n, covariance, width, n, n);
    }
}
