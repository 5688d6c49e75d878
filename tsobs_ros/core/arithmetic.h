/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Matrices of a few rows and elementary functions, with the same bits on every CPU: products and
 * sums in a fixed order.
 *
 * A BLAS library has other kernels for other CPUs. The system's functions have variants with and
 * without fused multiplication and addition, which disagree in the last bit of one sine in 1,300.
 */
#ifndef TSOBS_ARITHMETIC_H
#define TSOBS_ARITHMETIC_H

#include <math.h>
#include <stddef.h>

/* --- matrices, stored by rows: one with an argument `..._width` behind it has rows that begin so
 * many numbers apart; the rows of all others are as long as they are used. Results must not be an
 * argument at the same time unless that is said. --- */

/* Return a . b. */
static inline double dot(const double *a, const double *b, long n)
{
    double total = 0.0;
    for (long i = 0; i < n; i++) {
        total += a[i] * b[i];
    }
    return total;
}

/* Return how many of the first n numbers are finite. */
static inline long count_finite(const double *a, long n)
{
    long found = 0;
    for (long i = 0; i < n; i++) {
        found += isfinite(a[i]) != 0;
    }
    return found;
}

/* Add c x to y. */
static inline void add_scaled(double *restrict y, double c, const double *restrict x, long n)
{
    for (long i = 0; i < n; i++) {
        y[i] += c * x[i];
    }
}

/* Write a x for a (n, n). */
static inline void transform(const double *a, const double *x, double *result, long n)
{
    for (long i = 0; i < n; i++) {
        result[i] = dot(a + i * n, x, n);
    }
}

/* Return a' s a for s (n, n). */
double quadratic(const double *s, long s_width, const double *a, long n);

/* Write a b for a (rows, inner) and b (inner, columns). */
void multiply(
    const double *a, const double *b, double *result, long rows, long inner, long columns);

/* Replace s by a s a' + added, symmetric, for a (n, n), and s and added (n, n) symmetric.
 * `scratch` has 3 n^2 numbers; added may be s. */
void congruence(const double *a, double *s, const double *added, double *scratch, long n);

/* Return whether a symmetric matrix (n, n) is positive semidefinite; overwrites its upper part. */
int is_nonnegative(double *s, long n);

/* Write s^-1 b into `result` (n), for a symmetric positive definite s.
 *
 * By s = L D L', so that a 1 x 1 system is one division. `factor` (n, n) is scratch. What comes of
 * a singular s is not finite. */
void solve(const double *s, const double *b, double *factor, double *result, long n);

/* Write a matrix (rows, columns) into `result`. */
void copy_matrix(
    const double *source, long source_width, double *result, long result_width, long rows,
    long columns);

/* --- elementary functions, by the polynomials of Sun's fdlibm: within two units in the last place
 * of the true value, up to 10^6 rad. Of an angle that is not finite they are NaN. --- */

/* Return sin of an angle [rad]. */
double sine(double angle);

/* Write sin and cos of an angle [rad], which together cost little more than one of them. */
void sine_and_cosine(double angle, double *sin, double *cos);

/* Return exp x for x <= 0; NaN of NaN. */
double exponential(double x);

/* Return the natural logarithm of x > 0; NaN of other numbers. */
double logarithm(double x);

#endif
