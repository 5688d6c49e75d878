/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The true motion of simulated plants: arms with an elastic joint and T-S systems.
 *
 * Both are integrated by the classical fourth-order Runge-Kutta method in equal steps. Inputs and
 * disturbances are held from one sample to the next. The caller supplies the random numbers.
 */
#ifndef TSOBS_SIMULATE_H
#define TSOBS_SIMULATE_H

#include "layout.h"

/* A simulated arm, with its differences from the nominal one. */
typedef struct {
    double gravity;       /* mgl over the link's inertia */
    double motor_inertia; /* [kg m2] */
    double link_spring, link_drag;   /* k and b over the link's inertia, */
    double motor_spring, motor_drag; /* and over the motor's */
    double link_rub, motor_rub;      /* Coulomb friction over the same inertias */
    double link_inertia;             /* [kg m2] */
    double link_viscous, link_coulomb; /* friction [N m s/rad], [N m] */
    double motor_viscous, motor_coulomb;
    double added_inertia, added_gravity; /* the payload's [kg m2], [N m] */
    double free_play; /* twist to either side without a spring torque [rad] */
} simulated_arm;

/* Inputs of an arm: the drive's torque, additional torques on motor and link [N m], and whether the
 * arm carries the payload. */
enum { DRIVE, ON_MOTOR, ON_LINK, IS_LOADED, ARM_INPUTS };

/* Sizes of a plant: states, inputs, scheduled signals, outputs, rules (0 for an arm), and premise
 * variables. */
typedef struct {
    int64_t n, m, scheduled, p, rules, premises;
} plant_sizes;

/* Return the number of states with process noise: for an arm, the two velocities. */
static inline int64_t noisy_count(const plant_sizes *s)
{
    return s->rules == 0 ? 2 : s->n;
}

/* A plant is an arm or a T-S system.
 *
 * The states of an arm are [q1, q1', q2, q2'] (rad, rad/s). Its outputs are torques on motor and
 * link: those that, beside the drive's, an arm without friction, payload and play would need to
 * move in the same way. arms: without and with the payload.
 *
 * A T-S system is x' = sum h_i (A_i x + B_i u), y = sum h_i C_i x. The weights h follow from
 * z = Z [x; u; s], with scheduled signals s. rates, outputs: [A_i B_i] and C_i of all rules.
 * shapes, parameters: of the memberships, (r, q). premise: Z.
 *
 * The fields from `signals` on, which is [x; u; s], are scratch. */
#define SIMULATED_PLANT_FIELDS(F, s)                                               \
    F(COUNT, substeps, 1, 1)   /* integration steps per sampling period, */        \
    F(NUMBER, substep, 1, 1)   /* and the length of one [s] */                     \
    F(VECTOR, noise, noisy_count(s), 1) /* factors of the normal numbers */        \
    F(MATRIX, arms, s->rules == 0 ? 2 : 0, sizeof(simulated_arm) / 8)              \
    F(MATRIX, rates, s->rules * s->n, s->n + s->m)                                 \
    F(MATRIX, outputs, s->rules * s->p, s->n)                                      \
    F(COUNTS, shapes, s->rules * s->premises, 1)                                   \
    F(MATRIX, parameters, s->rules * s->premises, 4)                               \
    F(MATRIX, premise, s->premises, SIGNALS(s))                                    \
    F(VECTOR, signals, SIGNALS(s), 1)                                              \
    F(VECTOR, z, s->premises, 1)                                                   \
    F(VECTOR, weights, s->rules, 1)                                                \
    F(VECTOR, start, s->n, 1)                                                      \
    F(MATRIX, slopes, 4, s->n)
#define SIGNALS(s) ((s)->n + (s)->m + (s)->scheduled)
LAYOUT_DECLARE(simulated_plant, SIMULATED_PLANT_FIELDS, plant_sizes)

/* Move equal plants over samples, one in each run.
 *
 * inputs: inputs and scheduled signals, (runs, samples, m + scheduled). kicks: normal random
 * numbers, for each state with process noise after each integration step, (runs, samples, substeps,
 * noisy_count), or NULL. present: x, replaced by x after the last sample, (runs, n). Written are x
 * and y at each sample: states, (runs, samples, n), and outputs, (runs, samples, p). */
void simulate(
    const simulated_plant *plant, const plant_sizes *s, const double *inputs, const double *kicks,
    double *present, double *states, double *outputs, long runs, long samples);

#endif
