/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Small matrices and elementary functions, with the same bits on every CPU: all products and sums
 * are taken in a fixed order.
 *
 * A BLAS library chooses its kernels by the CPU. The system's functions have variants with and
 * without fused multiply-add, which differ in the last bit of one sine in 1,300.
 */
#ifndef TSOBS_ARITHMETIC_H
#define TSOBS_ARITHMETIC_H

#include <math.h>
#include <stddef.h>

/* Return the smaller and the larger of two numbers; the first one if either is NaN. */
static inline double minimum(double a, double b)
{
    return b < a ? b : a;
}

static inline double maximum(double a, double b)
{
    return b > a ? b : a;
}

static inline double clip(double value, double least, double most)
{
    return minimum(maximum(value, least), most);
}

/* --- matrices, stored by rows. An argument `..._width` is the number of doubles from one row of
 * the preceding matrix to the next; the rows of all other matrices follow without a gap. A result
 * must not be an argument at the same time unless stated. --- */

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

/* Call a function whose last argument is a size. Most models have 4 to FEW states: for these the
 * size is a constant, so that the compiler unrolls the loops, which halves the time. For that, few
 * results (up to FEW) are computed on the stack, where nothing aliases them, and then copied. */
enum { FEW = 9 };
#define WITH_SIZE(n, call, ...)                                                     \
    switch (n) {                                                                    \
    case 4: call(__VA_ARGS__, 4); break; case 5: call(__VA_ARGS__, 5); break;       \
    case 6: call(__VA_ARGS__, 6); break; case 7: call(__VA_ARGS__, 7); break;       \
    case 8: call(__VA_ARGS__, 8); break; case FEW: call(__VA_ARGS__, FEW); break;   \
    default: call(__VA_ARGS__, n);                                                  \
    }

/* Write the sum of the rows of b (count, columns), each multiplied by its factor. */
static inline void combine(
    const double *factors, const double *b, long b_width, double *restrict result, long count,
    long columns)
{
    double few[FEW], *row = columns <= FEW ? few : result;
    for (long j = 0; j < columns; j++) {
        row[j] = 0.0;
    }
    for (long k = 0; k < count; k++) {
        add_scaled(row, factors[k], b + k * b_width, columns);
    }
    for (long j = 0; j < columns; j++) {
        result[j] = row[j];
    }
}

/* Write the product a b of a (rows, inner) and b (inner, columns). */
static inline void multiply(
    const double *a, const double *b, double *result, long rows, long inner, long columns)
{
    for (long i = 0; i < rows; i++) {
        combine(a + i * inner, b, columns, result + i * columns, inner, columns);
    }
}

/* Replace a symmetric s (n, n) by a s a' for a (n, n), and add the symmetric matrix `added` (count,
 * count) to its first rows and columns. `half` (n, n) is scratch; `added` may be s itself. */
static inline void congruence(
    const double *a, double *s, long s_width, const double *added, long count, double *half, long n)
{
    for (long i = 0; i < n; i++) {
        combine(a + i * n, s, s_width, half + i * n, n, n);
    }
    for (long j = 0; j < n; j++) {
        for (long i = 0; i <= j; i++) {
            const double value = dot(a + j * n, half + i * n, n);
            s[i * s_width + j] = s[j * s_width + i]
                = j < count ? value + added[i * count + j] : value;
        }
    }
}

/* Return a' s a for s (n, n). */
double quadratic(const double *s, long s_width, const double *a, long n);

/* Return whether a symmetric s (n, n) is positive semidefinite; its upper part is overwritten. */
int is_nonnegative(double *s, long n);

/* Write s^-1 b into `result` (n), for a symmetric positive definite s (n, n).
 *
 * The factors s = L D L' make a 1 x 1 system a single division. `factor` (n, n) is scratch. The
 * result for a singular s is not finite. */
void solve(const double *s, const double *b, double *factor, double *result, long n);

/* Copy a matrix (rows, columns) into `result`. */
void copy_matrix(
    const double *source, long source_width, double *result, long result_width, long rows,
    long columns);

/* --- elementary functions, with the polynomials of Sun's fdlibm: within two units in the last
 * place of the true value, for angles up to 10^6 rad. An angle that is not finite gives NaN. --- */

/* Return the sine of an angle [rad]. */
double sine(double angle);

/* Write the sine and cosine of an angle [rad]; both together cost little more than one. */
void sine_and_cosine(double angle, double *sin, double *cos);

/* Return exp x for x <= 0, and NaN for NaN. */
double exponential(double x);

/* Return the natural logarithm of a finite x > 0, and NaN for all others. */
double logarithm(double x);

#endif
