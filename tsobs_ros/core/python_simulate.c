/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of simulated plants.
 */
#include "python.h"
#include "simulate.h"
#include "trigonometry.h"

#define LARGEST_SIZE 4096 /* so that no product of sizes overflows */

static PyObject *refuse(const char *function, const char *why)
{
    return PyErr_Format(PyExc_ValueError, "%s: %s", function, why);
}

static PyObject *arm_layout(PyObject *module, PyObject *nothing)
{
    static const layout_field fields[] = {SIMULATED_ARM_FIELDS(LAYOUT_ROW, unused)};
    (void)module;
    (void)nothing;
    return fields_as_list(fields, sizeof fields / sizeof fields[0]);
}

/* Return whether the steps of two arms are alike, and there are none or enough kicks for all. */
static int kicks_suffice(const simulated_arm *arms, const argument *kicks, size_t samples)
{
    const int64_t steps = *arms[0].substeps;
    return steps > 0 && steps == *arms[1].substeps &&
           (kicks->length == 0 || (size_t)kicks->length / 2 / (size_t)steps >= samples);
}

static PyObject *move_arms(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "simulate_arms", format[] = "ddddDDD";
    argument a[7];
    const size_t size = simulated_arm_size(NULL);
    PyObject *result = NULL;
    (void)module;
    if (take_arguments(name, format, given, count, a) < 0) {
        return NULL;
    }
    const size_t runs = (size_t)a[4].length / 4, samples = (size_t)a[1].length;
    if (require_length(name, "arms", &a[0], 2 * size) == 0 &&
        require_length(name, "inputs", &a[2], runs * samples) == 0 &&
        require_length(name, "states", &a[5], 4 * runs * samples) == 0 &&
        require_length(name, "torques", &a[6], 2 * runs * samples) == 0) {
        simulated_arm arms[2];
        int known = 1;
        simulated_arm_bind(&arms[1], NULL, simulated_arm_bind(&arms[0], NULL, a[0].is.doubles));
        for (size_t k = 0; k < samples; k++) {
            known = known && (a[1].is.integers[k] == 0 || a[1].is.integers[k] == 1);
        }
        if (!known) {
            refuse(name, "carried: expected 0 or 1");
        } else if (!kicks_suffice(arms, &a[3], runs * samples)) {
            refuse(name, "kicks: expected none, or two for each integration step");
        } else {
            Py_BEGIN_ALLOW_THREADS
            simulate_arms(
                arms, a[1].is.integers, a[2].is.doubles, a[3].length ? a[3].is.doubles : NULL,
                a[4].is.doubles, a[5].is.doubles, a[6].is.doubles, (long)runs, (long)samples);
            Py_END_ALLOW_THREADS
            result = Py_NewRef(Py_None);
        }
    }
    release_arguments(format, a);
    return result;
}

/* Read n, m, scheduled, p, rules and premises; return 0, or -1 with an exception set. */
static int take_sizes(const char *name, const argument *given, system_sizes *s)
{
    long *const sizes[] = {&s->n, &s->m, &s->scheduled, &s->p, &s->rules, &s->premises};
    if (require_length(name, "sizes", given, 6) < 0) {
        return -1;
    }
    for (int i = 0; i < 6; i++) {
        const int64_t one = given->is.integers[i];
        if (one < (i == 0) || one > LARGEST_SIZE) {
            refuse(name, "sizes: expected sizes of a system");
            return -1;
        }
        *sizes[i] = (long)one;
    }
    return 0;
}

static PyObject *system_layout(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "simulated_system_layout", format[] = "d";
    argument a[1];
    system_sizes sizes;
    const system_sizes *s = &sizes;
    PyObject *result = NULL;
    (void)module;
    if (take_arguments(name, format, given, count, a) < 0) {
        return NULL;
    }
    if (take_sizes(name, a, &sizes) == 0) {
        const layout_field fields[] = {SIMULATED_SYSTEM_FIELDS(LAYOUT_ROW, s)};
        result = fields_as_list(fields, sizeof fields / sizeof fields[0]);
    }
    release_arguments(format, a);
    return result;
}

static PyObject *move_systems(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "simulate_systems", format[] = "dDddDDD";
    argument a[7];
    system_sizes s;
    PyObject *result = NULL;
    (void)module;
    if (take_arguments(name, format, given, count, a) < 0) {
        return NULL;
    }
    if (take_sizes(name, &a[0], &s) == 0 &&
        require_length(name, "system", &a[1], simulated_system_size(&s)) == 0) {
        const size_t n = (size_t)s.n, runs = (size_t)a[4].length / n;
        const size_t samples = runs ? (size_t)a[5].length / (n * runs) : 0, all = runs * samples;
        simulated_system system;
        simulated_system_bind(&system, &s, a[1].is.doubles);
        const int64_t steps = *system.substeps;
        if (steps <= 0 || (a[3].length && (size_t)a[3].length / n / (size_t)steps < all)) {
            refuse(name, "kicks: expected none, or one for each state and integration step");
        } else if (
            require_length(name, "inputs", &a[2], all * (size_t)(s.m + s.scheduled)) == 0 &&
            require_length(name, "truths", &a[6], all * (size_t)s.p) == 0) {
            Py_BEGIN_ALLOW_THREADS
            simulate_systems(
                &system, &s, a[2].is.doubles, a[3].length ? a[3].is.doubles : NULL,
                a[4].is.doubles, a[5].is.doubles, a[6].is.doubles, (long)runs, (long)samples);
            Py_END_ALLOW_THREADS
            result = Py_NewRef(Py_None);
        }
    }
    release_arguments(format, a);
    return result;
}

static PyObject *move_drifts(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "gauss_markov", format[] = "ffDD";
    argument a[4];
    PyObject *result = NULL;
    (void)module;
    if (take_arguments(name, format, given, count, a) < 0) {
        return NULL;
    }
    if (require_length(name, "present", &a[2], 1) == 0) {
        const long runs = (long)a[2].length, samples = (long)a[3].length / runs;
        Py_BEGIN_ALLOW_THREADS
        gauss_markov(
            a[0].is.number, a[1].is.number, a[2].is.doubles, a[3].is.doubles, runs, samples);
        Py_END_ALLOW_THREADS
        result = Py_NewRef(Py_None);
    }
    release_arguments(format, a);
    return result;
}

/* Write a function of each of some angles over it. */
static PyObject *replace_each(
    const char *name, double (*function)(double), PyObject *const *given, Py_ssize_t count)
{
    argument a[1];
    if (take_arguments(name, "D", given, count, a) < 0) {
        return NULL;
    }
    for (Py_ssize_t i = 0; i < a[0].length; i++) {
        a[0].is.doubles[i] = function(a[0].is.doubles[i]);
    }
    release_arguments("D", a);
    return Py_NewRef(Py_None);
}

static PyObject *take_sines(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    return replace_each("take_sines", sine, given, count);
}

static PyObject *take_cosines(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    return replace_each("take_cosines", cosine, given, count);
}

PyMethodDef simulate_methods[] = {
    {"simulated_arm_layout", arm_layout, METH_NOARGS, "Return the fields of an arm's record."},
    BINDING("simulated_system_layout", system_layout, "Return the fields of a system's record."),
    BINDING("simulate_arms", move_arms, "Move arms over samples."),
    BINDING("simulate_systems", move_systems, "Move T-S systems over samples."),
    BINDING("gauss_markov", move_drifts, "Write Gauss-Markov processes over normal numbers."),
    BINDING("take_sines", take_sines, "Write the sines of angles over them."),
    BINDING("take_cosines", take_cosines, "Write the cosines of angles over them."),
    {NULL, NULL, 0, NULL},
};
