/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "arithmetic.h"

double quadratic(const double *s, long s_width, const double *a, long n)
{
    double total = 0.0;
    for (long i = 0; i < n; i++) {
        for (long j = 0; a[i] != 0.0 && j < n; j++) { /* most entries are 0 */
            total += a[j] != 0.0 ? a[i] * s[i * s_width + j] * a[j] : 0.0;
        }
    }
    return total;
}

int is_nonnegative(double *s, long n)
{
    for (long first = 0; first < n; first++) {
        const double *top = s + first * n;
        const double pivot = top[first];
        if (!(pivot > 0.0)) { /* also if it is NaN */
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
    for (long j = 0; j < n; j++) { /* L below the diagonal, D on it */
        for (long i = j; i < n; i++) {
            double total = s[i * n + j];
            for (long k = 0; k < j; k++) {
                total -= factor[i * n + k] * factor[j * n + k] * factor[k * n + k];
            }
            factor[i * n + j] = i == j ? total : total / factor[j * n + j];
        }
    }
    for (long i = 0; i < n; i++) {
        result[i] = b[i];
        for (long k = 0; k < i; k++) {
            result[i] -= factor[i * n + k] * result[k];
        }
    }
    for (long i = n - 1; i >= 0; i--) {
        result[i] /= factor[i * n + i];
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

/* --- elementary functions --- */

#define PI 3.14159265358979323846

/* Return the sine of an angle within +-pi/4. */
static double first_sine(double angle)
{
    const double z = angle * angle;
    double r = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10;
    r = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * r);
    r = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * r);
    return angle + angle * z * r;
}

/* Return the cosine of an angle within +-pi/4. */
static double first_cosine(double angle)
{
    const double z = angle * angle, half = 0.5 * z, value = 1.0 - half;
    double r = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11;
    r = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * r);
    r = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * r);
    return value + (((1.0 - value) - half) + z * (z * r));
}

void sine_and_cosine(double angle, double *sin, double *cos)
{
    long quarters = 0;
    if (!(fabs(angle) <= 1e6)) {
        /* This loses less than the rounding of so large an angle does. */
        angle = fmod(angle, 2.0 * PI);
    }
    if (fabs(angle) > 0.25 * PI) {
        quarters = (long)floor(angle * (2.0 / PI) + 0.5);
        /* pi/2 is subtracted in three parts. The first two have 33 bits, so that their small
         * multiples are exact. */
        angle -= (double)quarters * 1.57079632673412561417e00;
        angle -= (double)quarters * 6.07710050630396597660e-11;
        angle -= (double)quarters * 2.02226624879595063154e-21;
    }
    const double at_sine = first_sine(angle), at_cosine = first_cosine(angle);
    /* A quarter of a turn takes (sin, cos) to (cos, -sin). */
    *sin = quarters & 1 ? at_cosine : at_sine;
    *cos = quarters & 1 ? at_sine : at_cosine;
    *sin = quarters & 2 ? -*sin : *sin;
    *cos = (quarters + 1) & 2 ? -*cos : *cos;
}

double sine(double angle)
{
    double sin, cos;
    sine_and_cosine(angle, &sin, &cos);
    return sin;
}

double exponential(double x)
{
    if (!(x >= -745.2)) {
        return isnan(x) ? x : 0.0;
    }
    const double whole = floor(x * 1.44269504088896338700e00 + 0.5);
    const double high = x - whole * 6.93147180369123816490e-01;
    const double low = whole * 1.90821492927058770002e-10, r = high - low, t = r * r;
    double c = -1.65339022054652515390e-06 + t * 4.13813679705723846039e-08;
    c = 6.61375632143793436117e-05 + t * c;
    c = -2.77777777770155933842e-03 + t * c;
    c = r - t * (1.66666666666666019037e-01 + t * c);
    return ldexp(1.0 - ((low - r * c / (2.0 - c)) - high), (int)whole);
}

double logarithm(double x)
{
    int power;
    if (!(0.0 < x && x < HUGE_VAL)) {
        return (double)NAN;
    }
    double mantissa = frexp(x, &power);
    if (mantissa < 0.70710678118654752440) {
        mantissa *= 2.0;
        power -= 1;
    }
    const double f = mantissa - 1.0, s = f / (2.0 + f), z = s * s, w = z * z;
    double even = w * (0.2222219843214978396 + w * 0.1531383769920937332);
    even = w * (0.3999999999940941908 + even);
    double odd = w * (0.1818357216161805012 + w * 0.1479819860511658591);
    odd = w * (0.2857142874366239149 + odd);
    odd = z * (0.6666666666666735130 + odd);
    const double half = 0.5 * f * f, low = power * 1.90821492927058770002e-10;
    return power * 6.93147180369123816490e-01 - ((half - (s * (half + even + odd) + low)) - f);
}
