/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The one header for C and C++ programs. docs/c_programs.md explains how to build and use it.
 *
 *     exported design;
 *     tracker joint;
 *     const char *wrong = exported_open(&design, words, bytes);   // a file of `tsobs export-c`
 *     double *room = malloc(design.room * sizeof *room);
 *     exported_start(&design, room, &joint);
 *
 *     offer(&joint, &sample, now, &effect);                       // at a sample
 *     if (estimate_at(&joint, stamp, row)) { ... }                // at a tick
 *
 * Memory: an exported design is only read, and serves any number of trackers; each has a room of its
 * own. Both belong to the caller, who keeps them where they are as long as the trackers are in use,
 * and frees them. A tracker is a view of them: there is nothing to close.
 *
 * Threads: no function has static data, so trackers do not know of each other. One tracker is for
 * one thread at a time.
 *
 * Time: one step is one `offer` and one `estimate_at`. None allocates, locks, reads a clock or makes
 * a system call. A sample in order costs at most one step of all hypotheses; a late one as many as
 * there are newer samples within `history`; an estimate as many predictions as there are periods
 * since the newest sample, of which those made before are remembered.
 *
 * Numbers: all are SI and radians, stamps in ns of one clock, above 0. The bits are those of Python
 * if the compiler keeps to IEEE 754: no -ffast-math, and -ffp-contract=off.
 */
#ifndef TSOBS_H
#define TSOBS_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#include "history.h"

/* What an exported design begins with. magic: the text "tsobs-c". format: of this head. layout: of
 * the records behind it, the model and the memory of a new tracker; a change of any of their fields
 * changes it. words: in all. checksum: of the records. about: text that ends with a 0. */
#define EXPORTED_FIELDS(F, s)        \
    F(COUNT, magic, 1, 1)            \
    F(COUNT, format, 1, 1)           \
    F(COUNT, layout, 1, 1)           \
    F(COUNT, words, 1, 1)            \
    F(COUNT, model_length, 1, 1)     \
    F(COUNT, memory_length, 1, 1)    \
    F(COUNT, checksum, 1, 1)         \
    F(COUNTS, about, ABOUT, 1)
enum { ABOUT = 16 };
LAYOUT_DECLARE(exported_head, EXPORTED_FIELDS, void)

/* An exported design. memory: of a new tracker. room: numbers that each tracker needs, which are
 * those of the memory, the ring and the scratch; row: of an estimate. */
typedef struct {
    const double *model, *memory;
    size_t model_length, memory_length, ring_length, scratch_length;
    size_t room, row;
    estimator_sizes sizes;
    const char *about;
} exported;

/* Open an exported design of so many bytes, aligned to 8. Return NULL, or what is wrong with it. */
const char *exported_open(exported *view, const void *words, size_t bytes);

/* Make a new tracker in a room of its own. */
void exported_start(const exported *from, double *room, tracker *view);

/* Write magic, format, layout, words and checksum of the rest. Of the fields, the lengths and the
 * text have to be there already. */
void exported_seal(void *words, size_t bytes);

#ifdef __cplusplus
}
#endif

#endif
