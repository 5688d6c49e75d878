/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * What the bindings share: reading arguments, and tables of functions.
 */
#ifndef TSOBS_PYTHON_H
#define TSOBS_PYTHON_H

#define PY_SSIZE_T_CLEAN
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>
#include <stdint.h>

#include "layout.h"

#define MAX_ARGUMENTS 24

/* One argument: numbers of an array, or one number. */
typedef struct {
    union {
        double *doubles;
        int64_t *integers;
        double number;
        int64_t integer;
    } is;
    Py_ssize_t length; /* of an array, in numbers of 8 bytes */
    Py_buffer buffer;
    int held; /* whether `buffer` is to be released */
} argument;

/* Read arguments by a format with one letter each: 'd' an array that is read, 'D' one that is
 * written (contiguous, of 8-byte numbers, or a `Memory`, which has its address already), 'f' a
 * float, 'i' an int. Return 0, or -1 with an exception set. `release_arguments` ends it. */
int take_arguments(
    const char *function, const char *format, PyObject *const *given, Py_ssize_t count,
    argument *taken);
void release_arguments(const char *format, argument *taken);

/* Raise a ValueError if an array has fewer numbers than `least`; return 0 or -1. */
int require_length(const char *function, const char *name, const argument *array, size_t least);

/* Return a list of (name, kind, rows, columns) of a record's fields. */
PyObject *fields_as_list(const layout_field *fields, size_t count);

typedef PyObject *(*fast_function)(PyObject *module, PyObject *const *given, Py_ssize_t count);
#define BINDING(name, function, text) \
    {name, (PyCFunction)(void (*)(void))(fast_function)(function), METH_FASTCALL, text}

/* Tables of functions, one per file, each ended by an empty row. */
extern PyMethodDef flow_methods[];
extern PyMethodDef matrices_methods[];
extern PyMethodDef messages_methods[];
extern PyMethodDef faults_methods[];
extern PyMethodDef scores_methods[];
extern PyMethodDef estimator_methods[];
extern PyMethodDef simulate_methods[];
extern PyMethodDef history_methods[];
extern PyMethodDef exported_methods[];

#endif
