/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * One step of a prediction model: an arm, a T-S system or an observer that is integrated.
 *
 * Arms and systems move by the exact flow of their linear part, Phi' = A Phi, Gamma' = A Gamma + B,
 * Q' = A Q + Q A' + W, from Taylor series with precomputed coefficients: a step of any length costs
 * one evaluation of polynomials, which matters because real stamps jitter.
 */
#include "flow.h"

#include <math.h>
#include <string.h>

#include "matrices.h"
#include "trigonometry.h"

flow_sizes flow_sizes_of(const double *memory)
{
    const int64_t *c = (const int64_t *)(const void *)memory;
    const flow_sizes s = {(long)c[1], (long)c[2], (long)c[3], (long)c[4],
                          (long)c[5], (long)c[6], (long)c[7], (long)c[8]};
    return s;
}

flow flow_view(const double *memory)
{
    const flow_sizes s = flow_sizes_of(memory);
    flow view;
    flow_bind(&view, &s, (double *)memory);
    return view;
}

/* --- the linear flow --- */

/* Evaluate polynomials by Horner's rule; rows of `series` begin `width` coefficients apart. */
static void evaluate(
    const double *series, long width, long terms, double step, double *restrict values, long count)
{
    for (long place = 0; place < count; place++) {
        values[place] = 0.0;
    }
    for (long row = terms - 1; row >= 0; row--) {
        const double *restrict coefficients = series + row * width;
        for (long place = 0; place < count; place++) {
            values[place] = values[place] * step + coefficients[place];
        }
    }
}

void flow_over(
    const double *series, long terms, double reach, double duration, double *phi, double *gamma,
    double *noise, double *scratch, long n, long m)
{
    const long squares = n * n, gammas = n * m, width = 2 * squares + gammas;
    double *values = scratch, *turned = values + width, *forced = turned + squares;
    double step = duration;
    long doublings = 0;
    while (step > reach) {
        doublings += 1;
        step *= 0.5;
    }
    evaluate(series, width, terms, step, values, noise != NULL ? width : squares + gammas);
    memcpy(phi, values, (size_t)squares * sizeof *phi);
    memcpy(gamma, values + squares, (size_t)gammas * sizeof *gamma);
    if (noise != NULL) {
        memcpy(noise, values + squares + gammas, (size_t)squares * sizeof *noise);
    }
    for (; doublings > 0; doublings--) {
        multiply(phi, gamma, forced, n, n, m);
        add_scaled(gamma, 1.0, forced, gammas);
        if (noise != NULL) {
            transpose(phi, turned, n);
            congruence(phi, turned, noise, noise, values, n);
        }
        multiply(phi, phi, turned, n, n, n);
        memcpy(phi, turned, (size_t)squares * sizeof *phi);
    }
}

int64_t cut_into_steps(double duration, double period, double *rest)
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
        congruence(
            step->phi, step->turned, work->covariance, step->noise, work->squares, n);
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

/* Write what enters x and Y, `rows` rows, besides the linear flow, and its Jacobian. */
static void enter(
    const flow *f, const double *stack, long rows, const double *theta, const double *u,
    double *entering, double *jacobian, flow_scratch *work)
{
    const long n = *f->n, k = *f->k, rules = *f->rules, premises = *f->premises;
    const long plant = *f->plant, inputs = *f->inputs, signals = plant + inputs;
    const long scheduled = *f->m - inputs;
    double *signal = work->signals;
    memcpy(signal, stack, (size_t)plant * sizeof *signal);
    memcpy(signal + plant, u, (size_t)inputs * sizeof *signal);
    for (long j = 0; j < premises; j++) {
        work->premises[j] = dot(f->premise + j * plant, stack, plant)
                            + dot(f->schedule + j * scheduled, u + inputs, scheduled);
    }
    rule_weights(
        f->shapes, f->parameters, work->premises, work->weights, work->slopes, rules, premises);
    memset(entering, 0, (size_t)n * sizeof *entering);
    memset(jacobian, 0, (size_t)(n * n) * sizeof *jacobian);
    for (long rule = 0; rule < rules; rule++) {
        enter_rule(
            f, rule, theta, signal, work->weights[rule], work->rates + rule * plant, entering,
            jacobian);
    }
    turn_weights(f, work->slopes, work->rates, work->vectors + n, jacobian);
    for (long row = 1; row < rows; row++) {
        double *into = entering + row * n;
        multiply(jacobian, stack + row * n, into, n, n, 1);
        for (long rule = 0; row <= k && rule < rules; rule++) {
            const double *direction = f->directions + ((row - 1) * rules + rule) * plant * signals;
            for (long i = 0; i < plant; i++) {
                into[i] += work->weights[rule] * dot(direction + i * signals, signal, signals);
            }
        }
    }
}

/* Move the covariance by the error's map over a step of a T-S system, with Jacobians N1, N2:
 * e+ = Phi [Phi + T N2 Phi (I + (T/2) N1)] e + Phi (I + T N2) n1 + n2. Overwrites both. */
static void carry_system(
    long n, const linear_step *step, double duration, double *N1, double *N2, flow_scratch *work)
{
    const long squares = n * n;
    double *inner = work->squares + 2 * squares, *outer = inner + squares;
    double *turned = outer + squares, *noise = turned + squares;
    for (long i = 0; i < squares; i++) {
        N1[i] *= 0.5 * duration;
        N2[i] *= duration;
    }
    for (long i = 0; i < n; i++) {
        N1[i * n + i] += 1.0;
    }
    multiply(step->phi, N1, inner, n, n, n);
    multiply(N2, inner, outer, n, n, n);
    add_scaled(outer, 1.0, step->phi, squares);
    for (long i = 0; i < n; i++) {
        N2[i * n + i] += 1.0;
    }
    multiply(step->phi, outer, inner, n, n, n);
    multiply(step->phi, N2, outer, n, n, n);
    /* N1 and N2 are scratch from here on. */
    memcpy(noise, step->noise, (size_t)squares * sizeof *noise);
    transpose(outer, turned, n);
    congruence(outer, turned, noise, step->noise, N1, n);
    transpose(inner, turned, n);
    congruence(inner, turned, work->covariance, noise, N1, n);
}

/* Take the exponential midpoint step: what enters is evaluated in the middle, which half a step
 * from the start leads to; `step` is the linear flow over half a step. */
static void step_system(
    const flow *f, const linear_step *step, const double *theta, const double *u, double duration,
    int with_covariance, long tangent_count, flow_scratch *work)
{
    const long n = *f->n, rows = *f->k + 1 + tangent_count, count = rows * n;
    double *forced = work->vectors, *moved = work->moved;
    double *entering = work->rows, *middle = entering + count;
    double *first = work->squares, *second = first + n * n;
    multiply(step->gamma, u, forced, n, *f->inputs, 1);
    multiply(work->stack, step->turned, moved, rows, n, n);
    add_scaled(moved, 1.0, forced, n);
    /* First at the start, for half a step. */
    enter(f, work->stack, rows, theta, u, entering, first, work);
    multiply(entering, step->turned, middle, rows, n, n);
    for (long i = 0; i < count; i++) {
        middle[i] = moved[i] + 0.5 * duration * middle[i];
    }
    /* Then in the middle, for the whole. */
    enter(f, middle, rows, theta, u, entering, second, work);
    add_scaled(moved, duration, entering, count);
    multiply(moved, step->turned, work->stack, rows, n, n);
    add_scaled(work->stack, 1.0, forced, n);
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
        multiply(matrix, at, slope, n, n, 1);
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
    rule_weights(f->shapes, f->parameters, y, work->weights, NULL, rules, *f->premises);
    memset(constant, 0, (size_t)n * sizeof *constant);
    memset(matrix, 0, (size_t)(n * n) * sizeof *matrix);
    for (long rule = 0; rule < rules; rule++) {
        const double weight = work->weights[rule];
        for (long i = 0; i < n; i++) {
            const long row = rule * n + i;
            constant[i] += weight * (dot(f->Y + row * p, y, p) + dot(f->U + row * m, u, m));
            add_scaled(matrix + i * n, weight, f->F + row * n, n);
        }
    }
    steps = steps > 1.0 ? steps : 1.0;
    for (double step = 0.0; step < steps; step += 1.0) {
        step_integrated(
            matrix, constant, *f->gravity_gain, duration / steps, x, work->vectors + n, n);
    }
}

/* --- all kinds --- */

/* Move what is in the scratch over a time, in nominal steps and a last one. */
static void move(
    const flow *f, const double *theta, const double *u, double duration, int with_covariance,
    const tangents *along, flow_scratch *work)
{
    const linear_step nominal = {f->phi, f->turned, f->gamma, f->noise};
    const linear_step other = {work->phi, work->turned, work->gamma, work->noise};
    const int is_arm = *f->kind == KIND_ARM;
    double rest;
    const int64_t whole = cut_into_steps(duration, *f->period, &rest);
    if (rest > 0.0) {
        /* A step of a T-S system has two equal halves. */
        flow_over(
            f->series, (long)*f->terms, *f->reach, is_arm ? rest : 0.5 * rest, work->phi,
            work->gamma, with_covariance ? work->noise : NULL, work->over, *f->n, *f->inputs);
        transpose(work->phi, work->turned, *f->n);
    }
    for (int64_t taken = 0; taken < whole + (rest > 0.0); taken++) {
        const linear_step *step = taken < whole ? &nominal : &other;
        const double time = taken < whole ? *f->period : rest;
        if (is_arm) {
            step_arm(f, step, theta, u[0], time, with_covariance, along, work);
        } else {
            step_system(f, step, theta, u, time, with_covariance, along->count, work);
        }
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
