/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "scores.h"

#include <math.h>

/* Write what is true at a sample of a run (its place from the first of all); return whether a
 * quantity has jumped since the one before, unless this is the first. */
static int take_truths(
    const scored_runs *runs, const score_options *options, const score_sums *sums, int64_t place,
    int is_first)
{
    double *truths = sums->scratch, *before = sums->scratch + options->quantities;
    int has_jumped = 0;
    int64_t item;
    for (item = 0; item < options->quantities; item++) {
        const int64_t kind = options->places[4 * item], column = options->places[4 * item + 1];
        const double truth = runs->truths[kind][place * runs->columns[kind] + column];
        has_jumped |= !is_first && fabs(truth - before[item]) > options->jumps[item];
        truths[item] = before[item] = truth;
    }
    return has_jumped;
}

/* Add an error in a settled part to its five sums; `bound` is not finite if there is none. */
static void add_settled(double *sums, double error, double bound, double sigmas)
{
    sums[0] += error * error;
    sums[1] += 1.0;
    if (isfinite(bound)) {
        sums[2] += bound * bound;
        sums[3] += 1.0;
        sums[4] += fabs(error) <= sigmas * bound ? 1.0 : 0.0;
    }
}

/* Add an error under a bound to its four sums. */
static void add_claimed(double *sums, double error, double bound, double sigmas)
{
    const double ratio = fabs(error) / bound;
    sums[0] += 1.0;
    sums[1] += fabs(error) <= sigmas * bound ? 1.0 : 0.0;
    sums[2] += ratio * ratio;
    sums[3] = ratio > sums[3] ? ratio : sums[3];
}

/* Add the errors of a sample of a run. counts: whether it is settled; claim: what its bounds are
 * said to be, or -1. */
static void add_errors(
    const score_options *options, const score_sums *sums, int64_t run, const double *row,
    int counts, int64_t claim)
{
    int64_t item;
    for (item = 0; item < options->quantities; item++) {
        const int64_t place = options->places[4 * item + 2];
        const int64_t bound_place = options->places[4 * item + 3];
        const int64_t place_in_run = run * options->quantities + item;
        double error, bound;
        if (place < 0) {
            continue;
        }
        error = row[place] - sums->scratch[item];
        if (!isfinite(error)) {
            continue;
        }
        bound = bound_place >= 0 ? row[bound_place] : NAN;
        if (counts) {
            add_settled(sums->settled + 5 * place_in_run, error, bound, options->sigmas);
        }
        if (isfinite(bound) && bound > 0.0 && claim >= 0) {
            const int64_t first = (run * options->claim_count + claim) * options->quantities;
            add_claimed(sums->claimed + 4 * (first + item), error, bound, options->sigmas);
        }
    }
}

/* Return what bounds are said to be by their basis if they are claimed, else the last, which is
 * nothing; -1 if there are none. */
static int64_t claim_of(const score_options *options, double basis, double claimed)
{
    const int known = basis >= 0.0 && basis < (double)options->bases;
    if (known && claimed == 0.0) {
        return options->claim_count - 1;
    }
    return known ? options->claims[(int64_t)basis] : -1;
}

void add_up(const scored_runs *runs, const score_options *options, const score_sums *sums)
{
    int64_t run, sample;
    for (run = 0; run < runs->runs; run++) {
        double begin = runs->times[0] + options->after_start, jumped = -INFINITY;
        for (sample = 0; sample < runs->samples; sample++) {
            const int64_t place = run * runs->samples + sample;
            const double time = runs->times[sample];
            const double *row = runs->rows + place * runs->width;
            const double size = fabs(runs->truths[0][place * runs->columns[0]]);
            const int64_t claim = claim_of(options, row[runs->basis], row[runs->basis + 1]);
            if (take_truths(runs, options, sums, place, sample == 0)) {
                /* A fault that chatters is one event, which begins with its first jump. */
                if (time - jumped > options->same_jump && time + options->after_jump > begin) {
                    begin = time + options->after_jump;
                }
                jumped = time;
            }
            sums->reach[run] = size > sums->reach[run] ? size : sums->reach[run];
            if (claim >= 0) {
                sums->counts[run * options->claim_count + claim] += 1;
            }
            add_errors(
                options, sums, run, row, sample < runs->last_measured[run] && time >= begin, claim);
        }
    }
}
