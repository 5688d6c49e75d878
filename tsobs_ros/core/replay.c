/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "replay.h"

#include <math.h>

enum { TAKEN, OFFERED };

/* Return whether it is clear which samples a tick uses. */
static int is_decided(
    const replay_samples *samples, const replay_ticks *ticks, const int64_t *counts, int64_t tick)
{
    int64_t i;
    if (ticks->reset_after[tick] >= 0 || counts[TAKEN] != counts[OFFERED]) {
        return 0;
    }
    for (i = counts[TAKEN]; i < ticks->min_known[tick]; i++) {
        if (samples->evidence[i] != CERTAIN || samples->begins[i] != 0) {
            return 0;
        }
    }
    return 1;
}

/* Offer the samples before a number of them that have not been taken yet. */
static void take_samples(
    tracker *t, const replay_samples *samples, const replay_results *results, int64_t known,
    int64_t now, int64_t tick)
{
    const int64_t taken = results->counts[TAKEN], p = t->m.s.p, m = t->m.s.m;
    const measurements *all = &samples->given;
    const measurements given = {
        known - taken, all->stamps + taken, all->y + taken * p, all->u + taken * m};
    const outcomes *of = &results->of_samples;
    const outcomes written = {of->codes + taken, of->output_codes + taken * p,
                              of->innovations + taken * p, of->expected_std + taken * p};
    int64_t i;
    offer(t, &given, now, &written);
    for (i = taken; i < known; i++) {
        results->ticks_of_use[i] = tick;
    }
    results->counts[TAKEN] = results->counts[OFFERED] = known;
}

/* Return whether an estimate is the recorded one; bounds that were not recorded may be any. */
static int is_recorded(const replay_ticks *ticks, int64_t tick, const double *row)
{
    int64_t i;
    for (i = 0; i < ticks->width; i++) {
        const double recorded = ticks->estimates[tick * ticks->width + i];
        if (row[i] != recorded && (2 * i < ticks->width || !isnan(recorded))) {
            return 0;
        }
    }
    return ticks->width > 0;
}

int64_t make_ticks(
    tracker *t, const replay_samples *samples, const replay_ticks *ticks,
    const replay_results *results, int64_t begin, int64_t end, int64_t stale_after)
{
    const int64_t width = (int64_t)estimate_size(&t->m.s);
    int64_t tick;
    for (tick = begin; tick < end; tick++) {
        const int64_t known = ticks->min_known[tick], stamp = ticks->stamps[tick];
        double *row = results->rows + (tick - begin) * width;
        int64_t newest;
        int is_there;
        if (!is_decided(samples, ticks, results->counts, tick)) {
            return tick;
        }
        if (known > results->counts[TAKEN]) {
            take_samples(t, samples, results, known, ticks->now[tick], tick);
        }
        newest = newest_stamp(t);
        is_there = newest > 0 && stamp - newest <= stale_after && estimate_at(t, stamp, row);
        results->newest[tick] = newest;
        results->there[tick] = is_there;
        if (ticks->max_known[tick] > known && !(is_there && is_recorded(ticks, tick, row))) {
            /* More may have been used, as the estimate is not the recorded one. */
            return tick;
        }
    }
    return end;
}
