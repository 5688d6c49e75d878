/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "matrices.h"

double quadratic(const double *s, long s_width, const double *a, long n)
{
    double total = 0.0;
    for (long i = 0; i < n; i++) {
        for (long j = 0; j < n; j++) {
            total += a[i] * s[i * s_width + j] * a[j];
        }
    }
    return total;
}

void multiply(
    const double *a, const double *b, double *restrict result, long rows, long inner, long columns)
{
    /* Whole rows of b are added up, which makes vector instructions of the inner loop. */
    for (long i = 0; i < rows; i++) {
        double *restrict row = result + i * columns;
        for (long j = 0; j < columns; j++) {
            row[j] = 0.0;
        }
        for (long k = 0; k < inner; k++) {
            const double factor = a[i * inner + k];
            const double *restrict other = b + k * columns;
            for (long j = 0; j < columns; j++) {
                row[j] += factor * other[j];
            }
        }
    }
}

void congruence(const double *a, double *s, const double *added, double *scratch, long n)
{
    double *half = scratch, *whole = half + n * n, *turned = whole + n * n;
    for (long i = 0; i < n; i++) {
        for (long j = 0; j < n; j++) {
            turned[j * n + i] = a[i * n + j];
        }
    }
    multiply(a, s, half, n, n, n);
    multiply(half, turned, whole, n, n, n);
    for (long i = 0; i < n; i++) {
        for (long j = i; j < n; j++) {
            s[i * n + j] = s[j * n + i] = whole[i * n + j] + added[i * n + j];
        }
    }
}

int is_nonnegative(double *s, long n)
{
    for (long first = 0; first < n; first++) {
        const double *top = s + first * n;
        const double pivot = top[first];
        if (!(pivot > 0.0)) { /* which NaN is not either */
            for (long column = first; column < n; column++) {
                if (top[column] != 0.0) {
                    return 0;
                }
            }
            continue;
        }
        for (long row = first + 1; row < n; row++) {
            const double share = top[row] / pivot;
            for (long column = row; column < n; column++) {
                s[row * n + column] -= share * top[column];
            }
        }
    }
    return 1;
}

void solve(const double *s, const double *b, double *factor, double *result, long n)
{
    for (long j = 0; j < n; j++) { /* L and, on the diagonal, D */
        double *at_j = factor + j * n;
        double pivot = s[j * n + j];
        for (long k = 0; k < j; k++) {
            pivot -= at_j[k] * at_j[k] * factor[k * n + k];
        }
        at_j[j] = pivot;
        for (long i = j + 1; i < n; i++) {
            double total = s[i * n + j];
            for (long k = 0; k < j; k++) {
                total -= factor[i * n + k] * at_j[k] * factor[k * n + k];
            }
            factor[i * n + j] = total / pivot;
        }
    }
    for (long i = 0; i < n; i++) {
        result[i] = b[i];
        for (long k = 0; k < i; k++) {
            result[i] -= factor[i * n + k] * result[k];
        }
    }
    for (long i = 0; i < n; i++) {
        result[i] /= factor[i * n + i];
    }
    for (long i = n - 1; i >= 0; i--) {
        for (long k = i + 1; k < n; k++) {
            result[i] -= factor[k * n + i] * result[k];
        }
    }
}

void copy_matrix(
    const double *source, long source_width, double *result, long result_width, long rows,
    long columns)
{
    for (long i = 0; i < rows; i++) {
        for (long j = 0; j < columns; j++) {
            result[i * result_width + j] = source[i * source_width + j];
        }
    }
}
