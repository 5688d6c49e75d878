/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "simulate.h"

#include <string.h>

#include "flow.h"
#include "matrices.h"
#include "trigonometry.h"

/* Speed below which Coulomb friction is proportional to the speed [rad/s]. */
#define CREEP 0.01

/* Return Coulomb friction of a level, a torque [N m] or a deceleration [rad/s2]. */
static double rub(double level, double speed)
{
    const double share = speed / CREEP;
    if (!(level > 0.0)) {
        return 0.0;
    }
    return level * (share < -1.0 ? -1.0 : share > 1.0 ? 1.0 : share);
}

/* Return the spring's twist, which is 0 within the play. */
static double twist_of(const simulated_arm *arm, const double *x)
{
    const double turn = x[2] - x[0], free = *arm->free_play;
    if (!(free > 0.0)) {
        return turn;
    }
    return turn > free ? turn - free : turn < -free ? turn + free : 0.0;
}

/* Write the slope of an arm's state x, (4), by the motor's drive and the link's brake [rad/s2]. */
static void arm_slope(
    const simulated_arm *arm, const double *x, double drive, double brake, double *slope)
{
    const double twist = twist_of(arm, x);
    slope[0] = x[1];
    slope[1] = *arm->link_spring * twist - *arm->gravity * sine(x[0]) - *arm->link_drag * x[1] -
               rub(*arm->link_rub, x[1]) - brake;
    slope[2] = x[3];
    slope[3] = drive - *arm->motor_spring * twist - *arm->motor_drag * x[3] -
               rub(*arm->motor_rub, x[3]);
}

/* Move an arm's state x, (4), by one integration step. */
static void step_arm(const simulated_arm *arm, double drive, double brake, double *x)
{
    const double h = *arm->substep;
    double slopes[4][4], at[4];
    memcpy(at, x, sizeof at);
    for (int stage = 0; stage < 4; stage++) {
        const double time = stage == 2 ? h : 0.5 * h;
        arm_slope(arm, at, drive, brake, slopes[stage]);
        for (int i = 0; i < 4; i++) {
            at[i] = x[i] + time * slopes[stage][i];
        }
    }
    for (int i = 0; i < 4; i++) {
        x[i] += h / 6.0 * (slopes[0][i] + 2.0 * (slopes[1][i] + slopes[2][i]) + slopes[3][i]);
    }
}

/* Turn pushes on motor and link into the torques that an arm without friction and payload would
 * need: less friction, the spring's torque that play lacks, and on the link less what turns the
 * payload and holds it, dJ q1'' + dmgl sin q1. */
static void less_friction_and_payload(const simulated_arm *arm, const double *x, double *torques)
{
    const double push = torques[1], inertia = *arm->added_inertia, weight = *arm->added_gravity;
    torques[0] = torques[0] - *arm->motor_viscous * x[3] - rub(*arm->motor_coulomb, x[3]);
    torques[1] = push - *arm->link_viscous * x[1] - rub(*arm->link_coulomb, x[1]);
    if (*arm->free_play > 0.0) {
        const double slack = x[2] - x[0] - twist_of(arm, x);
        torques[0] += *arm->motor_inertia * *arm->motor_spring * slack;
        torques[1] -= *arm->link_inertia * *arm->link_spring * slack;
    }
    if (inertia > 0.0 || weight > 0.0) {
        double slope[4];
        arm_slope(arm, x, 0.0, (0.0 - push) / *arm->link_inertia, slope);
        torques[1] -= inertia * slope[1] + weight * sine(x[0]);
    }
}

void simulate_arms(
    const simulated_arm *arms, const int64_t *carried, const double *inputs, const double *kicks,
    double *present, double *states, double *torques, long runs, long samples)
{
    for (long run = 0; run < runs; run++) {
        double *x = present + 4 * run;
        for (long k = 0; k < samples; k++) {
            const simulated_arm *arm = &arms[carried[k]];
            /* Subtracted, so that a push of zero changes no bit, the sign of a zero included. */
            const double drive =
                *inputs++ / *arm->motor_inertia - (0.0 - torques[0]) / *arm->motor_inertia;
            const double brake = (0.0 - torques[1]) / *arm->link_inertia;
            memcpy(states, x, 4 * sizeof *x);
            less_friction_and_payload(arm, x, torques);
            for (int64_t step = 0; step < *arm->substeps; step++) {
                step_arm(arm, drive, brake, x);
                if (kicks != NULL) {
                    x[1] += *arm->link_kick * *kicks++;
                    x[3] += *arm->motor_kick * *kicks++;
                }
            }
            states += 4;
            torques += 2;
        }
    }
}

/* Write the weights of a system's rules. */
static void weigh(const simulated_system *system, const system_sizes *s)
{
    multiply(system->premise, system->signals, system->z, s->premises, SIGNALS(s), 1);
    rule_weights(
        system->shapes, system->parameters, system->z, system->weights, NULL, s->rules,
        s->premises);
}

/* Write sum h_i M_i of the first `width` signals, for matrices M_i (rows, width). */
static void blend(
    const simulated_system *system, const system_sizes *s, const double *matrices, long rows,
    long width, double *result)
{
    for (long row = 0; row < rows; row++) {
        result[row] = 0.0;
        for (long rule = 0; rule < s->rules; rule++) {
            const double *line = matrices + (rule * rows + row) * width;
            result[row] += system->weights[rule] * dot(line, system->signals, width);
        }
    }
}

/* Move a system's state, the first of the signals, by one integration step. */
static void step_system(const simulated_system *system, const system_sizes *s)
{
    const double h = *system->substep;
    double *x = system->signals;
    for (long i = 0; i < s->n; i++) {
        system->start[i] = x[i];
        system->total[i] = 0.0;
    }
    for (int stage = 0; stage < 4; stage++) {
        const double share = stage == 0 || stage == 3 ? 1.0 : 2.0;
        const double time = stage == 2 ? h : 0.5 * h;
        weigh(system, s);
        blend(system, s, system->rates, s->n, s->n + s->m, system->slope);
        for (long i = 0; i < s->n; i++) {
            system->total[i] += share * system->slope[i];
            x[i] = system->start[i] + time * system->slope[i];
        }
    }
    for (long i = 0; i < s->n; i++) {
        x[i] = system->start[i] + h / 6.0 * system->total[i];
    }
}

void simulate_systems(
    const simulated_system *system, const system_sizes *s, const double *inputs,
    const double *kicks, double *present, double *states, double *truths, long runs, long samples)
{
    const size_t state = (size_t)s->n * sizeof *present;
    const long held = s->m + s->scheduled;
    double *x = system->signals;
    for (long run = 0; run < runs; run++, present += s->n) {
        memcpy(x, present, state);
        for (long k = 0; k < samples; k++) {
            memcpy(x + s->n, inputs, (size_t)held * sizeof *x);
            memcpy(states, x, state);
            weigh(system, s);
            blend(system, s, system->outputs, s->p, s->n, truths);
            for (int64_t step = 0; step < *system->substeps; step++) {
                step_system(system, s);
                for (long i = 0; kicks != NULL && i < s->n; i++) {
                    x[i] += system->strengths[i] * *kicks++;
                }
            }
            inputs += held;
            states += s->n;
            truths += s->p;
        }
        memcpy(present, x, state);
    }
}
