/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of the fault monitor's sums.
 */
#include "faults.h"
#include "python.h"

static const layout_field watch_layout[] = {WATCH_FIELDS(LAYOUT_ROW, unused)};

static PyObject *layout(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module, (void)given, (void)count;
    return fields_as_list(watch_layout, sizeof watch_layout / sizeof watch_layout[0]);
}

/* Return the number of watches in an array, -1 with an exception if one is not whole. */
static int64_t count_watches(const char *function, const argument *watches)
{
    const int64_t size = (int64_t)watch_size(NULL), found = watches->length / size;
    double *memory = watches->is.doubles;
    int64_t i;
    int is_sound = watches->length % size == 0;
    for (i = 0; is_sound && i < found; i++) {
        watch of;
        memory = watch_bind(&of, NULL, memory);
        is_sound = *of.count >= 0 && *of.count <= BLOCKS;
    }
    if (!is_sound) {
        PyErr_Format(PyExc_ValueError, "%s: watches: expected records of sensors", function);
    }
    return is_sound ? found : -1;
}

static PyObject *faults_add_samples(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "faults_add_samples", *const format = "Dddddd";
    PyObject *result = NULL;
    argument taken[6];
    int64_t sensors;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    sensors = count_watches(name, &taken[0]);
    if (sensors >= 0) {
        const sensor_samples samples = {
            sensors, taken[1].length, taken[1].is.integers, taken[3].is.integers,
            taken[2].is.doubles, taken[4].is.doubles, taken[5].is.doubles,
        };
        const size_t numbers = (size_t)(sensors * samples.count);
        if (require_length(name, "y", &taken[2], numbers) == 0 &&
            require_length(name, "codes", &taken[3], numbers) == 0 &&
            require_length(name, "innovations", &taken[4], numbers) == 0 &&
            require_length(name, "expected_std", &taken[5], numbers) == 0) {
            add_samples(taken[0].is.doubles, &samples);
            result = Py_NewRef(Py_None);
        }
    }
    release_arguments(format, taken);
    return result;
}

static PyObject *faults_add_estimates(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "faults_add_estimates", *const format = "Didd";
    PyObject *result = NULL;
    argument taken[4];
    int64_t sensors;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    sensors = count_watches(name, &taken[0]);
    if (sensors >= 0 && require_length(name, "disturbances", &taken[2], (size_t)sensors) == 0 &&
        require_length(name, "bounds", &taken[3], (size_t)sensors) == 0) {
        result = PyBool_FromLong(add_estimates(
            taken[0].is.doubles, sensors, taken[1].is.integer, taken[2].is.doubles,
            taken[3].is.doubles));
    }
    release_arguments(format, taken);
    return result;
}

PyMethodDef faults_methods[] = {
    BINDING("faults_layout", layout, "Return the fields of a sensor's record."),
    BINDING("faults_add_samples", faults_add_samples, "Take in samples; see faults.h."),
    BINDING("faults_add_estimates", faults_add_estimates, "Take in estimates; see faults.h."),
    {NULL, NULL, 0, NULL},
};
