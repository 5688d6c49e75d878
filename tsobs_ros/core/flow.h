/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * One step of a prediction model (an arm or a T-S system), and the linearisation of that step.
 */
#ifndef TSOBS_FLOW_H
#define TSOBS_FLOW_H

#include "layout.h"

/* --- memberships: a rule base has, for each rule and premise, the code of a shape, (r, q), and
 * four parameters, (r, q, 4) --- */

/* Codes of the shapes. The parameters of each, in order; the rest of the four are not read:
 * TRAPEZOID: left, top_left, top_right, right. GAUSSIAN: centre, width.
 * SINE_UPPER, SINE_LOWER: half_width, sin(half_width)/half_width.
 * SQUARE, SQUARE_REST: half_width. */
enum {
    SHAPE_ALWAYS,
    SHAPE_TRAPEZOID,
    SHAPE_GAUSSIAN,
    SHAPE_SINE_UPPER,
    SHAPE_SINE_LOWER,
    SHAPE_SQUARE,
    SHAPE_SQUARE_REST
};

/* Write the normalised weights h(z) of r rules with q premises and, unless `slopes` is NULL, the
 * slopes dh_i/dz_j (r, q). All are NaN if no rule fires. */
void rule_weights(
    const int64_t *shapes, const double *parameters, const double *z, double *weights,
    double *slopes, long r, long q);

#define SERIES_TERMS 60 /* maximum number of rows in a Taylor series */
#define SHORTEST 1e-6   /* least period [s]; an integer can count the periods in any duration */

/* --- models --- */

enum { KIND_ARM, KIND_SYSTEM };

/* Quantities that accelerate the link and the motor of an arm: its four states, the sine of the
 * link's angle, the motor's torque, a torque at the link, and the part of the motor's torque that
 * commands make. */
enum { BY_SINE = 4, BY_TORQUE, BY_EXTERNAL, BY_COMMAND, CAUSES };

/* Sizes of a model: n augmented states, m signals (the `inputs`, then the scheduled ones), k
 * parameters, the plant's own states, rules, and premise variables. */
typedef struct {
    int64_t n, m, inputs, k, plant, rules, premises;
} flow_sizes;
enum { FLOW_SIZES = sizeof(flow_sizes) / sizeof(int64_t) };

/* A model. Its linear flow x+ = Phi x + Gamma u + noise of covariance Q is exact; that of a T-S
 * system is over half a step. series: Taylor coefficients of Phi, Gamma and Q, side by side.
 * deviations: [A B] of each rule of a T-S system minus the rules' mean; directions: changes of
 * [A B] with each parameter; schedule: map from scheduled signals to premise variables. */
#define FLOW_FIELDS(FIELD, s)                                                        \
    FIELD(COUNT, kind, 1, 1)         /* KIND_... */                                  \
    FIELD(COUNTS, sizes, FLOW_SIZES, 1) /* flow_sizes */                             \
    FIELD(COUNT, terms, 1, 1)        /* rows of the series in use, */                \
    FIELD(NUMBER, reach, 1, 1)       /* and the longest time they serve [s] */       \
    FIELD(MATRIX, series, SERIES_TERMS, s->n * (2 * s->n + s->inputs))               \
    FIELD(MATRIX, phi, s->n, s->n)   /* linear flow of a nominal step */             \
    FIELD(MATRIX, gamma, s->n, s->inputs)                                            \
    FIELD(MATRIX, noise, s->n, s->n)                                                 \
    FIELD(NUMBER, torque_offset, 1, 1) /* first input without a command [N m] */     \
    FIELD(NUMBER, gravity_gain, 1, 1) /* of an arm */                                \
    FIELD(MATRIX, effects, s->k * 2, CAUSES) /* of theta = 1 on an arm's accelerations */ \
    FIELD(VECTOR, motor_torque, s->n, 1) /* states to an arm's unknown torques: at */\
    FIELD(VECTOR, link_torque, s->n, 1) /* the motor, and at the link */             \
    FIELD(MATRIX, deviations, s->rules * s->plant, s->plant + s->inputs)             \
    FIELD(MATRIX, directions, s->k * s->rules * s->plant, s->plant + s->inputs)      \
    FIELD(MATRIX, premise, s->premises, s->plant) /* states to premise variables */  \
    FIELD(MATRIX, schedule, s->premises, s->m - s->inputs)                           \
    FIELD(COUNTS, shapes, s->rules * s->premises, 1) /* of memberships, */           \
    FIELD(MATRIX, parameters, s->rules * s->premises, 4) /* and their parameters */
LAYOUT_DECLARE(flow, FLOW_FIELDS, flow_sizes)

/* Linearisation of a step: x+ = J x + effects' theta + push d + noise of covariance Q, where d is a
 * change of the first input. The fields after Q are scratch. */
#define STEP_FIELDS(FIELD, s)                                                         \
    FIELD(MATRIX, J, s->n, s->n)                                                      \
    FIELD(MATRIX, effects, s->k + 1, s->n) /* one per row; the last is the push */    \
    FIELD(MATRIX, Q, s->n, s->n)                                                      \
    FIELD(MATRIX, phi, s->n, s->n) /* linear flow of a step that is not nominal */    \
    FIELD(MATRIX, gamma, s->n, s->inputs)                                             \
    FIELD(MATRIX, noise, s->n, s->n)                                                  \
    FIELD(MATRIX, squares, s->n, 7 * s->n + s->inputs)                                \
    FIELD(MATRIX, vectors, 6, s->n)                                                   \
    FIELD(MATRIX, direct, 2 * s->k, s->n)                                             \
    FIELD(VECTOR, rates, s->plant, 1)                                                 \
    FIELD(VECTOR, weights, s->rules, 1)                                               \
    FIELD(MATRIX, slopes, s->rules, s->premises)                                      \
    FIELD(VECTOR, premises, s->premises, 1)                                           \
    FIELD(MATRIX, signals, 2, s->plant + s->inputs)
LAYOUT_DECLARE(flow_step, STEP_FIELDS, flow_sizes)

/* The linear flow over a step, or for a T-S system over half a step. */
typedef struct {
    double duration; /* of the whole step [s] */
    const double *phi, *gamma, *noise;
} linear_step;

/* Return the sizes in a model's record, which follow its kind. */
static inline flow_sizes flow_sizes_of(const double *memory)
{
    return *(const flow_sizes *)(const void *)(memory + 1);
}

/* Return whether numbers are the record of a model, with consistent sizes and counts. */
int flow_is_sound(double *memory, size_t length);

/* Return the linear flow over a step of any duration [s]; its matrices are kept in `work`. */
linear_step other_step(const flow *f, double duration, const flow_step *work);

/* Move x (n) over a step with parameters theta and held signals u. Write the linearisation if it is
 * wanted. */
void take_step(
    const flow *f, const linear_step *over, double *x, const double *theta, const double *u,
    int wanted, const flow_step *work);

#endif
