/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Grades of membership functions, and the rule weights that follow from them.
 */
#include "arithmetic.h"
#include "flow.h"

/* 1 between b and c, falling linearly to 0 at a and d; a and b, or c and d, may be infinite. */
static double trapezoid(double z, const double *corners, double *slope)
{
    const double a = corners[0], b = corners[1], c = corners[2], d = corners[3];
    if (a <= z && z < b) {
        *slope = 1.0 / (b - a);
        return (z - a) / (b - a);
    }
    if (c <= z && z < d) {
        *slope = -1.0 / (d - c);
        return (d - z) / (d - c);
    }
    *slope = 0.0;
    return b <= z && z < c ? 1.0 : 0.0;
}

/* exp(-((z - centre)/width)^2/2). */
static double gaussian(double z, double centre, double width, double *slope)
{
    const double distance = (z - centre) / width;
    const double grade = exponential(-0.5 * distance * distance);
    *slope = grade > 0.0 ? -distance / width * grade : 0.0;
    return grade;
}

/* (z/half_width)^2 for |z| < half_width, and 1 with slope 0 outside. */
static double square(double z, double half_width, double *slope)
{
    const double share = z / half_width;
    if (fabs(z) >= half_width) {
        *slope = 0.0;
        return 1.0;
    }
    *slope = 2.0 * share / half_width;
    return share * share;
}

/* h in sin z = (h + (1 - h) bottom) z for |z| < half_width, and 0 with slope 0 outside. */
static double share_of_sine(double z, double half_width, double bottom, double *slope)
{
    double sin, cos;
    if (fabs(z) >= half_width) {
        *slope = 0.0;
        return 0.0;
    }
    sine_and_cosine(z, &sin, &cos);
    /* (z cos z - sin z)/z^2 loses all its digits near 0, where a series takes its place. */
    const int is_small = fabs(z) < 1e-3;
    const double fall = is_small ? -z / 3.0 + z * z * z / 30.0 : (z * cos - sin) / (z * z);
    const double ratio = z != 0.0 ? sin / z : 1.0;
    *slope = fall / (1.0 - bottom);
    return clip((ratio - bottom) / (1.0 - bottom), 0.0, 1.0); /* beyond only by rounding */
}

/* Return the grade at z and write its slope, which at a corner is that of one side. Both are NaN if
 * z is, except for SHAPE_ALWAYS. There are four `parameters`. */
static double grade_and_slope(int64_t shape, double z, const double *parameters, double *slope)
{
    double grade;
    *slope = 0.0;
    if (shape == SHAPE_ALWAYS) {
        return 1.0;
    }
    if (isnan(z)) {
        *slope = z;
        return z;
    }
    switch (shape) {
    case SHAPE_TRAPEZOID:
        return trapezoid(z, parameters, slope);
    case SHAPE_GAUSSIAN:
        return gaussian(z, parameters[0], parameters[1], slope);
    case SHAPE_SQUARE:
    case SHAPE_SQUARE_REST:
        grade = square(z, parameters[0], slope);
        break;
    default:
        grade = share_of_sine(z, parameters[0], parameters[1], slope);
    }
    if (shape == SHAPE_SINE_UPPER || shape == SHAPE_SQUARE) {
        return grade;
    }
    *slope = -*slope;
    return 1.0 - grade;
}

void rule_weights(
    const int64_t *shapes, const double *parameters, const double *z, double *weights,
    double *slopes, long r, long q)
{
    double total = 0.0;
    for (long i = 0; i < r; i++) {
        weights[i] = 1.0;
        for (long j = 0; j < q; j++) {
            const long place = i * q + j;
            double slope;
            const double grade
                = grade_and_slope(shapes[place], z[j], parameters + 4 * place, &slope);
            if (slopes != NULL) {
                for (long before = i * q; before < place; before++) {
                    slopes[before] *= grade;
                }
                slopes[place] = slope * weights[i];
            }
            weights[i] *= grade;
        }
        total += weights[i];
    }
    for (long i = 0; i < r; i++) {
        weights[i] = total > 0.0 ? weights[i] / total : (double)NAN;
    }
    for (long j = 0; slopes != NULL && j < q; j++) {
        double sum_of_slopes = 0.0;
        for (long i = 0; i < r; i++) {
            slopes[i * q + j] /= total;
            sum_of_slopes += slopes[i * q + j];
        }
        for (long i = 0; i < r; i++) {
            slopes[i * q + j] -= weights[i] * sum_of_slopes;
        }
    }
}
