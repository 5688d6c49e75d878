/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * One step of a prediction model: estimate, regressor and error covariance.
 *
 * A model's numbers are a record, the same kind for an arm, a T-S system and an observer that is
 * integrated. Y = dx/dtheta moves with the step's own Jacobian and gathers the effect of theta on
 * the state's derivative; it is kept by rows, one a parameter.
 */
#ifndef TSOBS_FLOW_H
#define TSOBS_FLOW_H

#include "layout.h"

/* --- memberships: a rule base is a code of the shape for each rule and premise, (r, q), and four
 * parameters, (r, q, 4) --- */

/* Codes of the shapes. Their parameters, in this order; the rest of the four is not read:
 * LINEAR: zero, one. TRAPEZOID: left, top_left, top_right, right. GAUSSIAN: centre, width.
 * SINE_UPPER, SINE_LOWER: half_width, sin(half_width)/half_width.
 * SQUARE, SQUARE_REST: half_width. */
enum {
    SHAPE_ALWAYS,
    SHAPE_LINEAR,
    SHAPE_TRAPEZOID,
    SHAPE_GAUSSIAN,
    SHAPE_SINE_UPPER,
    SHAPE_SINE_LOWER,
    SHAPE_SQUARE,
    SHAPE_SQUARE_REST
};

/* Return the grade at z and write its slope, at a corner that of one side; both are NaN if z is,
 * but for SHAPE_ALWAYS. `parameters` has four. */
double grade_and_slope(int64_t shape, double z, const double *parameters, double *slope);

/* Write the normalised weights h(z) of r rules with q premises, and the slopes dh_i/dz_j (r, q)
 * unless NULL; all are NaN if no rule fires. */
void rule_weights(
    const int64_t *shapes, const double *parameters, const double *z, double *weights,
    double *slopes, long r, long q);

/* --- the exact flow of x' = A x + B u + noise, over a step of any length --- */

#define SERIES_TERMS 60 /* most rows of a series of Taylor coefficients */
#define SHORTEST 1e-6   /* least period [s], so that those of any duration can be counted */
#define STRETCH 1.25    /* a step may be longer than nominal by so much: stamps jitter */

/* Numbers of scratch that `flow_over` needs for n states and m inputs. */
static inline size_t flow_over_scratch_size(long n, long m)
{
    return (size_t)(n * (2 * n + m) + 2 * n * n + n * m);
}

/* Write Phi (n, n), Gamma (n, m) and, unless NULL, Q (n, n) over a duration of at least 0 [s].
 *
 * `series` has the Taylor coefficients of Phi, Gamma and Q side by side in `terms` rows, of
 * n (2 n + m) numbers, and serves steps up to `reach` [s]; a longer one is halved and doubled. */
void flow_over(
    const double *series, long terms, double reach, double duration, double *phi, double *gamma,
    double *noise, double *scratch, long n, long m);

/* Return the number of nominal steps in a duration [s], and write the length of a last one, which
 * is 0 or up to STRETCH periods. */
int64_t cut_into_steps(double duration, double period, double *rest);

/* --- models --- */

enum { KIND_ARM, KIND_SYSTEM, KIND_INTEGRATED };

/* What theta = 1 adds to both accelerations of an arm: by x (4 each, the link's first), by sin x_1,
 * by the torque of the motor and by a torque at the link. */
enum {
    LINK_SINE = 8,
    MOTOR_SINE,
    LINK_TORQUE,
    MOTOR_TORQUE,
    LINK_EXTERNAL,
    MOTOR_EXTERNAL,
    EFFECTS
};

/* Sizes of a model: n augmented states, m signals, the inputs and then the scheduled ones, p
 * outputs, k parameters, the plant's own states, rules and premise variables. */
typedef struct {
    long n, m, inputs, p, k, plant, rules, premises;
} flow_sizes;

/* Numbers of a model. deviations: [A B] of each rule of a T-S system less the mean; directions: their
 * change by each parameter; schedule: scheduled signals to premise variables. The linear flow of a T-S system is that of half a step. */
#define FLOW_FIELDS(FIELD, s)                                                        \
    FIELD(COUNT, kind, 1, 1)         /* KIND_... */                                  \
    FIELD(COUNT, n, 1, 1)            /* flow_sizes */                                \
    FIELD(COUNT, m, 1, 1)                                                            \
    FIELD(COUNT, inputs, 1, 1)                                                       \
    FIELD(COUNT, p, 1, 1)                                                            \
    FIELD(COUNT, k, 1, 1)                                                            \
    FIELD(COUNT, plant, 1, 1)                                                        \
    FIELD(COUNT, rules, 1, 1)                                                        \
    FIELD(COUNT, premises, 1, 1)                                                     \
    FIELD(NUMBER, period, 1, 1)      /* nominal step [s] */                          \
    FIELD(COUNT, terms, 1, 1)        /* of the series of the linear flow, */         \
    FIELD(NUMBER, reach, 1, 1)       /* up to which it serves [s] */                 \
    FIELD(MATRIX, series, SERIES_TERMS, s->n * (2 * s->n + s->inputs))               \
    FIELD(MATRIX, phi, s->n, s->n)   /* nominal linear flow, */                      \
    FIELD(MATRIX, turned, s->n, s->n) /* phi transposed, */                          \
    FIELD(MATRIX, gamma, s->n, s->inputs)                                            \
    FIELD(MATRIX, noise, s->n, s->n)                                                 \
    FIELD(NUMBER, gravity_gain, 1, 1) /* of an arm or integrated observer */         \
    FIELD(MATRIX, effects, s->k, EFFECTS) /* of an arm's parameters */               \
    FIELD(COUNT, has_unknown, 1, 1)  /* whether an arm has unknown torques, */       \
    FIELD(VECTOR, motor_torque, s->n, 1) /* and states that make up the motor's */   \
    FIELD(VECTOR, link_torque, s->n, 1) /* and the link's */                         \
    FIELD(MATRIX, deviations, s->rules * s->plant, s->plant + s->inputs)             \
    FIELD(MATRIX, directions, s->k * s->rules * s->plant, s->plant + s->inputs)      \
    FIELD(MATRIX, premise, s->premises, s->plant) /* states to premise variables, */ \
    FIELD(MATRIX, schedule, s->premises, s->m - s->inputs)                           \
    FIELD(COUNTS, shapes, s->rules * s->premises, 1) /* memberships, */              \
    FIELD(MATRIX, parameters, s->rules * s->premises, 4) /* and theirs */            \
    FIELD(NUMBER, max_step, 1, 1)    /* of an integrated observer [s], */            \
    FIELD(MATRIX, F, s->rules * s->n, s->n) /* matrices of each rule */              \
    FIELD(MATRIX, Y, s->rules * s->n, s->p)                                          \
    FIELD(MATRIX, U, s->rules * s->n, s->m)
LAYOUT_DECLARE(flow, FLOW_FIELDS, flow_sizes)

/* Most tangents that a step moves. */
static inline long flow_tangents(const flow_sizes *s)
{
    return s->p + 4;
}

/* Scratch of a step. stack: what is moved, x, the rows of Y and tangents; moved: the same after the
 * linear flow. covariance: what is moved of it. phi to noise: the linear flow over a step that is
 * not nominal; over: scratch of it. The rest is of the kinds of steps. */
#define FLOW_SCRATCH_FIELDS(FIELD, s)                                              \
    FIELD(MATRIX, stack, s->k + 1 + flow_tangents(s), s->n)                        \
    FIELD(MATRIX, moved, s->k + 1 + flow_tangents(s), s->n)                        \
    FIELD(MATRIX, covariance, s->n, s->n)                                          \
    FIELD(MATRIX, phi, s->n, s->n)                                                 \
    FIELD(MATRIX, turned, s->n, s->n)                                              \
    FIELD(MATRIX, gamma, s->n, s->inputs)                                          \
    FIELD(MATRIX, noise, s->n, s->n)                                               \
    FIELD(VECTOR, over, flow_over_scratch_size(s->n, s->inputs), 1)                \
    FIELD(MATRIX, squares, 6 * s->n, s->n)                                         \
    FIELD(MATRIX, vectors, 5, s->n)                                                \
    FIELD(MATRIX, kicks, 2, s->n)                                                  \
    FIELD(MATRIX, changes, 2, s->n)                                                \
    FIELD(MATRIX, rows, 2 * (s->k + 1 + flow_tangents(s)), s->n)                       \
    FIELD(MATRIX, rates, s->rules, s->plant)                                       \
    FIELD(VECTOR, weights, s->rules, 1)                                            \
    FIELD(MATRIX, slopes, s->rules, s->premises)                                   \
    FIELD(VECTOR, premises, s->premises, 1)                                        \
    FIELD(VECTOR, signals, s->plant + s->inputs, 1)
LAYOUT_DECLARE(flow_scratch, FLOW_SCRATCH_FIELDS, flow_sizes)

/* Read the sizes from the first numbers of a record. */
flow_sizes flow_sizes_of(const double *memory);

/* Return the view of a record, by the sizes in it. Its numbers are not written. */
flow flow_view(const double *memory);

/* Directions from x, rows of n numbers, that move with the step's Jacobian; a held change of an arm's
 * torque drives each of them in proportion to `drives`. There are at most `flow_tangents` of them. */
typedef struct {
    double *rows;
    const double *drives;
    long count;
} tangents;

/* Move the estimate x, Y, the error covariance and tangents over a time, in place.
 *
 * x has n numbers. `upsilon` (k rows; NULL if k is 0) and `covariance` (n rows; NULL if it is not
 * to be moved) have rows of `width` >= n numbers, of which n are in use. `along` is NULL without
 * tangents. `theta` has k numbers, `u` the m signals held over the time; `y`, the p outputs in use,
 * is read for KIND_INTEGRATED only. duration: at least 0 [s]. `scratch` has flow_scratch_size
 * numbers for the sizes of the model. */
void flow_advance(
    const flow *f, double *x, double *upsilon, double *covariance, long width, tangents *along,
    const double *theta, const double *y, const double *u, double duration, double *scratch);

#endif
