/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The only header that C and C++ programs include: trackers of exported designs. docs/c_programs.md
 * explains how to build and use it, and the rules for memory, threads, time and stamps.
 */
#ifndef TSOBS_H
#define TSOBS_H

#ifdef __cplusplus
extern "C" {
#endif

#include "estimator.h"

#pragma GCC visibility push(default) /* a shared library need show nothing else */

/* --- trackers: an estimator with its history, a ring of states, one after each measurement ---
 *
 * A late measurement is put in its place by rewinding to the state before it. So the estimate is,
 * bit for bit, as if all measurements had arrived in order. One rewind serves all late measurements
 * that are offered together; it costs one pass over the history. */

/* Largest number of measurements in a history. Slots of its ring beside their states: for the one
 * before them, and the next one. */
enum { MOST_STEPS = 1000000, SPARE_SLOTS = 2 };

/* A history, without its ring. If there are more than `max_steps` states, the oldest one only
 * serves as the beginning of a rewind. */
#define HISTORY_FIELDS(F, s)                                                               \
    F(COUNT, first, 1, 1)           /* place of the oldest state in the ring, */           \
    F(COUNT, length, 1, 1)          /* number of states, */                                \
    F(COUNT, turn, 1, 1)            /* and of slots that the ring cycles through now */    \
    F(COUNT, coasted_periods, 1, 1) /* periods from newest state to `coasted`, or 0 */     \
    F(COUNT, steps, 1, 1)           /* count of corrections, */                            \
    F(COUNT, accepted, 1, 1)        /* of accepted measurements, */                        \
    F(COUNT, rewinds, 1, 1)         /* of late ones, put in their place, */                \
    F(COUNT, bad_outputs, 1, 1)     /* of estimates that were not finite, */               \
    F(COUNTS, refused, OUTCOMES, 1) /* and of refused measurements, by outcome */          \
    F(COUNT, span, 1, 1)            /* how far back a late measurement may reach [ns] */   \
    F(COUNT, future, 1, 1)          /* how far ahead of the clock a stamp may be [ns] */   \
    F(COUNT, restart_after, 1, 1)   /* longest gap without a restart [ns] */               \
    F(COUNT, max_steps, 1, 1)       /* largest number of measurements, up to MOST_STEPS */ \
    F(NUMBER, x_max, 1, 1)          /* half width of the certificate's domain */
LAYOUT_DECLARE(history, HISTORY_FIELDS, void)

/* The room of a tracker: its history and ring, the state `coasted` into a gap, the state `shown` by
 * an estimate, scratch of a step, and for a rewind the measurements after the late one, which are
 * used again: at most as many as slots. */
typedef struct {
    const estimator_sizes *s;
    int64_t slots; /* of the ring, one per state: max_steps + SPARE_SLOTS */
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

/* A tracker: a view of a model record and of a room. */
typedef struct {
    model m;
    history h;
    tracker_room room;
    size_t state_size; /* numbers of a state */
    correction effect;
    work scratch;
} tracker;

/* Return whether the places and limits of a history are consistent. */
int tsobs_history_is_sound(const history *h);

/* Bind a view. Return NULL, or an error message if a length or place in model or room is wrong. */
const char *tsobs_tracker_bind(
    tracker *view, double *model, size_t model_length, double *room, size_t room_length);

/* Measurements: stamps [ns], (n,); outputs, NaN if missing, (n, p); and inputs, which hold from
 * each measurement until the next one, (n, m). */
typedef struct {
    int64_t count;
    const int64_t *stamps;
    const double *y, *u;
} measurements;

/* Outcomes: codes of the measurements, (n,); output_codes of their outputs, (n, p): the code of a
 * refused measurement, else USED, GATED, or NON_FINITE if missing; innovations y - C x of used
 * outputs, else NaN, (n, p); and the innovations' expected 1 sigma, NaN if refused, (n, p). */
typedef struct {
    int64_t *codes, *output_codes;
    double *innovations, *expected_std;
} outcomes;

/* Use measurements, or refuse them. now: time on the clock of the stamps [ns]. They may be in any
 * order; if their stamps ascend, all late ones together cost one rewind. */
void tsobs_offer(tracker *t, const measurements *given, int64_t now, const outcomes *written);

/* Write the estimate at a stamp [ns]; return whether there is one.
 *
 * There is none before the first measurement, nor if the last one before the stamp is more than
 * `restart_after` old. One that is not finite is only counted. `estimate_view` reads the row. */
int tsobs_estimate_at(tracker *t, int64_t stamp, double *row);

/* Ticks. Read: stamps of the estimates, ascending [ns]; the time `now` on the same clock [ns]; and
 * `known`, the number of measurements offered up to the tick, ascending. Written: the stamp of the
 * newest measurement in use [ns]; whether there is an estimate; and its row. */
typedef struct {
    int64_t count;
    const int64_t *stamps, *now, *known;
    int64_t *newest, *there;
    double *rows;
} history_ticks;

/* Offer measurements; estimate at ticks where the newest one is at most `stale_after` old [ns]. */
void tsobs_advance(
    tracker *t, const measurements *given, const outcomes *written, const history_ticks *ticks,
    int64_t stale_after);

/* --- exported designs --- */

/* The head of an exported design; a model record and the memory record of a new tracker follow.
 * layout: a number that changes with any field of these records. checksum: of both records. */
typedef struct {
    uint64_t magic, layout, checksum;
} exported_head;

/* An exported design. room: numbers of a tracker's room; row: numbers of an estimate. */
typedef struct {
    const double *model, *memory;
    size_t model_length, room, row;
    estimator_sizes sizes;
} exported;

/* Open an exported design, aligned to 8 bytes. Return NULL, or what is wrong with it. */
const char *tsobs_exported_open(exported *view, const void *words, size_t bytes);

/* Make a new tracker in a separate room. */
void tsobs_exported_start(const exported *from, double *room, tracker *view);

/* Write the head of an exported design; its length in bytes includes the head. */
void tsobs_exported_seal(void *words, size_t bytes);

#pragma GCC visibility pop

#ifdef __cplusplus
}
#endif

#endif
