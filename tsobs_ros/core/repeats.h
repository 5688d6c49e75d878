/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Repetitions of a sample's value that speak for a stuck sensor.
 *
 * If a sensor's noise hides its steps, every repetition counts. Else it repeats its value whenever
 * the arm rests or moves by less than a step. Then a repetition counts only if the prediction has
 * left the value: if the innovation exceeds the least that it has been since the value came by more
 * than a step and the prediction's own standard deviation, sqrt(S - R).
 *
 * The step is learnt as the smallest difference of successive values. It grows by a fiftieth with
 * each difference, so that a single odd value is forgotten. The noise is learnt as the running
 * median of the differences of successive innovations, as the arm's motion is not in them.
 */
#ifndef TSOBS_REPEATS_H
#define TSOBS_REPEATS_H

#include "layout.h"

/* Fields of a record that has these numbers. */
#define REPETITION_FIELDS(F, s)                                             \
    F(NUMBER, value, 1, 1)   /* latest one, NaN before the first */         \
    F(NUMBER, step, 1, 1)    /* of the sensor, 0 before the first, */       \
    F(NUMBER, rough, 1, 1)   /* and of its innovations' differences */      \
    F(NUMBER, before, 1, 1)  /* innovation of the sample before */          \
    F(NUMBER, nearest, 1, 1) /* least size of an innovation of the value */ \
    F(COUNT, repeats, 1, 1)  /* repetitions that count */
typedef struct {
    REPETITION_FIELDS(LAYOUT_POINTER, unused)
} repetition;

/* Return where a record has them, given a view with fields of these names. */
#define REPETITION_OF(view)                                                        \
    ((repetition){(view)->value, (view)->step, (view)->rough, (view)->before,      \
                  (view)->nearest, (view)->repeats})

/* Take in a sample y with its innovation, of which the variance S is expected and, of the sample's
 * noise, R. Values that differ by no more than the tolerance are the same. */
void count_repeats(
    repetition of, double y, double innovation, double variance, double noise, double tolerance);

#endif
