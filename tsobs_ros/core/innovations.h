/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Innovations of a log: what a plain Kalman filter of a model does not expect of each sample.
 *
 * Their likelihood is that of the model (the prediction error decomposition), which identification
 * maximises. The filter is that of one hypothesis without supervision, and has Coulomb friction,
 * which the design's flow has not.
 */
#ifndef TSOBS_INNOVATIONS_H
#define TSOBS_INNOVATIONS_H

#include "estimator.h"

/* A log of n samples.
 *
 * durations: time from each sample to the next [s], negative where the next one begins anew, (n,).
 * y: outputs, NaN if missing, (n, p). u: inputs held until the next sample, (n, m). */
typedef struct {
    int64_t count;
    const double *durations, *y, *u;
} sample_log;

/* What the filter knows beside the model: Coulomb friction as the deceleration of link and motor, in
 * design coordinates [1/s^2], and the sigmas beyond which an output is left out. */
typedef struct {
    double link_friction, motor_friction, gate;
} filter_options;

/* Number of the scratch's numbers. */
size_t innovations_scratch_size(const model *m);

/* Filter a log from the model's initial state on. Write y - C x of each output given those before it,
 * and its variance, NaN of an output that is missing, (n, p) each; and the states before each sample,
 * (n, n), unless NULL. Without a `corrected_until` below n the filter runs free from that sample on:
 * innovations are those of a simulation. */
void write_innovations(
    const model *m, const sample_log *log, const filter_options *options, int64_t corrected_until,
    double *innovations, double *variances, double *states, double *scratch);

#endif
