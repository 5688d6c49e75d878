/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The exact flow of a linear system with a held input and white noise, over a step of any length.
 *
 * Phi' = A Phi, Gamma' = A Gamma + B, Q' = A Q + Q A' + W, by their Taylor series with precomputed
 * coefficients: a step then costs one evaluation of polynomials, which matters because real stamps
 * jitter. Where a step is long for the fastest mode, the series serves a fraction 2^-s of it and is
 * doubled s times; a sum of positive semidefinite terms, so the noise stays a covariance.
 */
#include <math.h>
#include <string.h>

#include "flow.h"
#include "matrices.h"

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
    double *values = scratch, *first = values + width, *second = first + squares;
    double *forced = second + squares;
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
        for (long place = 0; place < gammas; place++) {
            gamma[place] += forced[place];
        }
        if (noise != NULL) {
            congruence(phi, n, noise, n, noise, first, second, n, n, n);
            memcpy(noise, second, (size_t)squares * sizeof *noise);
        }
        multiply(phi, phi, first, n, n, n);
        memcpy(phi, first, (size_t)squares * sizeof *phi);
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
