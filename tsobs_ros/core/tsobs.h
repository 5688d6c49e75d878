/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The one header for C and C++ programs: trackers of exported designs. docs/c_programs.md explains
 * how to build and use it, and the rules of memory, threads, time and stamps.
 */
#ifndef TSOBS_H
#define TSOBS_H

#ifdef __cplusplus
extern "C" {
#endif

#include "estimator.h"

/* --- trackers: an estimator with its history, a ring of states, one after each measurement ---
 *
 * A late measurement is put in its place by rewinding to the state before it, so the estimate
 * equals, bit for bit, the one that arrival in order would have given. However many are late, one
 * rewind serves all that come together: the cost is one pass over the history. */

enum { MOST_STEPS = 1000000 }; /* measurements that a history has room for */

/* What a history needs beside its ring. The oldest state is only there to rewind to if there are
 * more than `max_steps`. */
#define HISTORY_FIELDS(F, s)                                                               \
    F(COUNT, first, 1, 1)           /* place of the oldest state in the ring, */           \
    F(COUNT, length, 1, 1)          /* number of states, */                                \
    F(COUNT, turn, 1, 1)            /* and of places that the ring goes round now */       \
    F(COUNT, coasted_periods, 1, 1) /* periods from the newest to that in a gap, or 0 */  \
    F(COUNT, steps, 1, 1)           /* count of corrections, */                            \
    F(COUNT, accepted, 1, 1)        /* of measurements, */                                 \
    F(COUNT, rewinds, 1, 1)         /* of late ones, put in their place, */                \
    F(COUNT, bad_outputs, 1, 1)     /* of estimates that were not finite, */               \
    F(COUNTS, refused, OUTCOMES, 1) /* and of measurements refused, by outcome */          \
    F(COUNT, span, 1, 1)            /* how far back a late measurement may reach [ns] */   \
    F(COUNT, future, 1, 1)          /* how far ahead of the clock a stamp may be [ns] */   \
    F(COUNT, restart_after, 1, 1)   /* longest gap [ns] */                                 \
    F(COUNT, max_steps, 1, 1)       /* largest number of measurements, up to MOST_STEPS */ \
    F(NUMBER, x_max, 1, 1)          /* half width of the certificate's domain */
LAYOUT_DECLARE(history, HISTORY_FIELDS, void)

/* The room of a tracker: its history with a ring of states, one in a gap and one that is read;
 * and as scratch records of a step, and in a rewind the measurements after the late one, to be
 * used again, as many as states at most. */
typedef struct {
    const estimator_sizes *s;
    int64_t slots; /* states in the ring */
} room_sizes;
#define ROOM_FIELDS(F, z)                           \
    F(VECTOR, memory, history_size(NULL), 1)        \
    F(MATRIX, ring, z->slots, state_size(z->s))     \
    F(VECTOR, coasted, state_size(z->s), 1)         \
    F(VECTOR, shown, state_size(z->s), 1)           \
    F(VECTOR, effect, correction_size(z->s), 1)     \
    F(VECTOR, work, work_size(z->s), 1)             \
    F(COUNTS, stamps, z->slots, 1)                  \
    F(MATRIX, y, z->slots, z->s->p)                 \
    F(MATRIX, u, z->slots, z->s->m)
LAYOUT_DECLARE(tracker_room, ROOM_FIELDS, room_sizes)

/* Return the states in a ring: of so many measurements, the one before them and the one to come. */
static inline int64_t slots_for(int64_t max_steps)
{
    return max_steps + 2;
}

/* Return the sizes of a room for so many measurements. */
static inline room_sizes room_for(const estimator_sizes *s, int64_t max_steps)
{
    const room_sizes sizes = {s, slots_for(max_steps)};
    return sizes;
}

/* An estimator with its history, a view of a model record and a room. */
typedef struct {
    model m;
    history h;
    tracker_room room;
    size_t state_size; /* numbers of one */
    correction effect;
    work scratch;
} tracker;

/* Return whether the places and limits of a history belong together. */
int history_is_sound(const history *h);

/* Bind a view. Return NULL, or what is wrong with model or room: a length, or a place in it. */
const char *tracker_bind(
    tracker *view, double *model, size_t model_length, double *room, size_t room_length);

/* Measurements: stamps [ns], (n,); outputs, NaN of one that is missing, (n, p); and inputs from
 * each measurement until the next one, (n, m). */
typedef struct {
    int64_t count;
    const int64_t *stamps;
    const double *y, *u;
} measurements;

/* What becomes of them. codes: outcomes, (n,). output_codes: those of each output, of a measurement
 * that is not refused USED, GATED, or NON_FINITE of one that is missing, (n, p). innovations:
 * y - C x of outputs that are used, else NaN, (n, p), and the 1 sigma expected of each. */
typedef struct {
    int64_t *codes, *output_codes;
    double *innovations, *expected_std;
} outcomes;

/* Use measurements, or refuse them; now: time on the clock of the stamps [ns]. They may be in any
 * order; in ascending order of stamps, late ones cost one rewind in all. */
void offer(tracker *t, const measurements *given, int64_t now, const outcomes *written);

/* Write the estimate at a stamp [ns]; return whether there is one.
 *
 * There is none before the first measurement, too long after the last, or if it is not finite,
 * which is counted. The row is that of `estimate_view`. */
int estimate_at(tracker *t, int64_t stamp, double *row);

/* Ticks: stamps of estimates, ascending, and times on their clock [ns]; numbers of measurements
 * that are offered before each, ascending. Written: the stamp of the newest one in use [ns],
 * whether there is an estimate, and its row. */
typedef struct {
    int64_t count;
    const int64_t *stamps, *now, *known;
    int64_t *newest, *there;
    double *rows;
} history_ticks;

/* Offer measurements and estimate at ticks, unless the newest is older than `stale_after` [ns]. */
void advance(
    tracker *t, const measurements *given, const outcomes *written, const history_ticks *ticks,
    int64_t stale_after);

/* --- exported designs --- */

/* What an exported design begins with, before its model record and the memory record of a new
 * tracker. layout: of these records; a change of any of their fields changes it. checksum: of
 * both. */
typedef struct {
    uint64_t magic, layout, checksum;
} exported_head;

/* An exported design. room: numbers that each tracker needs; row: of an estimate. */
typedef struct {
    const double *model, *memory;
    size_t model_length, room, row;
    estimator_sizes sizes;
} exported;

/* Open an exported design of so many bytes, aligned to 8. Return NULL, or what is wrong with it. */
const char *exported_open(exported *view, const void *words, size_t bytes);

/* Make a new tracker in a room of its own. */
void exported_start(const exported *from, double *room, tracker *view);

/* Write the head of an exported design of so many bytes. */
void exported_seal(void *words, size_t bytes);

#ifdef __cplusplus
}
#endif

#endif
