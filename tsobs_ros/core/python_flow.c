/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of prediction models: memberships, linear flows and steps.
 */
#include "python.h"

#include <math.h>

#include "flow.h"

#define MOST_ROWS 4096

/* Return None, or NULL with an exception set, and release the arguments. */
static PyObject *ended(const char *format, argument *taken, int is_right)
{
    release_arguments(format, taken);
    if (!is_right) {
        return NULL;
    }
    Py_RETURN_NONE;
}

/* Raise a ValueError unless least <= size <= MOST_ROWS; return whether it is. */
static int is_size(const char *function, const char *name, int64_t size, int64_t least)
{
    if (least <= size && size <= MOST_ROWS) {
        return 1;
    }
    PyErr_Format(
        PyExc_ValueError, "%s: %s: expected a size of %lld to %d, got %lld", function, name,
        (long long)least, MOST_ROWS, (long long)size);
    return 0;
}

/* Raise a ValueError unless an array has so many numbers; return whether it has. */
static int has(const char *function, const char *name, const argument *array, int64_t count)
{
    return require_length(function, name, array, (size_t)count) == 0;
}

/* Raise a ValueError unless a duration is at least 0, and a number of periods that can be counted;
 * return whether it is. */
static int is_duration(const char *function, double duration, double period)
{
    if (0.0 <= duration && duration < HUGE_VAL && duration / period < 9e15) {
        return 1;
    }
    PyErr_Format(
        PyExc_ValueError, "%s: duration: expected at least 0 and at most 9e15 periods", function);
    return 0;
}

/* --- memberships --- */

static PyObject *bind_grades_and_slopes(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "grades_and_slopes", format[] = "iddDD";
    argument t[sizeof format];
    int is_right;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const Py_ssize_t samples = t[2].length;
    is_right = has(name, "parameters", &t[1], 4) && has(name, "grades", &t[3], samples)
               && has(name, "slopes", &t[4], samples);
    for (Py_ssize_t k = 0; is_right && k < samples; k++) {
        t[3].is.doubles[k] = grade_and_slope(
            t[0].is.integer, t[2].is.doubles[k], t[1].is.doubles, &t[4].is.doubles[k]);
    }
    return ended(format, t, is_right);
}

static PyObject *bind_weights_and_slopes_of_each(
    PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "weights_and_slopes_of_each", format[] = "dddDDii";
    argument t[sizeof format];
    int is_right;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const int64_t r = t[5].is.integer, q = t[6].is.integer;
    is_right = is_size(name, "r", r, 1) && is_size(name, "q", q, 1)
               && has(name, "shapes", &t[0], r * q) && has(name, "parameters", &t[1], 4 * r * q);
    if (is_right) {
        const int64_t samples = t[2].length / q;
        is_right = has(name, "weights", &t[3], samples * r)
                   && has(name, "slopes", &t[4], samples * r * q);
        for (int64_t k = 0; is_right && k < samples; k++) {
            rule_weights_and_slopes(
                t[0].is.integers, t[1].is.doubles, t[2].is.doubles + k * q,
                t[3].is.doubles + k * r, t[4].is.doubles + k * r * q, (long)r, (long)q);
        }
    }
    return ended(format, t, is_right);
}

static PyObject *bind_weights_of_each(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "weights_of_each", format[] = "dddDii";
    argument t[sizeof format];
    int is_right;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const int64_t r = t[4].is.integer, q = t[5].is.integer;
    is_right = is_size(name, "r", r, 1) && is_size(name, "q", q, 1)
               && has(name, "shapes", &t[0], r * q) && has(name, "parameters", &t[1], 4 * r * q);
    if (is_right) {
        const int64_t samples = t[2].length / q;
        is_right = has(name, "weights", &t[3], samples * r);
        for (int64_t k = 0; is_right && k < samples; k++) {
            rule_weights(
                t[0].is.integers, t[1].is.doubles, t[2].is.doubles + k * q,
                t[3].is.doubles + k * r, (long)r, (long)q);
        }
    }
    return ended(format, t, is_right);
}

static PyObject *bind_normalise_each(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "normalise_each", format[] = "Di";
    argument t[sizeof format];
    int is_right;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const int64_t r = t[1].is.integer;
    is_right = is_size(name, "r", r, 1);
    for (Py_ssize_t k = 0; is_right && (k + 1) * r <= t[0].length; k++) {
        normalise(t[0].is.doubles + k * r, (long)r);
    }
    return ended(format, t, is_right);
}

/* --- linear flows --- */

static PyObject *bind_fill_series(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "fill_series", format[] = "dddfDDii";
    argument t[sizeof format];
    int is_right;
    long terms = 0;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const int64_t n = t[6].is.integer, m = t[7].is.integer;
    is_right = is_size(name, "n", n, 0) && is_size(name, "m", m, 0)
               && has(name, "A", &t[0], n * n) && has(name, "B", &t[1], n * m)
               && has(name, "W", &t[2], n * n)
               && has(name, "series", &t[4], SERIES_TERMS * n * (2 * n + m))
               && has(name, "scratch", &t[5], (int64_t)flow_over_scratch_size((long)n, (long)m));
    if (is_right) {
        terms = fill_series(
            t[0].is.doubles, t[1].is.doubles, t[2].is.doubles, t[3].is.number, t[4].is.doubles,
            t[5].is.doubles, (long)n, (long)m);
    }
    release_arguments(format, t);
    return is_right ? PyLong_FromLong(terms) : NULL;
}

static PyObject *bind_flow_over(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "flow_over", format[] = "diffDDDDii";
    argument t[sizeof format];
    int is_right;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const int64_t terms = t[1].is.integer, n = t[8].is.integer, m = t[9].is.integer;
    is_right = is_size(name, "n", n, 0) && is_size(name, "m", m, 0)
               && is_size(name, "terms", terms, 0) && is_duration(name, t[3].is.number, 1.0)
               && has(name, "series", &t[0], terms * n * (2 * n + m))
               && has(name, "phi", &t[4], n * n) && has(name, "gamma", &t[5], n * m)
               && has(name, "noise", &t[6], n * n)
               && has(name, "scratch", &t[7], (int64_t)flow_over_scratch_size((long)n, (long)m));
    if (is_right) {
        flow_over(
            t[0].is.doubles, (long)terms, t[2].is.number, t[3].is.number, t[4].is.doubles,
            t[5].is.doubles, t[6].is.doubles, t[7].is.doubles, (long)n, (long)m);
    }
    return ended(format, t, is_right);
}

static PyObject *bind_cut_into_steps(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "cut_into_steps";
    argument t[2];
    double rest;
    (void)module;
    if (take_arguments(name, "ff", given, count, t) < 0
        || !is_duration(name, t[0].is.number, t[1].is.number)) {
        return NULL;
    }
    const int64_t whole = cut_into_steps(t[0].is.number, t[1].is.number, &rest);
    return Py_BuildValue("(Ld)", (long long)whole, rest);
}

/* --- models --- */

/* Read eight sizes in the order of `flow_sizes`; return whether they are possible. */
static int take_sizes(
    const char *name, PyObject *const *given, Py_ssize_t count, flow_sizes *sizes)
{
    argument t[8];
    if (take_arguments(name, "iiiiiiii", given, count, t) < 0) {
        return 0;
    }
    for (int place = 0; place < 8; place++) {
        if (!is_size(name, "sizes", t[place].is.integer, 0)) {
            return 0;
        }
    }
    *sizes = (flow_sizes){
        (long)t[0].is.integer, (long)t[1].is.integer, (long)t[2].is.integer, (long)t[3].is.integer,
        (long)t[4].is.integer, (long)t[5].is.integer, (long)t[6].is.integer, (long)t[7].is.integer,
    };
    if (sizes->inputs > sizes->m) {
        PyErr_Format(PyExc_ValueError, "%s: inputs: expected at most m", name);
        return 0;
    }
    return 1;
}

static PyObject *bind_flow_layout(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    flow_sizes sizes;
    const flow_sizes *s = &sizes;
    (void)module;
    if (!take_sizes("flow_layout", given, count, &sizes)) {
        return NULL;
    }
    {
        const layout_field fields[] = {FLOW_FIELDS(LAYOUT_ROW, s)};
        return fields_as_list(fields, sizeof fields / sizeof fields[0]);
    }
}

static PyObject *bind_flow_scratch_size(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    flow_sizes sizes;
    (void)module;
    if (!take_sizes("flow_scratch_size", given, count, &sizes)) {
        return NULL;
    }
    return PyLong_FromSize_t(flow_scratch_size(&sizes));
}

/* Move one state after the other of a batch. */
static void advance_batch(
    const flow *f, argument *t, int64_t batch, int with_covariance, double duration)
{
    const long n = *f->n, k = *f->k, p = *f->p, m = *f->m;
    const int with_sample = *f->kind == KIND_INTEGRATED;
    for (int64_t i = 0; i < batch; i++) {
        flow_advance(
            f, t[1].is.doubles + i * n, k > 0 ? t[2].is.doubles + i * k * n : NULL,
            with_covariance ? t[3].is.doubles + i * n * n : NULL, n, NULL, t[4].is.doubles + i * k,
            with_sample ? t[5].is.doubles + i * p : NULL, t[6].is.doubles + i * m, duration,
            t[8].is.doubles);
    }
}

static PyObject *bind_advance_all(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "advance_all", format[] = "dDDDdddfD";
    argument t[sizeof format];
    int is_right;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    is_right = flow_is_valid(t[0].is.doubles, (size_t)t[0].length);
    if (!is_right) {
        PyErr_Format(PyExc_ValueError, "%s: flow: expected the record of a model", name);
    } else {
        const flow f = flow_view(t[0].is.doubles);
        const flow_sizes s = flow_sizes_of(t[0].is.doubles);
        const int64_t batch = s.n > 0 ? t[1].length / s.n : 0;
        const int with_covariance = t[3].length > 0;
        is_right = is_duration(name, t[7].is.number, *f.period)
                   && has(name, "upsilon", &t[2], batch * s.k * s.n)
                   && has(name, "covariance", &t[3], with_covariance ? batch * s.n * s.n : 0)
                   && has(name, "theta", &t[4], batch * s.k)
                   && has(name, "y", &t[5], *f.kind == KIND_INTEGRATED ? batch * s.p : 0)
                   && has(name, "u", &t[6], batch * s.m)
                   && has(name, "scratch", &t[8], (int64_t)flow_scratch_size(&s));
        if (is_right) {
            Py_BEGIN_ALLOW_THREADS;
            advance_batch(&f, t, batch, with_covariance, t[7].is.number);
            Py_END_ALLOW_THREADS;
        }
    }
    return ended(format, t, is_right);
}

PyMethodDef flow_methods[] = {
    BINDING(
        "grades_and_slopes", bind_grades_and_slopes, "Write the grade at every z and its slope."),
    BINDING(
        "weights_and_slopes_of_each", bind_weights_and_slopes_of_each,
        "Write the rules' weights at every z, and their slopes."),
    BINDING("weights_of_each", bind_weights_of_each, "Write the rules' weights at every z."),
    BINDING("normalise_each", bind_normalise_each, "Divide grades by their sum."),
    BINDING("fill_series", bind_fill_series, "Write Taylor coefficients and return their number."),
    BINDING("flow_over", bind_flow_over, "Write the linear flow over a duration."),
    BINDING("cut_into_steps", bind_cut_into_steps, "Return nominal steps and a last one's length."),
    BINDING("flow_layout", bind_flow_layout, "Return the fields of a model's record."),
    BINDING("flow_scratch_size", bind_flow_scratch_size, "Return the numbers of a step's scratch."),
    BINDING("advance_all", bind_advance_all, "Move states, regressors and covariances."),
    {NULL, NULL, 0, NULL},
};
