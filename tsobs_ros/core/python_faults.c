/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of the fault monitor's sums.
 */
#include "faults.h"
#include "python.h"

/* Return the number of watches, the first argument; -1 with an exception if one is not whole. */
static int64_t count_watches(const signature *of, const argument *t)
{
    const int64_t size = (int64_t)watch_size(NULL), found = t[0].length / size;
    double *memory = t[0].is.doubles;
    int is_sound = t[0].length % size == 0;
    for (int64_t i = 0; is_sound && i < found; i++) {
        watch one;
        memory = watch_bind(&one, NULL, memory);
        is_sound = *one.count >= 0 && *one.count <= BLOCKS;
    }
    if (!is_sound) {
        refuse(of, "watches: expected records of sensors");
    }
    return is_sound ? found : -1;
}

BIND(faults_add_samples, "Dddddd", "watches stamps y codes innovations expected_std")
{
    const int64_t sensors = count_watches(of, t), numbers = sensors * t[1].length;
    if (sensors < 0 || !HAVE(2, numbers, numbers, numbers, numbers)) {
        return NULL;
    }
    const sensor_samples samples = {
        sensors, t[1].length, t[1].is.integers, t[3].is.integers,
        t[2].is.doubles, t[4].is.doubles, t[5].is.doubles,
    };
    add_samples(t[0].is.doubles, &samples);
    Py_RETURN_NONE;
}

BIND(faults_add_estimates, "Didd", "watches stamp disturbances bounds")
{
    const int64_t sensors = count_watches(of, t);
    if (sensors < 0 || !HAVE(2, sensors, sensors)) {
        return NULL;
    }
    return PyBool_FromLong(add_estimates(
        t[0].is.doubles, sensors, t[1].is.integer, t[2].is.doubles, t[3].is.doubles));
}

PyMethodDef faults_methods[] = {
    METHOD(faults_add_samples),
    METHOD(faults_add_estimates),
    {NULL, NULL, 0, NULL},
};
