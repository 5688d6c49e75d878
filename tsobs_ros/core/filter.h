/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * What the parts of the estimator share: filter.c (correction, prediction), supervision.c,
 * learning.c, torque.c, bank.c, readout.c.
 */
#ifndef TSOBS_FILTER_H
#define TSOBS_FILTER_H

#include <math.h>

#include "estimator.h"
#include "matrices.h"
#include "repeats.h"
#include "trigonometry.h"

/* A larger `nis` contradicts a certified bound, and so does a larger coloured power. */
#define MAX_NIS 3.0
#define MAX_COLOUR 0.5

/* The smaller and the larger of two numbers; the first if one of them is NaN. */
static inline double minimum(double a, double b)
{
    return b < a ? b : a;
}

static inline double maximum(double a, double b)
{
    return b > a ? b : a;
}

/* Write a matrix into another, both in rows of `width`. */
static inline void copy_rows(
    const double *source, double *result, long rows, long columns, long width)
{
    copy_matrix(source, width, result, width, rows, columns);
}

/* --- filter.c --- */

/* Number of states, of the unknown torque too while it is. */
static inline long width_in_use(const model *m, const state *at)
{
    return (long)(*at->in_gap != 0 ? m->s.n_gap : m->s.n);
}

/* Write the innovation of a measurement, its covariance and the gain for it. */
void expect(const model *m, state *at, correction *effect);

/* Take the certificate's bound for the covariance, from where Riccati gains go on. */
void leave_certified(const model *m, state *at, int64_t cause);

/* --- learning.c --- */

void learn(const model *m, state *at, correction *effect, int adapt, double inflation);
int moves(const model *m, state *at);
void guard(const model *m, state *at);
void unlearn(const model *m, state *at);
void keep_nothing_else(const model *m, state *at);
void forget_slowly(const model *m, state *at, double duration);

/* --- supervision.c --- */

int judge(const model *m, state *at, correction *effect);
void follow_jumps(const model *m, state *at);
void limit_disturbances(const model *m, double *x, const double *covariance, long n);
double samples_in_one(const state *at);

/* --- torque.c --- */

static inline int is_suspected(const state *at)
{
    return isfinite(*at->step_age) != 0;
}

void begin_step(const model *m, state *at);
void forget_step(const model *m, state *at);
void follow_step(const model *m, state *at, double duration, work *scratch);
int weigh_step(const model *m, state *at, const correction *effect);
void correct_response(const model *m, state *at, correction *effect);
int is_open(const state *at);
void distrust_torque(const model *m, state *at);
void enter_gap(const model *m, state *at);

/* --- bank.c --- */

void weigh(const model *m, state *at, correction *effect);
void bank_sleep(const model *m, state *at);
void adopt(const model *m, state *at);
void predict_alternatives(
    const model *m, state *at, const double *u, double duration, work *scratch);

#endif
