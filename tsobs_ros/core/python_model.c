/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of all but trackers: layouts, functions, prediction models, simulated plants, exported
 * designs, and messages in bags.
 */
#include <math.h>
#include <string.h>

#include "faults.h"
#include "python.h"
#include "simulate.h"
#include "trigonometry.h"
#include "tsobs.h"

/* --- layouts --- */

static PyObject *fields_as_list(const layout_field *fields, size_t count)
{
    PyObject *list = PyList_New(0);
    for (size_t i = 0; list != NULL && i < count; i++) {
        PyObject *row = Py_BuildValue("(ssll)", fields[i].name, fields[i].kind, fields[i].rows,
                                      fields[i].columns);
        if (row == NULL || PyList_Append(list, row) < 0) {
            Py_CLEAR(list);
        }
        Py_XDECREF(row);
    }
    return list;
}

#define RECORD(name, FIELDS, count, s)                               \
    if (strcmp(t[0].is.text, name) == 0 && t[1].length == (count)) { \
        const layout_field rows[] = {FIELDS(LAYOUT_ROW, (s))};       \
        return fields_as_list(rows, sizeof rows / sizeof rows[0]);   \
    }

BIND(layout, "sd", "record sizes")
{
    const int64_t *numbers = t[1].is.integers;
    const int is_estimator = t[1].length == ESTIMATOR_SIZES;
    int are_possible = t[1].length <= ESTIMATOR_SIZES;
    long n[8] = {0};
    for (int i = 0; are_possible && !is_estimator && i < t[1].length && i < 8; i++) {
        are_possible = 0 <= numbers[i] && numbers[i] <= MAX_SIZE;
        n[i] = are_possible ? (long)numbers[i] : 0;
    }
    if (!are_possible || (is_estimator && !sizes_are_sound(numbers))) {
        return refuse(of, "sizes: expected those of the record");
    }
    const flow_sizes model = {n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7]};
    const system_sizes plant = {n[0], n[1], n[2], n[3], n[4], n[5]};
    RECORD("watch", WATCH_FIELDS, 0, NULL)
    RECORD("history", HISTORY_FIELDS, 0, NULL)
    RECORD("exported_head", EXPORTED_FIELDS, 0, NULL)
    RECORD("simulated_arm", SIMULATED_ARM_FIELDS, 0, NULL)
    RECORD("simulated_system", SIMULATED_SYSTEM_FIELDS, 6, &plant)
    RECORD("flow", FLOW_FIELDS, 8, &model)
    RECORD("flow_scratch", FLOW_SCRATCH_FIELDS, 8, &model)
    if (is_estimator) {
        const estimator_sizes s = sizes_of(numbers);
        RECORD("sensor", SENSOR_FIELDS, ESTIMATOR_SIZES, &s)
        RECORD("hypothesis", HYPOTHESIS_FIELDS, ESTIMATOR_SIZES, &s)
        RECORD("state", STATE_FIELDS, ESTIMATOR_SIZES, &s)
        RECORD("correction", CORRECTION_FIELDS, ESTIMATOR_SIZES, &s)
        RECORD("estimate", ESTIMATE_FIELDS, ESTIMATOR_SIZES, &s)
        RECORD("work", WORK_FIELDS, ESTIMATOR_SIZES, &s)
        RECORD("model", MODEL_FIELDS, ESTIMATOR_SIZES, &s)
    }
    return refuse(of, "record: expected one that has so many sizes");
}

/* --- functions of one number --- */

BIND(elementary, "sD", "function values")
{
    static const struct {
        const char *name;
        double (*value)(double);
    } known[] = {
        {"sine", sine}, {"cosine", cosine}, {"exponential", exponential}, {"logarithm", logarithm},
    };
    for (size_t place = 0; place < sizeof known / sizeof known[0]; place++) {
        if (strcmp(known[place].name, t[0].is.text) == 0) {
            for (Py_ssize_t i = 0; i < t[1].length; i++) {
                t[1].is.doubles[i] = known[place].value(t[1].is.doubles[i]);
            }
            Py_RETURN_NONE;
        }
    }
    return refuse(of, "function: expected sine, cosine, exponential or logarithm");
}

/* --- memberships --- */

BIND(grades_and_slopes, "iddDD", "shape parameters z grades slopes")
{
    const Py_ssize_t samples = t[2].length;
    if (!HAVE(1, 4) || !HAVE(3, samples, samples)) {
        return NULL;
    }
    for (Py_ssize_t k = 0; k < samples; k++) {
        t[3].is.doubles[k] = grade_and_slope(
            t[0].is.integer, t[2].is.doubles[k], t[1].is.doubles, &t[4].is.doubles[k]);
    }
    Py_RETURN_NONE;
}

BIND(weights_and_slopes_of_each, "dddDDii", "shapes parameters z weights slopes r q")
{
    const int64_t r = t[5].is.integer, q = t[6].is.integer;
    if (!is_size(of, t, 5, 1) || !is_size(of, t, 6, 1)) {
        return NULL;
    }
    const int64_t samples = t[2].length / q;
    if (!HAVE(0, r * q, 4 * r * q) || !HAVE(3, samples * r, samples * r * q)) {
        return NULL;
    }
    for (int64_t k = 0; k < samples; k++) {
        rule_weights(
            t[0].is.integers, t[1].is.doubles, t[2].is.doubles + k * q, t[3].is.doubles + k * r,
            t[4].is.doubles + k * r * q, (long)r, (long)q);
    }
    Py_RETURN_NONE;
}

/* --- prediction models --- */

/* Return whether a time is at least 0, and a number of periods that can be counted. */
static int is_duration(double duration, double period)
{
    return 0.0 <= duration && duration < HUGE_VAL && duration / period < 9e15;
}

BIND(flow_over, "diffDDDDii", "series terms reach duration phi gamma noise scratch n m")
{
    const int64_t terms = t[1].is.integer, n = t[8].is.integer, m = t[9].is.integer;
    if (!is_size(of, t, 1, 0) || !is_size(of, t, 8, 0) || !is_size(of, t, 9, 0) ||
        !HAVE(0, terms * n * (2 * n + m)) ||
        !HAVE(4, n * n, n * m, n * n, (int64_t)flow_over_scratch_size((long)n, (long)m))) {
        return NULL;
    }
    if (!is_duration(t[3].is.number, 1.0)) {
        return refuse(of, "duration: expected at least 0 and at most 9e15 s");
    }
    flow_over(
        t[0].is.doubles, (long)terms, t[2].is.number, t[3].is.number, t[4].is.doubles,
        t[5].is.doubles, t[6].is.doubles, t[7].is.doubles, (long)n, (long)m);
    Py_RETURN_NONE;
}

BIND(advance_all, "dDDDdddfD", "flow x upsilon covariance theta y u duration scratch")
{
    if (!flow_is_valid(t[0].is.doubles, (size_t)t[0].length)) {
        return refuse(of, "flow: expected the record of a model");
    }
    const flow f = flow_view(t[0].is.doubles);
    const flow_sizes s = flow_sizes_of(t[0].is.doubles);
    const long n = s.n, k = s.k;
    const int64_t batch = n > 0 ? t[1].length / n : 0;
    const int with_covariance = t[3].length > 0, with_sample = *f.kind == KIND_INTEGRATED;
    if (!HAVE(2, batch * k * n, with_covariance ? batch * n * n : 0, batch * k,
              with_sample ? batch * s.p : 0, batch * s.m) ||
        !HAVE(8, (int64_t)flow_scratch_size(&s))) {
        return NULL;
    }
    if (!is_duration(t[7].is.number, *f.period)) {
        return refuse(of, "duration: expected at least 0 and at most 9e15 periods");
    }
    Py_BEGIN_ALLOW_THREADS
    for (int64_t i = 0; i < batch; i++) {
        flow_advance(
            &f, t[1].is.doubles + i * n, k > 0 ? t[2].is.doubles + i * k * n : NULL,
            with_covariance ? t[3].is.doubles + i * n * n : NULL, n, NULL, t[4].is.doubles + i * k,
            with_sample ? t[5].is.doubles + i * s.p : NULL, t[6].is.doubles + i * s.m,
            t[7].is.number, t[8].is.doubles);
    }
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

/* --- simulated plants --- */

BIND(simulate_arms, "ddddDDD", "arms carried inputs kicks present states torques")
{
    const int64_t runs = t[4].length / 4, samples = t[1].length, all = runs * samples;
    simulated_arm arms[2];
    if (!HAVE(0, 2 * (int64_t)simulated_arm_size(NULL)) || !HAVE(2, all) ||
        !HAVE(5, 4 * all, 2 * all)) {
        return NULL;
    }
    simulated_arm_bind(&arms[1], NULL, simulated_arm_bind(&arms[0], NULL, t[0].is.doubles));
    for (int64_t k = 0; k < samples; k++) {
        if (t[1].is.integers[k] != 0 && t[1].is.integers[k] != 1) {
            return refuse(of, "carried: expected 0 or 1");
        }
    }
    const int64_t steps = *arms[0].substeps;
    if (steps <= 0 || steps != *arms[1].substeps ||
        (t[3].length > 0 && t[3].length / 2 / steps < all)) {
        return refuse(of, "kicks: expected none, or two for each integration step");
    }
    Py_BEGIN_ALLOW_THREADS
    simulate_arms(
        arms, t[1].is.integers, t[2].is.doubles, t[3].length > 0 ? t[3].is.doubles : NULL,
        t[4].is.doubles, t[5].is.doubles, t[6].is.doubles, (long)runs, (long)samples);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

BIND(simulate_systems, "dDddDDD", "sizes system inputs kicks present states truths")
{
    const int64_t *sizes = t[0].is.integers;
    simulated_system system;
    if (!HAVE(0, 6)) {
        return NULL;
    }
    for (int i = 0; i < 6; i++) {
        if (sizes[i] < (i == 0) || sizes[i] > MAX_SIZE) {
            return refuse(of, "sizes: expected sizes of a system");
        }
    }
    const system_sizes s = {(long)sizes[0], (long)sizes[1], (long)sizes[2],
                            (long)sizes[3], (long)sizes[4], (long)sizes[5]};
    if (!HAVE(1, (int64_t)simulated_system_size(&s))) {
        return NULL;
    }
    simulated_system_bind(&system, &s, t[1].is.doubles);
    const int64_t steps = *system.substeps, runs = t[4].length / s.n;
    const int64_t samples = runs > 0 ? t[5].length / (s.n * runs) : 0, all = runs * samples;
    if (steps <= 0 || (t[3].length > 0 && t[3].length / s.n / steps < all)) {
        return refuse(of, "kicks: expected none, or one for each state and integration step");
    }
    if (!HAVE(2, all * (s.m + s.scheduled)) || !HAVE(6, all * s.p)) {
        return NULL;
    }
    Py_BEGIN_ALLOW_THREADS
    simulate_systems(
        &system, &s, t[2].is.doubles, t[3].length > 0 ? t[3].is.doubles : NULL, t[4].is.doubles,
        t[5].is.doubles, t[6].is.doubles, (long)runs, (long)samples);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

BIND(gauss_markov, "ffDD", "decay strength present series")
{
    if (!HAVE(2, 1)) {
        return NULL;
    }
    gauss_markov(
        t[0].is.number, t[1].is.number, t[2].is.doubles, t[3].is.doubles, (long)t[2].length,
        (long)(t[3].length / t[2].length));
    Py_RETURN_NONE;
}

/* --- exported designs --- */

BIND(exported_seal, "D", "words")
{
    if (!HAVE(0, (int64_t)exported_head_size(NULL))) {
        return NULL;
    }
    exported_seal(t[0].is.doubles, (size_t)t[0].length * 8);
    Py_RETURN_NONE;
}

BIND(exported_open, "d", "words")
{
    exported design;
    const char *wrong = exported_open(&design, t[0].is.doubles, (size_t)t[0].length * 8);
    if (wrong != NULL) {
        return refuse(of, wrong);
    }
    return Py_BuildValue(
        "(nnnnn)", (Py_ssize_t)design.model_length, (Py_ssize_t)design.memory_length,
        (Py_ssize_t)design.ring_length, (Py_ssize_t)design.scratch_length, (Py_ssize_t)design.row);
}

/* --- messages in the records of an MCAP chunk --- */

enum { RECORD_HEAD = 9, MESSAGE_HEAD = 31, MESSAGE_KIND = 5, MESSAGE_FIELDS = 5 };

/* Return a little-endian number. */
static uint64_t number_at(const uint8_t *at, int size)
{
    uint64_t value = 0;
    while (size-- > 0) {
        value = value << 8 | at[size];
    }
    return value;
}

/* Write channel, log time, publish time, first byte and size of the data of each message to rows of
 * `room` numbers. Return how many there are; -1 if a record, which is a byte for its kind, 8 for the
 * length of what follows, and that, is not whole. No array operation finds where one begins. */
static int64_t split_messages(const uint8_t *data, size_t size, int64_t *found, size_t room)
{
    size_t at = 0, count = 0, length;
    for (; at < size; at += length) {
        const uint8_t *record = data + at;
        if (size - at < RECORD_HEAD || record[0] == 0 ||
            number_at(record + 1, 8) > size - at - RECORD_HEAD) {
            return -1;
        }
        length = RECORD_HEAD + (size_t)number_at(record + 1, 8);
        if (record[0] != MESSAGE_KIND) {
            continue;
        }
        if (length < MESSAGE_HEAD || count == room) {
            return -1;
        }
        found[count] = (int64_t)number_at(record + 9, 2);
        found[room + count] = (int64_t)number_at(record + 15, 8);
        found[2 * room + count] = (int64_t)number_at(record + 23, 8);
        found[3 * room + count] = (int64_t)(at + MESSAGE_HEAD);
        found[4 * room + count] = (int64_t)(length - MESSAGE_HEAD);
        count++;
    }
    return (int64_t)count;
}

BIND(messages_split, "bD", "data found")
{
    int64_t count;
    if (t[1].length % MESSAGE_FIELDS != 0) {
        return refuse(of, "found: expected 5 rows of numbers");
    }
    Py_BEGIN_ALLOW_THREADS
    count = split_messages(t[0].is.bytes, (size_t)t[0].length, t[1].is.integers,
                           (size_t)t[1].length / MESSAGE_FIELDS);
    Py_END_ALLOW_THREADS
    return PyLong_FromLongLong(count);
}

PyMethodDef model_methods[] = {
    METHOD(layout),
    METHOD(elementary),
    METHOD(grades_and_slopes),
    METHOD(weights_and_slopes_of_each),
    METHOD(flow_over),
    METHOD(advance_all),
    METHOD(simulate_arms),
    METHOD(simulate_systems),
    METHOD(gauss_markov),
    METHOD(exported_seal),
    METHOD(exported_open),
    METHOD(messages_split),
    {NULL, NULL, 0, NULL},
};
