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
 * argument at the same time unless stated. --- */

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

/* Call a function whose last argument is a size. A compiler that knows it makes straight code of
 * loops, which takes half the time: most models have one of these numbers of states. So FEW results
 * are made on the stack, which nothing else points to, and written together. */
enum { FEW = 9 };
#define WITH_SIZE(n, call, ...)                                                     \
    switch (n) {                                                                    \
    case 4: call(__VA_ARGS__, 4); break; case 5: call(__VA_ARGS__, 5); break;       \
    case 6: call(__VA_ARGS__, 6); break; case 7: call(__VA_ARGS__, 7); break;       \
    case 8: call(__VA_ARGS__, 8); break; case FEW: call(__VA_ARGS__, FEW); break;   \
    default: call(__VA_ARGS__, n);                                                  \
    }

/* Write the sum of rows of b, (count, columns), each by its factor; those by 0 are left out unless
 * `all` are asked for, as most of a map is 0. */
static inline void combine(
    const double *factors, const double *b, long b_width, double *restrict result, int all,
    long count, long columns)
{
    double few[FEW], *row = columns <= FEW ? few : result;
    for (long j = 0; j < columns; j++) {
        row[j] = 0.0;
    }
    for (long k = 0; k < count; k++) {
        if (all || factors[k] != 0.0) {
            add_scaled(row, factors[k], b + k * b_width, columns);
        }
    }
    for (long j = 0; j < columns; j++) {
        result[j] = row[j];
    }
}

/* Write a b for a (rows, inner) and b (inner, columns). */
static inline void multiply(
    const double *a, const double *b, double *result, long rows, long inner, long columns)
{
    for (long i = 0; i < rows; i++) {
        combine(a + i * inner, b, columns, result + i * columns, 1, inner, columns);
    }
}

/* Replace s by a s a', symmetric, for a and a symmetric s (n, n), and add a symmetric matrix to its
 * first rows and columns, (count, count). `half` (n, n) is scratch; added may be s. */
static inline void congruence(
    const double *a, double *s, long s_width, const double *added, long count, double *half, long n)
{
    double trace = 0.0;
    for (long i = 0; i < n; i++) {
        trace += s[i * (s_width + 1)];
    }
    const int all = !isfinite(trace); /* which has to show everywhere */
    for (long i = 0; i < n; i++) {
        combine(a + i * n, s, s_width, half + i * n, all, n, n);
    }
    for (long j = 0; j < n; j++) {
        const double *row = a + j * n;
        long first = 0;
        while (!all && first < n && row[first] == 0.0) {
            first++;
        }
        for (long i = 0; i <= j; i++) {
            const double value = dot(row + first, half + i * n + first, n - first);
            s[i * s_width + j] = s[j * s_width + i]
                = j < count ? value + added[i * count + j] : value;
        }
    }
}

/* Return a' s a for s (n, n). */
double quadratic(const double *s, long s_width, const double *a, long n);

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
