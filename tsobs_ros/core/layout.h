/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Records: blocks of 8-byte numbers whose fields have sizes that are only known at run time.
 *
 * The fields of a record are listed in one macro, which applies another macro to each of them:
 *
 *     #define THING_FIELDS(F, s)              \
 *         F(COUNT, jumps, 1, 1)               \
 *         F(NUMBER, noise_scale, 1, 1)        \
 *         F(VECTOR, x, s->n, 1)               \
 *         F(MATRIX, covariance, s->n, s->n)
 *     LAYOUT_DECLARE(thing, THING_FIELDS, sizes)
 *
 * A NUMBER, VECTOR or MATRIX consists of doubles, a matrix row by row; a COUNT or COUNTS of 64-bit
 * integers. The list yields the C view of a record (a pointer to each field), the function that
 * binds a view to memory, and the table from which Python makes the NumPy type of the same record.
 * So each layout is written once. The caller owns the memory, and copies a record by copying its
 * numbers. A record inside a record is a VECTOR of `other_size(s)` numbers, and several of them are
 * a MATRIX with one row each.
 */
#ifndef TSOBS_LAYOUT_H
#define TSOBS_LAYOUT_H

#include <stddef.h>
#include <stdint.h>

/* One field of a record, for code that reads layouts at run time. */
typedef struct {
    const char *name;
    const char *kind; /* NUMBER, VECTOR, MATRIX, COUNT or COUNTS */
    long rows, columns;
} layout_field;

typedef double layout_NUMBER, layout_VECTOR, layout_MATRIX;
typedef int64_t layout_COUNT, layout_COUNTS;

#define LAYOUT_POINTER(kind, name, rows, columns) layout_##kind *name;
#define LAYOUT_BIND(kind, name, rows, columns)         \
    view->name = (layout_##kind *)(void *)memory;      \
    memory += (size_t)(rows) * (size_t)(columns);
#define LAYOUT_COUNT(kind, name, rows, columns) +(size_t)(rows) * (size_t)(columns)
#define LAYOUT_ROW(kind, name, rows, columns) {#name, #kind, (long)(rows), (long)(columns)},

/* Declare `thing`, the view of a record; `thing_view`, which binds a view to memory; and
 * `thing_size`, the record's length in numbers. In the list, s points to the `sizes`. */
#define LAYOUT_DECLARE(thing, FIELDS, sizes)                         \
    typedef struct {                                                 \
        FIELDS(LAYOUT_POINTER, unused)                               \
    } thing;                                                         \
    static inline thing thing##_view(const sizes *s, double *memory) \
    {                                                                \
        thing bound, *view = &bound;                                 \
        (void)s;                                                     \
        FIELDS(LAYOUT_BIND, s)                                       \
        return bound;                                                \
    }                                                                \
    static inline size_t thing##_size(const sizes *s)                \
    {                                                                \
        (void)s;                                                     \
        return (size_t)0 FIELDS(LAYOUT_COUNT, s);                    \
    }

#endif
