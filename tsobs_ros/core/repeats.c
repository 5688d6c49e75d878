/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "repeats.h"

#include <math.h>

/* Growth of what is learnt, and how many times larger than a step the noise is that hides it. */
static const double RATE = 1.02, HIDDEN = 3.0;

/* Learn the sensor's step and noise from a change of its value and of its innovation. */
static void learn_step(repetition of, double difference, double change)
{
    if (!isfinite(difference) || !isfinite(change)) {
        return;
    }
    if (*of.step == 0.0) {
        *of.step = difference;
        *of.rough = change;
        return;
    }
    *of.step = RATE * *of.step < difference ? RATE * *of.step : difference;
    if (change > *of.rough) {
        *of.rough *= RATE;
    } else {
        *of.rough /= RATE;
    }
}

void count_repeats(
    repetition of, double y, double innovation, double variance, double noise, double tolerance)
{
    const double distance = fabs(innovation), difference = fabs(y - *of.value);
    if (difference <= tolerance) {
        const double known = variance - noise;
        const double own = known > 0.0 ? sqrt(known) : 0.0;
        const double step = *of.step > 0.0 ? *of.step : sqrt(noise);
        if (distance < *of.nearest) {
            *of.nearest = distance;
        }
        if (*of.rough > HIDDEN * step || distance > *of.nearest + step + own) {
            *of.repeats += 1;
        }
    } else {
        learn_step(of, difference, fabs(innovation - *of.before));
        *of.value = y;
        *of.nearest = distance;
        *of.repeats = 0;
    }
    *of.before = innovation;
}
