/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The true motion of simulated plants: arms with an elastic joint and T-S systems.
 *
 * Both are integrated by the classical fourth-order Runge-Kutta method, in equal steps with inputs
 * and disturbances held from a sample to the next. Series are (runs, samples, ...). Random numbers
 * are the caller's.
 */
#ifndef TSOBS_SIMULATE_H
#define TSOBS_SIMULATE_H

#include "layout.h"

/* An arm that moves, with what differs from the nominal one. */
#define SIMULATED_ARM_FIELDS(F, s)                                                                \
    F(COUNT, substeps, 1, 1)       /* steps of a sampling period, */                              \
    F(NUMBER, substep, 1, 1)       /* and length of one [s] */                                    \
    F(NUMBER, gravity, 1, 1)       /* mgl over the link's inertia */                              \
    F(NUMBER, motor_inertia, 1, 1) /* [kg m2] */                                                  \
    F(NUMBER, link_spring, 1, 1)   /* k, b and Coulomb friction over the link's inertia */        \
    F(NUMBER, link_drag, 1, 1)                                                                    \
    F(NUMBER, motor_spring, 1, 1)  /* k, b and Coulomb friction over the motor's inertia */       \
    F(NUMBER, motor_drag, 1, 1)                                                                   \
    F(NUMBER, link_rub, 1, 1)      /* of the former, */                                           \
    F(NUMBER, motor_rub, 1, 1)     /* of the latter */                                            \
    F(NUMBER, link_inertia, 1, 1)  /* [kg m2] */                                                  \
    F(NUMBER, link_viscous, 1, 1)  /* friction [N m s/rad] */                                     \
    F(NUMBER, link_coulomb, 1, 1)  /* friction [N m] */                                           \
    F(NUMBER, motor_viscous, 1, 1)                                                                \
    F(NUMBER, motor_coulomb, 1, 1)                                                                \
    F(NUMBER, added_inertia, 1, 1) /* the payload's [kg m2] */                                    \
    F(NUMBER, added_gravity, 1, 1) /* the payload's [N m] */                                      \
    F(NUMBER, link_kick, 1, 1)     /* of the normal numbers of the process noise [rad/s] */       \
    F(NUMBER, motor_kick, 1, 1)                                                                   \
    F(NUMBER, free_play, 1, 1)     /* twist to either side that the spring does not feel [rad] */
LAYOUT_DECLARE(simulated_arm, SIMULATED_ARM_FIELDS, void)

/* Sizes of a T-S system: states, inputs, scheduled signals, outputs, rules and premises. */
typedef struct {
    int64_t n, m, scheduled, p, rules, premises;
} system_sizes;

/* A T-S system: x' = sum h_i (A_i x + B_i u), y = sum h_i C_i x, with h of z = Z [x; u; s].
 *
 * rates, outputs: [A_i B_i] and C_i of all rules. shapes, parameters: the memberships' (r, q).
 * premise: Z. strengths: what multiplies the process noise of each state.
 * The rest is scratch: signals is [x; u; s], with scheduled signals s. */
#define SIMULATED_SYSTEM_FIELDS(F, s)                            \
    F(COUNT, substeps, 1, 1)                                     \
    F(NUMBER, substep, 1, 1)                                     \
    F(MATRIX, rates, (s)->rules * (s)->n, (s)->n + (s)->m)       \
    F(MATRIX, outputs, (s)->rules * (s)->p, (s)->n)              \
    F(COUNTS, shapes, (s)->rules * (s)->premises, 1)             \
    F(MATRIX, parameters, (s)->rules * (s)->premises, 4)         \
    F(MATRIX, premise, (s)->premises, SIGNALS(s))                \
    F(VECTOR, strengths, (s)->n, 1)                              \
    F(VECTOR, signals, SIGNALS(s), 1)                            \
    F(VECTOR, z, (s)->premises, 1)                               \
    F(VECTOR, weights, (s)->rules, 1)                            \
    F(VECTOR, start, (s)->n, 1)                                  \
    F(VECTOR, slope, (s)->n, 1)                                  \
    F(VECTOR, total, (s)->n, 1)
#define SIGNALS(s) ((s)->n + (s)->m + (s)->scheduled)
LAYOUT_DECLARE(simulated_system, SIMULATED_SYSTEM_FIELDS, system_sizes)

/* Move arms over samples.
 *
 * arms: without and with the payload; carried: which of them moves at each sample, (samples).
 * inputs: motor torques [N m], (runs, samples). kicks: normal numbers of link and motor after each
 * integration step in turn, (runs, samples, 2 substeps), or NULL for no process noise.
 * present: [q1, q1', q2, q2'] (rad, rad/s), moved on, (runs, 4).
 * states: of each sample, written, (runs, samples, 4).
 * torques: on motor and link in addition to the drive's [N m], (runs, samples, 2); overwritten by
 * those that an arm without friction and payload would need to move like this one. */
void simulate_arms(
    const simulated_arm *arms, const int64_t *carried, const double *inputs, const double *kicks,
    double *present, double *states, double *torques, long runs, long samples);

/* Move T-S systems over samples.
 *
 * inputs: inputs and scheduled signals, (runs, samples, m + scheduled).
 * kicks: normal numbers of each state after each integration step in turn, (runs, samples,
 * substeps n), or NULL. present: x, moved on, (runs, n). states, truths: x and y of each sample,
 * written, (runs, samples, n) and (runs, samples, p). */
void simulate_systems(
    const simulated_system *system, const system_sizes *s, const double *inputs,
    const double *kicks, double *present, double *states, double *truths, long runs, long samples);

#endif
