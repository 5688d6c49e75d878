/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * One step of a prediction model: an arm or a T-S system.
 *
 * The linear part has an exact flow: Phi' = A Phi, Gamma' = A Gamma + B, Q' = A Q + Q A' + W. Its
 * Taylor series has precomputed coefficients, so that a step of any length costs one evaluation of
 * polynomials. This matters because real stamps jitter.
 */
#include "flow.h"

#include <string.h>

#include "arithmetic.h"

int flow_is_sound(double *memory, size_t length)
{
    const int64_t most = 1000;
    if (length < 1 + FLOW_SIZES) { /* the kind and the sizes */
        return 0;
    }
    const flow_sizes s = flow_sizes_of(memory);
    if (s.n < 1 || s.n > most || s.m < 0 || s.m > most || s.inputs < 0 || s.inputs > s.m || s.k < 0
        || s.k > most || s.plant < 1 || s.plant > s.n || s.rules < 0 || s.rules > most
        || s.premises < 0 || s.premises > most || flow_size(&s) != length) {
        return 0;
    }
    const flow f = flow_view(&s, memory);
    return (*f.kind == KIND_ARM ? s.plant >= 4 && s.inputs >= 1
                                : *f.kind == KIND_SYSTEM && s.rules >= 1 && s.premises >= 1)
           && *f.terms >= 0 && *f.terms <= SERIES_TERMS && *f.reach > 0.0;
}

static const flow_sizes *sizes_of(const flow *f)
{
    return (const flow_sizes *)f->sizes;
}

/* --- the linear flow --- */

linear_step other_step(const flow *f, double duration, const flow_step *work)
{
    const linear_step step = {duration, work->phi, work->gamma, work->noise};
    const long n = sizes_of(f)->n, m = sizes_of(f)->inputs, count = n * (2 * n + m);
    double *phi = work->phi, *gamma = work->gamma, *noise = work->noise, *scratch = work->squares;
    double *all = phi; /* phi, gamma and noise are contiguous */
    double time = *f->kind == KIND_ARM ? duration : 0.5 * duration;
    long doublings = 0;
    for (; time > *f->reach; time *= 0.5) {
        doublings += 1;
    }
    memset(all, 0, (size_t)count * sizeof *all);
    for (long row = *f->terms - 1; row >= 0; row--) { /* Horner's rule */
        const double *restrict coefficients = f->series + row * count;
        for (long place = 0; place < count; place++) {
            all[place] = all[place] * time + coefficients[place];
        }
    }
    for (; doublings > 0; doublings--) {
        multiply(phi, gamma, scratch, n, n, m);
        add_scaled(gamma, 1.0, scratch, n * m);
        congruence(phi, noise, n, noise, n, scratch, n);
        multiply(phi, phi, scratch, n, n, n);
        memcpy(phi, scratch, (size_t)(n * n) * sizeof *phi);
    }
    return step;
}

/* --- arms --- */

/* Kick both velocities over half a step by `total`, the summed effects of gravity and theta. If
 * wanted, also kick the rows of effects, and write the velocities' two rows of the kick's Jacobian
 * minus I. */
static void kick_arm(
    const flow *f, const double *total, double torque, double half, double *x, int is_first,
    int wanted, const flow_step *work, long n)
{
    const long k = sizes_of(f)->k;
    const double push = total[CAUSES + BY_TORQUE] + total[CAUSES + BY_COMMAND];
    double *rows = work->vectors, causes[CAUSES], cos;
    memcpy(causes, x, 4 * sizeof *x);
    sine_and_cosine(x[0], &causes[BY_SINE], &cos);
    causes[BY_COMMAND] = torque - *f->torque_offset;
    /* Inertia acts on the known torque and on the unknown one, of disturbance states, alike. */
    causes[BY_TORQUE] = torque + dot(f->motor_torque + 4, x + 4, n - 4);
    causes[BY_EXTERNAL] = dot(f->link_torque + 4, x + 4, n - 4);
    x[1] += dot(total, causes, CAUSES);
    x[3] += dot(total + CAUSES, causes, CAUSES);
    if (!wanted) {
        return;
    }
    for (long side = 0; side < 2; side++) {
        const double *by = total + side * CAUSES;
        for (long j = 0; j < n; j++) {
            /* Here and below, adding 0.0 turns -0 into 0. */
            rows[side * n + j] = j < 4 ? by[j]
                                       : 0.0 + by[BY_TORQUE] * f->motor_torque[j]
                                             + by[BY_EXTERNAL] * f->link_torque[j];
        }
        rows[side * n] += by[BY_SINE] * cos;
    }
    for (long i = 0; i <= k; i++) { /* the last is the push */
        const double *by = f->effects + 2 * i * CAUSES;
        double *row = work->effects + i * n;
        const double link = is_first ? 0.0 : row[1] + dot(rows, row, n);
        const double motor = is_first ? 0.0 : row[3] + dot(rows + n, row, n);
        row[1] = link + (i < k ? half * dot(by, causes, CAUSES) : 0.0);
        row[3] = motor + (i < k ? half * dot(by + CAUSES, causes, CAUSES) : push);
    }
}

/* Replace M (n, n) by K M, where K is I with `rows` (2, n) added to its rows of x_2 and x_4. */
static void shear_rows(long n, const double *rows, double *changes, double *M)
{
    combine(rows, M, n, changes, n, n);
    combine(rows + n, M, n, changes + n, n, n);
    add_scaled(M + n, 1.0, changes, n);
    add_scaled(M + 3 * n, 1.0, changes + n, n);
}

/* Replace a symmetric S by K S K'. */
static void shear(long n, const double *rows, double *changes, double *S)
{
    const double *link = rows, *motor = rows + n;
    double *at_link = S + n, *at_motor = S + 3 * n;
    shear_rows(n, rows, changes, S);
    /* K' changes two columns: by symmetry they become the rows. Only the crossings are new. */
    const double corner = dot(link, at_link, n), both = dot(link, at_motor, n);
    at_motor[3] += dot(motor, at_motor, n);
    at_link[1] += corner;
    at_motor[1] += both;
    at_link[3] = at_motor[1];
    for (long j = 0; j < n; j++) {
        S[j * n + 3] = at_motor[j];
        S[j * n + 1] = at_link[j];
    }
}

/* Kick both velocities by gravity and by theta, take the linear flow, and kick again. */
static inline void step_arm(
    const flow *f, const linear_step *over, double *restrict x, const double *theta,
    const double *u, int wanted, const flow_step *work, long n)
{
    const long k = sizes_of(f)->k, inputs = sizes_of(f)->inputs;
    const double half = 0.5 * over->duration;
    double *link = work->vectors, *motor = link + n, *changes = motor + n;
    double few[FEW], *moved = n <= FEW ? few : changes + 2 * n, total[2 * CAUSES] = {0.0};
    for (long place = 0; place < 2 * CAUSES; place++) {
        for (long i = 0; i < k; i++) {
            total[place] += half * (theta[i] * f->effects[i * 2 * CAUSES + place]);
        }
    }
    total[BY_SINE] -= half * *f->gravity_gain;
    kick_arm(f, total, u[0], half, x, 1, wanted, work, n);
    for (long i = 0; i < n; i++) {
        moved[i] = dot(over->phi + i * n, x, n) + dot(over->gamma + i * inputs, u, inputs);
    }
    memcpy(x, moved, (size_t)n * sizeof *x);
    if (wanted) {
        for (long row = 0; row <= k; row++) {
            double *effect = work->effects + row * n;
            const double at_link = effect[1], at_motor = effect[3]; /* the others are 0 */
            for (long i = 0; i < n; i++) {
                effect[i] = 0.0 + over->phi[i * n + 1] * at_link + over->phi[i * n + 3] * at_motor
                            + (row == k ? over->gamma[i * inputs] : 0.0);
            }
        }
        for (long i = 0; i < n; i++) {
            const double *phi = over->phi + i * n;
            for (long j = 0; j < n; j++) {
                work->J[i * n + j] = phi[j] + (phi[1] * link[j] + phi[3] * motor[j]);
            }
        }
    }
    kick_arm(f, total, u[0], half, x, 0, wanted, work, n);
    if (wanted) {
        shear_rows(n, link, changes, work->J);
        memcpy(work->Q, over->noise, (size_t)(n * n) * sizeof *work->Q);
        shear(n, link, changes, work->Q);
    }
}

/* --- T-S systems --- */

/* Write the remainder, which x' has beside the linear flow: sum of h_i (D_i + sum of theta times
 * directions) [x; u]. Unless `jacobian` is NULL, write it, and the derivatives by theta, (k, n). */
static void write_remainder(
    const flow *f, const double *x, const double *theta, const double *u, double *remainder,
    double *jacobian, double *direct, const flow_step *work)
{
    const flow_sizes *s = sizes_of(f);
    const long n = s->n, k = s->k, rules = s->rules, plant = s->plant, premises = s->premises;
    const long inputs = s->inputs, signals = plant + inputs, scheduled = s->m - inputs;
    double *signal = work->signals, *entries = signal + signals, *weight_slope = work->rates;
    memcpy(signal, x, (size_t)plant * sizeof *signal);
    memcpy(signal + plant, u, (size_t)inputs * sizeof *signal);
    for (long j = 0; j < premises; j++) {
        work->premises[j] = dot(f->premise + j * plant, x, plant)
                            + dot(f->schedule + j * scheduled, u + inputs, scheduled);
    }
    rule_weights(
        f->shapes, f->parameters, work->premises, work->weights, jacobian ? work->slopes : NULL,
        rules, premises);
    memset(remainder, 0, (size_t)n * sizeof *remainder);
    if (jacobian != NULL) {
        memset(jacobian, 0, (size_t)(n * n) * sizeof *jacobian);
        memset(direct, 0, (size_t)(k * n) * sizeof *direct);
    }
    for (long rule = 0; rule < rules; rule++) {
        const double weight = work->weights[rule];
        for (long j = 0; jacobian != NULL && j < plant; j++) {
            weight_slope[j] = 0.0;
            for (long q = 0; q < premises; q++) {
                weight_slope[j] += work->slopes[rule * premises + q] * f->premise[q * plant + j];
            }
        }
        for (long i = 0; i < plant; i++) {
            const long row = (rule * plant + i) * signals, all = rules * plant * signals;
            memcpy(entries, f->deviations + row, (size_t)signals * sizeof *entries);
            for (long p = 0; p < k; p++) {
                add_scaled(entries, theta[p], f->directions + p * all + row, signals);
            }
            const double total = dot(entries, signal, signals);
            remainder[i] += weight * total;
            if (jacobian != NULL) {
                add_scaled(jacobian + i * n, weight, entries, plant);
                add_scaled(jacobian + i * n, total, weight_slope, plant);
                for (long p = 0; p < k; p++) {
                    direct[p * n + i]
                        += weight * dot(f->directions + p * all + row, signal, signals);
                }
            }
        }
    }
}

/* Write the linearisation of a step from the remainder's Jacobians N1, N2, which are overwritten:
 * J = Phi [Phi + T N2 Phi (I + (T/2) N1)], noise Phi (I + T N2) n1 + n2. */
static void linearise_system(
    const flow *f, const linear_step *over, double *N1, double *N2, const flow_step *work)
{
    const long n = sizes_of(f)->n, k = sizes_of(f)->k, squares = n * n;
    const long inputs = sizes_of(f)->inputs;
    const double T = over->duration;
    double *inner = N2 + squares, *outer = inner + squares, *scratch = outer + squares;
    double *one = work->vectors, *other = one + n;
    for (long p = 0; p < k; p++) { /* effects: T Phi (d2 + N2 (T/2) Phi d1) */
        multiply(over->phi, work->direct + p * n, one, n, n, 1);
        multiply(N2, one, other, n, n, 1);
        for (long i = 0; i < n; i++) {
            other[i] = T * (work->direct[(k + p) * n + i] + 0.5 * T * other[i]);
        }
        multiply(over->phi, other, work->effects + p * n, n, n, 1);
    }
    /* The push: a change of the first input acts through the rules' mean, in both halves. */
    for (long i = 0; i < n; i++) {
        one[i] = inputs > 0 ? over->gamma[i * inputs] : 0.0;
    }
    multiply(over->phi, one, work->effects + k * n, n, n, 1);
    add_scaled(work->effects + k * n, 1.0, one, n);
    for (long i = 0; i < squares; i++) {
        N1[i] = 0.5 * T * N1[i] + (i % (n + 1) == 0 ? 1.0 : 0.0);
        N2[i] *= T;
    }
    multiply(over->phi, N1, inner, n, n, n);
    multiply(N2, inner, outer, n, n, n);
    add_scaled(outer, 1.0, over->phi, squares);
    multiply(over->phi, outer, work->J, n, n, n);
    for (long i = 0; i < n; i++) {
        N2[i * n + i] += 1.0;
    }
    multiply(over->phi, N2, outer, n, n, n);
    memcpy(work->Q, over->noise, (size_t)squares * sizeof *work->Q);
    congruence(outer, work->Q, n, over->noise, n, scratch, n);
}

/* Take a step by the exponential midpoint rule: half a step leads to the middle, where the
 * remainder for the whole step is evaluated. `over` is the linear flow over half a step. */
static void step_system(
    const flow *f, const linear_step *over, double *x, const double *theta, const double *u,
    int wanted, const flow_step *work)
{
    const long n = sizes_of(f)->n, k = sizes_of(f)->k, inputs = sizes_of(f)->inputs;
    double *forced = work->vectors, *moved = forced + n, *remainder = moved + n;
    double *middle = remainder + n;
    double *N1 = wanted ? work->squares : NULL, *N2 = wanted ? N1 + n * n : NULL;
    for (long i = 0; i < n; i++) {
        forced[i] = dot(over->gamma + i * inputs, u, inputs);
        moved[i] = dot(over->phi + i * n, x, n) + forced[i];
    }
    write_remainder(f, x, theta, u, remainder, N1, work->direct, work);
    multiply(over->phi, remainder, middle, n, n, 1);
    for (long i = 0; i < n; i++) {
        middle[i] = moved[i] + 0.5 * over->duration * middle[i];
    }
    write_remainder(f, middle, theta, u, remainder, N2, work->direct + k * n, work);
    add_scaled(moved, over->duration, remainder, n);
    multiply(over->phi, moved, x, n, n, 1);
    add_scaled(x, 1.0, forced, n);
    if (wanted) {
        linearise_system(f, over, N1, N2, work);
    }
}

void take_step(
    const flow *f, const linear_step *over, double *x, const double *theta, const double *u,
    int wanted, const flow_step *work)
{
    if (*f->kind == KIND_ARM) {
        WITH_SIZE(sizes_of(f)->n, step_arm, f, over, x, theta, u, wanted, work)
    } else {
        step_system(f, over, x, theta, u, wanted, work);
    }
}
