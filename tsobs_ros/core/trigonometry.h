/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Sine, cosine, the falling exponential and the logarithm with the same bits on every CPU.
 *
 * The system's differ: glibc has variants with and without fused multiplication and addition, which
 * disagree in the last bit of one sine in 1,300. These are products and sums in a fixed order (the
 * polynomials of Sun's fdlibm), within two units in the last place of the true value, up to 10^6
 * rad. Of an angle that is not finite they are NaN.
 */
#ifndef TSOBS_TRIGONOMETRY_H
#define TSOBS_TRIGONOMETRY_H

#include <math.h>

#define HALF_PI 1.57079632679489661923
#define TWO_PI 6.28318530717958647693

/* Return sin of an angle [rad]. */
double sine(double angle);

/* Return cos of an angle [rad]. */
double cosine(double angle);

/* Write sin and cos of an angle [rad], which together cost little more than one of them. */
void sine_and_cosine(double angle, double *sin, double *cos);

/* Return exp x for x <= 0; NaN of NaN. */
double exponential(double x);

/* Return the natural logarithm of x > 0; NaN of other numbers. */
double logarithm(double x);

/* Return the largest whole number up to x, for |x| < 2^51, without a call. */
static inline double round_down(double x)
{
    const double whole = (x + 6755399441055744.0) - 6755399441055744.0; /* 1.5 * 2^52 */
    return whole > x ? whole - 1.0 : whole;
}

/* Return an angle less `whole` quarters of a turn: pi/2 in three parts, the first two of 33 bits,
 * so that small multiples of them are exact. */
static inline double less_quarters(double angle, double whole)
{
    const double first = angle - whole * 1.57079632673412561417e00;
    const double second = first - whole * 6.07710050630396597660e-11;
    return second - whole * 2.02226624879595063154e-21;
}

/* Return the sine up to pi/4. */
static inline double first_sine(double angle)
{
    const double z = angle * angle;
    double r = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10;
    r = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * r);
    r = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * r);
    return angle + angle * z * r;
}

/* Return the cosine up to pi/4. */
static inline double first_cosine(double angle)
{
    const double z = angle * angle;
    const double half = 0.5 * z, value = 1.0 - half;
    double r = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11;
    r = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * r);
    r = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * r);
    return value + (((1.0 - value) - half) + z * (z * r));
}

#endif
