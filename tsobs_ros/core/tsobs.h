/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The one header for C and C++ programs. docs/c_programs.md explains how to build and use it, and
 * the rules of memory, threads, time and stamps.
 *
 *     exported design;
 *     tracker joint;
 *     const char *wrong = exported_open(&design, words, bytes);   // a file of `tsobs export-c`
 *     double *room = malloc(design.room * sizeof *room);
 *     exported_start(&design, room, &joint);
 *
 *     offer(&joint, &sample, now, &effect);                       // at a sample
 *     if (estimate_at(&joint, stamp, row)) { ... }                // at a tick
 */
#ifndef TSOBS_H
#define TSOBS_H

#ifdef __cplusplus
extern "C" {
#endif

#include "history.h"

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
