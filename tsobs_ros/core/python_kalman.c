/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of the extended Kalman filter.
 */
#include <string.h>

#include "kalman.h"
#include "python.h"

static const char ADVANCE[] = "kalman_advance";

/* Return whether sizes are such that no product of them overflows. */
static int are_sizes(const kalman_sizes *s)
{
    return s->n >= 4 && s->n <= 1000 && s->k >= 0 && s->k <= 1000 && s->p >= 1 && s->p <= 1000 &&
           s->reads >= 0 && s->reads <= 2000 && s->window >= 1 && s->window <= 1000000000 &&
           s->ring >= 1 && s->ring <= 1000000000;
}

static PyObject *fields(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    argument taken[MAX_ARGUMENTS];
    PyObject *model, *memory, *scratch;
    (void)module;
    if (take_arguments("kalman_layouts", "iiiiii", given, count, taken) < 0) {
        return NULL;
    }
    const kalman_sizes sizes = {taken[0].is.integer, taken[1].is.integer, taken[2].is.integer,
                                taken[3].is.integer, taken[4].is.integer, taken[5].is.integer};
    const kalman_sizes *s = &sizes;
    if (!are_sizes(s)) {
        PyErr_SetString(PyExc_ValueError, "kalman_layouts: a size is out of range");
        return NULL;
    }
    const layout_field of_model[] = {KALMAN_FIELDS(LAYOUT_ROW, s)};
    const layout_field of_memory[] = {KALMAN_MEMORY_FIELDS(LAYOUT_ROW, s)};
    const layout_field of_scratch[] = {KALMAN_SCRATCH_FIELDS(LAYOUT_ROW, s)};
    model = fields_as_list(of_model, sizeof of_model / sizeof *of_model);
    memory = fields_as_list(of_memory, sizeof of_memory / sizeof *of_memory);
    scratch = fields_as_list(of_scratch, sizeof of_scratch / sizeof *of_scratch);
    if (model == NULL || memory == NULL || scratch == NULL) {
        Py_XDECREF(model);
        Py_XDECREF(memory);
        Py_XDECREF(scratch);
        return NULL;
    }
    return Py_BuildValue("(NNN)", model, memory, scratch);
}

/* Return 0 if records belong together and write the filter of them, or -1 with an exception set. */
static int bind(const argument *model, const argument *forecast, const argument *memory,
                const argument *scratch, kalman *of)
{
    kalman_sizes *s = &of->sizes;
    if (require_length(ADVANCE, "model", model, KALMAN_SIZES) < 0) {
        return -1;
    }
    memcpy(s, model->is.integers, sizeof *s);
    if (!are_sizes(s) || (size_t)model->length != kalman_model_size(s)) {
        PyErr_Format(PyExc_ValueError, "%s: model: its sizes are not those of its record", ADVANCE);
        return -1;
    }
    if (require_length(ADVANCE, "memory", memory, kalman_memory_size(s)) < 0 ||
        require_length(ADVANCE, "scratch", scratch, kalman_scratch_size(s)) < 0) {
        return -1;
    }
    if (!flow_is_valid(forecast->is.doubles, (size_t)forecast->length)) {
        PyErr_Format(PyExc_ValueError, "%s: flow: expected the record of a model", ADVANCE);
        return -1;
    }
    kalman_model_bind(&of->model, s, model->is.doubles);
    kalman_memory_bind(&of->memory, s, memory->is.doubles);
    kalman_scratch_bind(&of->scratch, s, scratch->is.doubles);
    of->flow = flow_view(forecast->is.doubles);
    if (*of->flow.kind != KIND_ARM || *of->flow.n != s->n || *of->flow.k != s->k ||
        *of->flow.inputs != 1) {
        PyErr_Format(PyExc_ValueError, "%s: flow: expected an arm's, of the filter's sizes",
                     ADVANCE);
        return -1;
    }
    if (*of->memory.first < 0 || *of->memory.first >= s->ring || *of->memory.length < 0 ||
        *of->memory.length >= s->ring) {
        PyErr_Format(PyExc_ValueError, "%s: memory: its ring is damaged", ADVANCE);
        return -1;
    }
    return 0;
}

/* Return 0 if the arrays of samples and ticks have the lengths that the filter's sizes ask for. */
static int check_series(const kalman *of, const argument *ticks, const argument *samples,
                        const argument *results)
{
    static const char *const of_samples[] = {"y", "u", "outcomes", "codes", "innovations",
                                             "expected"};
    const size_t m = (size_t)ticks[0].length, count = (size_t)samples[0].length;
    const size_t p = (size_t)of->sizes.p;
    const size_t lengths[] = {count * p, count, count, count * p, count * p, count * p};
    const size_t width = (size_t)kalman_row_size(&of->sizes);
    for (size_t i = 0; i < sizeof lengths / sizeof *lengths; i++) {
        if (require_length(ADVANCE, of_samples[i], &samples[1 + i], lengths[i]) < 0) {
            return -1;
        }
    }
    if (require_length(ADVANCE, "now", &ticks[1], m) < 0 ||
        require_length(ADVANCE, "ends", &ticks[2], m) < 0 ||
        require_length(ADVANCE, "resets", &ticks[3], m) < 0 ||
        require_length(ADVANCE, "newest", &results[0], m) < 0 ||
        require_length(ADVANCE, "rows", &results[1], m * width) < 0) {
        return -1;
    }
    for (size_t i = 0; i < m; i++) {
        if (ticks[2].is.integers[i] > (int64_t)count) {
            PyErr_Format(PyExc_ValueError, "%s: ends: expected at most %zu, the number of samples",
                         ADVANCE, count);
            return -1;
        }
    }
    return 0;
}

static PyObject *advance_filter(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    /* Records, then ticks, samples and what they become, then the estimates. */
    static const char FORMAT[] = "ddDDddddddd" "DDDDDD";
    argument taken[MAX_ARGUMENTS];
    kalman of;
    (void)module;
    if (take_arguments(ADVANCE, FORMAT, given, count, taken) < 0) {
        return NULL;
    }
    const argument *at = taken + 4, *from = taken + 8, *to = taken + 15;
    if (bind(&taken[0], &taken[1], &taken[2], &taken[3], &of) < 0 ||
        check_series(&of, at, from, to) < 0) {
        release_arguments(FORMAT, taken);
        return NULL;
    }
    const kalman_ticks ticks = {at[0].is.integers, at[1].is.integers, at[2].is.integers,
                                at[3].is.integers, to[0].is.integers, to[1].is.doubles};
    const kalman_samples samples = {from[0].is.integers, from[1].is.doubles, from[2].is.doubles,
                                    from[3].is.integers, from[4].is.integers, from[5].is.doubles,
                                    from[6].is.doubles};
    Py_BEGIN_ALLOW_THREADS
    kalman_advance(&of, &ticks, (long)at[0].length, &samples);
    Py_END_ALLOW_THREADS
    release_arguments(FORMAT, taken);
    Py_RETURN_NONE;
}

PyMethodDef kalman_methods[] = {
    BINDING("kalman_layouts", fields, "Return the layouts of a filter's model, memory and scratch."),
    BINDING("kalman_advance", advance_filter, "Use samples and estimate, tick by tick."),
    {NULL, NULL, 0, NULL},
};
