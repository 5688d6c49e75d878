/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * One way of binding a function: its arguments are read by a format, and released after it.
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
#define MAX_SIZE 4096 /* so that no product of sizes overflows */

/* One argument: numbers of an array, one number, or a text. */
typedef struct {
    union {
        double *doubles;
        int64_t *integers;
        uint8_t *bytes;
        double number;
        int64_t integer;
        const char *text;
    } is;
    Py_ssize_t length; /* of an array, in numbers of 8 bytes; of bytes */
    Py_buffer buffer;
    int held; /* whether `buffer` is to be released */
} argument;

/* A function of Python. Its format has one letter for each argument: 'd' an array that is read, 'D'
 * one that is written (contiguous, of 8-byte numbers, or a `Memory`, which has its address already),
 * 'b' bytes, 'f' a float, 'i' an int, 's' a text. names: of the arguments, for messages. */
typedef struct {
    const char *function, *format, *names;
} signature;

typedef PyObject *(*bound_body)(const signature *of, const argument *t);
PyObject *call_bound(
    const signature *of, bound_body body, PyObject *const *given, Py_ssize_t count);

/* Begin the definition of a binding: the body between braces follows. It sees its signature `of` and
 * its arguments `t`, and returns a new reference, or NULL with an exception. */
#define BIND(name, format, names)                                                          \
    static PyObject *name##_body(const signature *of, const argument *t);                  \
    static PyObject *name##_bound(PyObject *self, PyObject *const *given, Py_ssize_t count) \
    {                                                                                      \
        static const signature of = {#name, format, names};                                \
        (void)self;                                                                        \
        return call_bound(&of, name##_body, given, count);                                 \
    }                                                                                      \
    static PyObject *name##_body(const signature *of, const argument *t)

/* A row of a table of functions; native.pyi says what they do. */
#define METHOD(name) {#name, (PyCFunction)(void (*)(void))name##_bound, METH_FASTCALL, NULL}

/* Raise a ValueError that begins with the function's name; return NULL. */
PyObject *refuse(const signature *of, const char *why);

/* Return whether arguments from a place on have so many numbers each at least; else raise a
 * ValueError. For use in a body of BIND. */
#define HAVE(first, ...) have(of, t, first, (const int64_t[]){__VA_ARGS__, -1})
int have(const signature *of, const argument *t, int first, const int64_t *least);

/* Return whether an argument is a number from `least` to MAX_SIZE; else raise a ValueError. */
int is_size(const signature *of, const argument *t, int place, int64_t least);

/* Tables of functions, one per file, each ended by an empty row. */
extern PyMethodDef estimator_methods[], faults_methods[], history_methods[], model_methods[];

#endif
