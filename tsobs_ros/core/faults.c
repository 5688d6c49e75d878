/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "faults.h"

#include <math.h>
#include <string.h>

#include "estimator.h"

/* Values that differ by so many sigmas are the same. A sensor is stuck after so long [ns] with so
 * many repetitions that count, and missing after so long [ns]. */
static const double SAME_SIGMAS = 0.02;
static const int64_t STUCK_TIME = 100000000, STUCK_SAMPLES = 10, MISSING_TIME = 100000000;

/* Times over which squares and outliers are averaged [s], and the clip in sigmas. */
static const double MEMORY = 1.0, OUTLIER_MEMORY = 5.0, CLIP = 5.0;

/* Length of a block, the longest gap in a history [ns], and blocks after a sensor was stuck. */
static const int64_t BLOCK = 100000000, LONGEST_GAP = 1000000000, RECOVERY_BLOCKS = 100;

/* Return the share that a time since the last sample [ns] has in an average over a time [s]. */
static double share_of(int64_t elapsed, double time)
{
    const double share = (double)elapsed * 1e-9 / time;
    return share < 1.0 ? share : 1.0;
}

/* Return a normalised innovation within +-5 sigmas. */
static double clipped(double normalised)
{
    const double least = normalised < CLIP ? normalised : CLIP;
    return least > -CLIP ? least : -CLIP;
}

/* Forget the history of a sensor's disturbance. */
static void renew(const watch *of, int64_t reason, int64_t least)
{
    *of->begun = *of->block = *of->in_block = *of->count = 0;
    of->sums[0] = of->sums[1] = of->sums[2] = 0.0;
    *of->renewed = reason;
    *of->least = least;
}

/* Look whether a raw sample repeats those before it. */
static void compare(
    const watch *of, int64_t stamp, double y, double innovation, double expected_std)
{
    const int was_stuck = *of->stuck != 0;
    const double value = *of->value, noise = *of->std * *of->std;
    count_repeats(
        REPETITION_OF(of), y, innovation, expected_std * expected_std, noise,
        SAME_SIGMAS * *of->std);
    if (*of->value != value) {
        *of->since = stamp;
        *of->stuck = 0;
    } else if (*of->repeats >= STUCK_SAMPLES && stamp - *of->since >= STUCK_TIME) {
        *of->stuck = 1;
    }
    if (was_stuck && *of->stuck == 0) {
        /* The past is no guide to the future, and the estimate was led astray. */
        renew(of, 2, RECOVERY_BLOCKS);
    }
}

/* Take in whether a sample is an outlier: far off, and not as those of a jump all are. */
static void count_outlier(const watch *of, int64_t stamp, double normalised)
{
    const double value = clipped(normalised);
    const double outlier = fabs(value) == CLIP && value != *of->last ? 1.0 : 0.0;
    if (stamp <= *of->seen) {
        return;
    }
    if (*of->seen != 0) {
        const double share = share_of(stamp - *of->seen, OUTLIER_MEMORY);
        *of->outliers += share * (outlier - *of->outliers);
    }
    *of->seen = stamp;
    *of->last = value;
}

/* Take in an innovation divided by its expected 1 sigma; late ones pass by. */
static void average(const watch *of, int64_t stamp, double normalised)
{
    const double value = clipped(normalised);
    if (*of->stamp != 0) {
        double share;
        if (stamp <= *of->stamp) {
            return;
        }
        *of->period = (double)(stamp - *of->stamp) * 1e-9;
        share = share_of(stamp - *of->stamp, MEMORY);
        *of->square += share * (value * value - *of->square);
        *of->product += share * (value * *of->normalised - *of->product);
    }
    *of->stamp = stamp;
    *of->normalised = value;
}

/* Take in one sample of one sensor. */
static void add_sample(
    const watch *of, int64_t stamp, int64_t code, double y, double innovation, double expected_std)
{
    const int corrects = code == USED || code == IMPLAUSIBLE_TORQUE || code == UNKNOWN_INPUT;
    if (code == NON_FINITE && stamp > 0) {
        if (*of->lacking == 0) {
            *of->lacking = stamp;
        }
        *of->missing = stamp - *of->lacking >= MISSING_TIME;
    }
    if (corrects || code == GATED) {
        *of->lacking = *of->missing = 0;
        compare(of, stamp, y, innovation, expected_std);
        count_outlier(of, stamp, innovation / expected_std);
    }
    if (corrects) {
        average(of, stamp, innovation / expected_std);
        *of->predicted = y - innovation;
    }
}

void add_samples(double *watches, const sensor_samples *samples)
{
    const int64_t count = samples->count;
    int64_t sensor, i;
    for (sensor = 0; sensor < samples->sensors; sensor++) {
        watch of;
        watches = watch_bind(&of, NULL, watches);
        for (i = 0; i < count; i++) {
            const int64_t at = sensor * count + i;
            add_sample(
                &of, samples->stamps[i], samples->codes[at], samples->values[at],
                samples->innovations[at], samples->expected_std[at]);
        }
    }
}

/* Add a row of means to the blocks. */
static void end_block(const watch *of, int64_t elapsed)
{
    double *row;
    int column;
    if (*of->count == BLOCKS) {
        *of->count -= 1;
        memmove(of->blocks, of->blocks + 4, (BLOCKS - 1) * 4 * sizeof *of->blocks);
    }
    row = of->blocks + 4 * *of->count;
    row[0] = (double)elapsed * 1e-9;
    for (column = 0; column < 3; column++) {
        row[column + 1] = of->sums[column] / (double)*of->in_block;
        of->sums[column] = 0.0;
    }
    *of->count += 1;
    *of->block = elapsed / BLOCK;
    *of->in_block = 0;
    *of->complete = 1;
}

/* Take in an estimate of one sensor; return whether there is something to judge. */
static int add_estimate(const watch *of, int64_t stamp, double disturbance, double bound)
{
    *of->complete = 0;
    if (isnan(disturbance) || (*of->estimated != 0 && stamp <= *of->estimated)) {
        return 0;
    }
    if (*of->begun != 0 && stamp - *of->estimated > LONGEST_GAP) {
        renew(of, 1, LEAST_BLOCKS);
    }
    *of->estimated = stamp;
    if (*of->begun == 0) {
        *of->begun = stamp;
    }
    of->sums[0] += disturbance;
    of->sums[1] += *of->predicted - disturbance;
    of->sums[2] += bound;
    *of->in_block += 1;
    if (stamp - *of->begun >= (*of->block + 1) * BLOCK) {
        end_block(of, stamp - *of->begun);
    }
    return *of->complete != 0 || *of->stuck != 0 || *of->missing != 0;
}

int add_estimates(
    double *watches, int64_t sensors, int64_t stamp, const double *disturbances,
    const double *bounds)
{
    int ready = 0;
    int64_t sensor;
    for (sensor = 0; sensor < sensors; sensor++) {
        watch of;
        watches = watch_bind(&of, NULL, watches);
        ready |= add_estimate(&of, stamp, disturbances[sensor], bounds[sensor]);
    }
    return ready;
}
