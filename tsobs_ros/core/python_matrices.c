/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of trigonometry and small matrices.
 */
#include "python.h"

#include "matrices.h"
#include "trigonometry.h"

/* --- functions of one number --- */

static PyObject *of_number(
    const char *name, double (*function)(double), PyObject *const *given, Py_ssize_t count)
{
    argument taken[1];
    if (take_arguments(name, "f", given, count, taken) < 0) {
        return NULL;
    }
    return PyFloat_FromDouble(function(taken[0].is.number));
}

static PyObject *bind_sine(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    return of_number("sine", sine, given, count);
}

static PyObject *bind_cosine(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    return of_number("cosine", cosine, given, count);
}

static PyObject *bind_unbranched_sine(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    return of_number("unbranched_sine", unbranched_sine, given, count);
}

static PyObject *bind_exponential(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    return of_number("exponential", exponential, given, count);
}

static PyObject *bind_logarithm(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    return of_number("logarithm", logarithm, given, count);
}

/* --- matrices --- */

/* Return None, or NULL with an exception set, and release the arguments. */
static PyObject *ended(const char *format, argument *taken, int is_right)
{
    release_arguments(format, taken);
    if (!is_right) {
        return NULL;
    }
    Py_RETURN_NONE;
}

/* Raise a ValueError unless a size is possible; return whether it is. */
static int is_size(const char *function, const char *name, int64_t size)
{
    if (0 <= size && size <= 4096) {
        return 1;
    }
    PyErr_Format(
        PyExc_ValueError, "%s: %s: expected a size of 0 to 4096, got %lld", function, name,
        (long long)size);
    return 0;
}

/* Raise a ValueError unless an array has a matrix' numbers; return whether it has. */
static int has_matrix(
    const char *function, const char *name, const argument *array, int64_t rows, int64_t columns)
{
    return require_length(function, name, array, (size_t)rows * (size_t)columns) == 0;
}

static PyObject *bind_multiply(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "multiply", format[] = "ddDiii";
    argument t[sizeof format];
    int is_right;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const int64_t rows = t[3].is.integer, inner = t[4].is.integer, columns = t[5].is.integer;
    is_right = is_size(name, "rows", rows) && is_size(name, "inner", inner)
               && is_size(name, "columns", columns) && has_matrix(name, "a", &t[0], rows, inner)
               && has_matrix(name, "b", &t[1], inner, columns)
               && has_matrix(name, "result", &t[2], rows, columns);
    if (is_right) {
        multiply(
            t[0].is.doubles, t[1].is.doubles, t[2].is.doubles, (long)rows, (long)inner,
            (long)columns);
    }
    return ended(format, t, is_right);
}

static PyObject *bind_congruence(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "congruence", format[] = "dddDDii";
    argument t[sizeof format];
    int is_right;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const int64_t rows = t[5].is.integer, inner = t[6].is.integer;
    is_right = is_size(name, "rows", rows) && is_size(name, "inner", inner)
               && has_matrix(name, "a", &t[0], rows, inner)
               && has_matrix(name, "s", &t[1], inner, inner)
               && has_matrix(name, "added", &t[2], rows, rows)
               && has_matrix(name, "scratch", &t[3], rows, inner)
               && has_matrix(name, "result", &t[4], rows, rows);
    if (is_right) {
        congruence(
            t[0].is.doubles, (long)inner, t[1].is.doubles, (long)inner, t[2].is.doubles,
            t[3].is.doubles, t[4].is.doubles, (long)rows, (long)rows, (long)inner);
    }
    return ended(format, t, is_right);
}

static PyObject *bind_joseph_form(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "joseph_form", format[] = "ddddDDii";
    argument t[sizeof format];
    int is_right;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const int64_t n = t[6].is.integer, p = t[7].is.integer;
    is_right = is_size(name, "n", n) && is_size(name, "p", p) && has_matrix(name, "C", &t[0], p, n)
               && has_matrix(name, "R", &t[1], p, p) && has_matrix(name, "covariance", &t[2], n, n)
               && has_matrix(name, "gain", &t[3], n, p)
               && has_matrix(name, "scratch", &t[4], 3 * n, n > p ? n : p)
               && has_matrix(name, "result", &t[5], n, n);
    if (is_right) {
        joseph_form(
            t[0].is.doubles, (long)n, t[1].is.doubles, t[2].is.doubles, (long)n, t[3].is.doubles,
            t[4].is.doubles, t[5].is.doubles, (long)n, (long)n, (long)p);
    }
    return ended(format, t, is_right);
}

static PyObject *bind_solve(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "solve", format[] = "ddDDii";
    argument t[sizeof format];
    int is_right;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const int64_t n = t[4].is.integer, columns = t[5].is.integer;
    is_right = is_size(name, "n", n) && is_size(name, "columns", columns)
               && has_matrix(name, "s", &t[0], n, n) && has_matrix(name, "b", &t[1], n, columns)
               && has_matrix(name, "factor", &t[2], n, n)
               && has_matrix(name, "result", &t[3], n, columns);
    if (is_right) {
        solve(
            t[0].is.doubles, t[1].is.doubles, t[2].is.doubles, t[3].is.doubles, (long)n,
            (long)columns);
    }
    return ended(format, t, is_right);
}

static PyObject *bind_is_below(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "is_below", format[] = "ddDi";
    argument t[sizeof format];
    int is_right, below = 0;
    (void)module;
    if (take_arguments(name, format, given, count, t) < 0) {
        return NULL;
    }
    const int64_t n = t[3].is.integer;
    is_right = is_size(name, "n", n) && has_matrix(name, "s", &t[0], n, n)
               && has_matrix(name, "bound", &t[1], n, n)
               && has_matrix(name, "scratch", &t[2], n, n);
    if (is_right) {
        below = is_below(
            t[0].is.doubles, (long)n, t[1].is.doubles, (long)n, t[2].is.doubles, (long)n);
    }
    release_arguments(format, t);
    return is_right ? PyBool_FromLong(below) : NULL;
}

PyMethodDef matrices_methods[] = {
    BINDING("sine", bind_sine, "Return sin of an angle [rad]."),
    BINDING("cosine", bind_cosine, "Return cos of an angle [rad]."),
    BINDING("unbranched_sine", bind_unbranched_sine, "Return sin up to 1e6 rad, NaN beyond."),
    BINDING("exponential", bind_exponential, "Return exp x for x <= 0."),
    BINDING("logarithm", bind_logarithm, "Return the natural logarithm of x > 0."),
    BINDING("multiply", bind_multiply, "Write a b into `result`."),
    BINDING("congruence", bind_congruence, "Write a s a' + added into `result`."),
    BINDING("joseph_form", bind_joseph_form, "Write (I - K C) S (I - K C)' + K R K'."),
    BINDING("solve", bind_solve, "Write s^-1 b into `result`."),
    BINDING("is_below", bind_is_below, "Return whether s <= bound, as symmetric matrices."),
    {NULL, NULL, 0, NULL},
};
