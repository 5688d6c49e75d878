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

/* Return sin or cos of an angle [rad]. */
double sine(double angle);
double cosine(double angle);

/* Write sin and cos of an angle [rad], which together cost little more than one of them. */
void sine_and_cosine(double angle, double *sin, double *cos);

/* Return exp x for x <= 0; NaN of NaN. */
double exponential(double x);

/* Return the natural logarithm of x > 0; NaN of other numbers. */
double logarithm(double x);

#endif
