/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "simulate.h"

#include <string.h>

#include "arithmetic.h"
#include "flow.h"

/* Speed below which Coulomb friction is proportional to the speed [rad/s]. */
#define CREEP 0.01

/* Return Coulomb friction, in the unit of its level: a torque [N m] or deceleration [rad/s2]. */
static double rub(double level, double speed)
{
    return level > 0.0 ? level * clip(speed / CREEP, -1.0, 1.0) : 0.0;
}

/* Return the spring's twist, which is 0 within the play. */
static double twist_of(const simulated_arm *arm, const double *x)
{
    const double turn = x[2] - x[0], free = arm->free_play;
    return free > 0.0 ? turn - clip(turn, -free, free) : turn;
}

/* Return the arm with the payload while it is carried, otherwise the arm without. */
static const simulated_arm *arm_of(const simulated_plant *plant)
{
    const simulated_arm *arms = (const simulated_arm *)plant->arms;
    return plant->signals[4 + IS_LOADED] != 0.0 ? arms + 1 : arms;
}

/* Write the derivative of an arm's state. */
static void arm_slope(const simulated_plant *plant, double *slope)
{
    const double *x = plant->signals, *held = x + 4;
    const simulated_arm *arm = arm_of(plant);
    const double twist = twist_of(arm, x);
    /* Pushes are subtracted: so a push of zero changes no bit, not even the sign of a zero. */
    const double drive =
        held[DRIVE] / arm->motor_inertia - (0.0 - held[ON_MOTOR]) / arm->motor_inertia;
    const double brake = (0.0 - held[ON_LINK]) / arm->link_inertia;
    slope[0] = x[1];
    slope[1] = arm->link_spring * twist - arm->gravity * sine(x[0]) - arm->link_drag * x[1]
               - rub(arm->link_rub, x[1]) - brake;
    slope[2] = x[3];
    slope[3] =
        drive - arm->motor_spring * twist - arm->motor_drag * x[3] - rub(arm->motor_rub, x[3]);
}

/* Write the torques that an arm without friction, play and payload would need: those held, minus
 * friction, minus the spring torque that play takes away, and on the link minus the torque that the
 * payload takes, dJ q1'' + dmgl sin q1. */
static void arm_outputs(const simulated_plant *plant, double *torques)
{
    const double *x = plant->signals, *held = x + 4;
    const simulated_arm *arm = arm_of(plant);
    torques[0] = held[ON_MOTOR] - arm->motor_viscous * x[3] - rub(arm->motor_coulomb, x[3]);
    torques[1] = held[ON_LINK] - arm->link_viscous * x[1] - rub(arm->link_coulomb, x[1]);
    if (arm->free_play > 0.0) {
        const double slack = x[2] - x[0] - twist_of(arm, x);
        torques[0] += arm->motor_inertia * arm->motor_spring * slack;
        torques[1] -= arm->link_inertia * arm->link_spring * slack;
    }
    if (arm->added_inertia > 0.0 || arm->added_gravity > 0.0) {
        double slope[4];
        arm_slope(plant, slope);
        torques[1] -= arm->added_inertia * slope[1] + arm->added_gravity * sine(x[0]);
    }
}

/* Write sum h_i M_i v for matrices M_i (rows, width) and v, a system's first `width` signals. */
static void blend(
    const simulated_plant *plant, const plant_sizes *s, const double *matrices, long rows,
    long width, double *result)
{
    multiply(plant->premise, plant->signals, plant->z, s->premises, SIGNALS(s), 1);
    rule_weights(
        plant->shapes, plant->parameters, plant->z, plant->weights, NULL, s->rules, s->premises);
    for (long row = 0; row < rows; row++) {
        result[row] = 0.0;
        for (long rule = 0; rule < s->rules; rule++) {
            const double *line = matrices + (rule * rows + row) * width;
            result[row] += plant->weights[rule] * dot(line, plant->signals, width);
        }
    }
}

/* Move a plant's state, with which the signals begin, by one integration step. */
static void step(const simulated_plant *plant, const plant_sizes *s)
{
    const long n = s->n;
    const double h = *plant->substep;
    double *x = plant->signals, *start = plant->start, *slope = plant->slopes;
    memcpy(start, x, (size_t)n * sizeof *x);
    for (int stage = 0; stage < 4; stage++, slope += n) {
        const double time = stage == 2 ? h : 0.5 * h;
        if (s->rules == 0) {
            arm_slope(plant, slope);
        } else {
            blend(plant, s, plant->rates, n, n + s->m, slope);
        }
        for (long i = 0; i < n; i++) {
            x[i] = start[i] + time * slope[i];
        }
    }
    slope = plant->slopes;
    for (long i = 0; i < n; i++, slope++) {
        x[i] = start[i] + h / 6.0 * (slope[0] + 2.0 * (slope[n] + slope[2 * n]) + slope[3 * n]);
    }
}

void simulate(
    const simulated_plant *plant, const plant_sizes *s, const double *inputs, const double *kicks,
    double *present, double *states, double *outputs, long runs, long samples)
{
    const long n = s->n, held = s->m + s->scheduled;
    const long noisy = noisy_count(s), stride = n / noisy;
    double *x = plant->signals;
    for (long run = 0; run < runs; run++, present += n) {
        memcpy(x, present, (size_t)n * sizeof *x);
        for (long k = 0; k < samples; k++) {
            memcpy(x + n, inputs, (size_t)held * sizeof *x);
            memcpy(states, x, (size_t)n * sizeof *x);
            if (s->rules == 0) {
                arm_outputs(plant, outputs);
            } else {
                blend(plant, s, plant->outputs, s->p, n, outputs);
            }
            for (int64_t taken = 0; taken < *plant->substeps; taken++) {
                step(plant, s);
                for (long i = 0; kicks != NULL && i < noisy; i++) {
                    x[stride * (i + 1) - 1] += plant->noise[i] * *kicks++;
                }
            }
            inputs += held;
            states += n;
            outputs += s->p;
        }
        memcpy(present, x, (size_t)n * sizeof *x);
    }
}
