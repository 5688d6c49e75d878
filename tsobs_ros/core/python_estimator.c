/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of the estimator: its layouts, and its steps for some states one after the other.
 */
#include "estimator.h"
#include "matrices.h"
#include "python.h"

/* Longest duration of a step [s], whose periods can be counted. */
#define LONGEST 1e12

/* --- layouts --- */

/* Add the layout of a record to a dictionary. Return 0, or -1 with an exception set. */
static int add_layout(
    PyObject *layouts, const char *name, const layout_field *fields, size_t count)
{
    PyObject *list = fields_as_list(fields, count);
    const int failed = list == NULL || PyDict_SetItemString(layouts, name, list) < 0;
    Py_XDECREF(list);
    return failed ? -1 : 0;
}

#define ADD_LAYOUT(name, FIELDS)                                                   \
    do {                                                                           \
        const layout_field rows[] = {FIELDS(LAYOUT_ROW, s)};                       \
        if (add_layout(layouts, name, rows, sizeof rows / sizeof rows[0]) < 0) {   \
            Py_DECREF(layouts);                                                    \
            return NULL;                                                           \
        }                                                                          \
    } while (0)

static PyObject *layouts_of(const estimator_sizes *s)
{
    PyObject *layouts = PyDict_New();
    if (layouts == NULL) {
        return NULL;
    }
    ADD_LAYOUT("sensor", SENSOR_FIELDS);
    ADD_LAYOUT("hypothesis", HYPOTHESIS_FIELDS);
    ADD_LAYOUT("state", STATE_FIELDS);
    ADD_LAYOUT("correction", CORRECTION_FIELDS);
    ADD_LAYOUT("estimate", ESTIMATE_FIELDS);
    ADD_LAYOUT("work", WORK_FIELDS);
    ADD_LAYOUT("model", MODEL_FIELDS);
    return layouts;
}

static PyObject *estimator_layouts(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char format[] = "iiiiiiiiii";
    argument taken[ESTIMATOR_SIZES];
    int64_t numbers[ESTIMATOR_SIZES];
    estimator_sizes s;
    long i;
    (void)module;
    if (take_arguments("estimator_layouts", format, given, count, taken) < 0) {
        return NULL;
    }
    for (i = 0; i < ESTIMATOR_SIZES; i++) {
        numbers[i] = taken[i].is.integer;
    }
    if (!sizes_are_sound(numbers)) {
        PyErr_SetString(PyExc_ValueError, "estimator_layouts: sizes: expected those of an estimator");
        return NULL;
    }
    s = sizes_of(numbers);
    return layouts_of(&s);
}

#define CONSTANT_ROW(name, value, what) {#name, value, what},

/* Return the names, values and meanings of the bank's constants, in their order. */
static PyObject *bank_constants(PyObject *module, PyObject *unused)
{
    static const struct {
        const char *name;
        double value;
        const char *what;
    } rows[] = {BANK_CONSTANTS(CONSTANT_ROW)};
    PyObject *list = PyList_New(0);
    size_t i;
    (void)module;
    (void)unused;
    for (i = 0; list != NULL && i < CONSTANTS; i++) {
        PyObject *row = Py_BuildValue("(sds)", rows[i].name, rows[i].value, rows[i].what);
        if (row == NULL || PyList_Append(list, row) < 0) {
            Py_CLEAR(list);
        }
        Py_XDECREF(row);
    }
    return list;
}

/* --- steps --- */

/* What the steps of some states have in common. */
typedef struct {
    const char *function;
    model m;
    size_t count; /* states */
} batch;

/* Bind the model and the states, the first two arguments, and look at each state. Return 0, or -1
 * with an exception set. */
static int begin_batch(batch *of, const char *function, const argument *taken)
{
    size_t size, i;
    state at;
    of->function = function;
    if (model_view(taken[0].is.doubles, (size_t)taken[0].length, &of->m) < 0) {
        PyErr_Format(PyExc_ValueError, "%s: model: expected a model's record", function);
        return -1;
    }
    size = state_size(&of->m.s);
    of->count = (size_t)taken[1].length / size;
    if ((size_t)taken[1].length != of->count * size) {
        PyErr_Format(PyExc_ValueError, "%s: states: expected records of %zu numbers, got %zd",
                     function, size, taken[1].length);
        return -1;
    }
    for (i = 0; i < of->count; i++) {
        state_bind(&at, &of->m.s, taken[1].is.doubles + i * size);
        if (!state_is_sound(&of->m, &at)) {
            PyErr_Format(PyExc_ValueError, "%s: states: state %zu is no state of this model",
                         function, i);
            return -1;
        }
    }
    return 0;
}

/* Return the state at a place. */
static state state_at(const batch *of, double *states, size_t place)
{
    state at;
    state_bind(&at, &of->m.s, states + place * state_size(&of->m.s));
    return at;
}

static PyObject *estimator_correct(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "estimator_correct", format[] = "dDdD";
    argument taken[4];
    batch of;
    size_t i, p, size;
    int failed;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    failed = begin_batch(&of, name, taken) < 0;
    if (!failed) {
        p = (size_t)of.m.s.p;
        size = correction_size(&of.m.s);
        failed = require_length(name, "y", &taken[2], of.count * p) < 0
                 || require_length(name, "corrections", &taken[3], of.count * size) < 0;
    }
    for (i = 0; !failed && i < of.count; i++) {
        state at = state_at(&of, taken[1].is.doubles, i);
        correction effect;
        correction_bind(&effect, &of.m.s, taken[3].is.doubles + i * size);
        correct(&of.m, &at, taken[2].is.doubles + i * p, &effect);
    }
    release_arguments(format, taken);
    return failed ? NULL : Py_NewRef(Py_None);
}

static PyObject *estimator_predict(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "estimator_predict", format[] = "dDdfiD";
    argument taken[6];
    batch of;
    work scratch;
    size_t i, m;
    int failed;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    failed = begin_batch(&of, name, taken) < 0;
    if (!failed) {
        m = (size_t)of.m.s.m;
        failed = require_length(name, "u", &taken[2], of.count * m) < 0
                 || require_length(name, "work", &taken[5], work_size(&of.m.s)) < 0;
    }
    if (!failed && !(0.0 <= taken[3].is.number && taken[3].is.number <= LONGEST)) {
        PyErr_Format(PyExc_ValueError, "%s: duration: expected a finite number of at least 0", name);
        failed = 1;
    }
    if (!failed) {
        work_bind(&scratch, &of.m.s, taken[5].is.doubles);
    }
    for (i = 0; !failed && i < of.count; i++) {
        state at = state_at(&of, taken[1].is.doubles, i);
        predict(&of.m, &at, taken[2].is.doubles + i * m, taken[3].is.number,
                taken[4].is.integer != 0, &scratch);
    }
    release_arguments(format, taken);
    return failed ? NULL : Py_NewRef(Py_None);
}

static PyObject *estimator_read(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "estimator_read", format[] = "ddDD";
    argument taken[4];
    batch of;
    work scratch;
    size_t i, size;
    int failed;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    failed = begin_batch(&of, name, taken) < 0;
    if (!failed) {
        size = estimate_size(&of.m.s);
        failed = require_length(name, "rows", &taken[2], of.count * size) < 0
                 || require_length(name, "work", &taken[3], work_size(&of.m.s)) < 0;
    }
    if (!failed) {
        work_bind(&scratch, &of.m.s, taken[3].is.doubles);
    }
    for (i = 0; !failed && i < of.count; i++) {
        const state at = state_at(&of, taken[1].is.doubles, i);
        estimate said;
        estimate_bind(&said, &of.m.s, taken[2].is.doubles + i * size);
        read_out(&of.m, &at, &said, &scratch);
    }
    release_arguments(format, taken);
    return failed ? NULL : Py_NewRef(Py_None);
}

/* Step a state through its samples and write a row after each. */
static void observe_one(
    const model *m, state *at, const double *y, const double *u, double duration, long samples,
    correction *effect, work *scratch, double *row)
{
    const long p = (long)m->s.p, inputs = (long)m->s.m;
    estimate said;
    long sample;
    for (sample = 0; sample < samples; sample++) {
        if (sample > 0) {
            predict(m, at, at->held, duration, 0, scratch);
        }
        take_torque(m, at, u + sample * inputs);
        if (has_finite(y + sample * p, p)) {
            correct(m, at, y + sample * p, effect);
        }
        row = estimate_bind(&said, &m->s, row);
        read_out(m, at, &said, scratch);
    }
}

static PyObject *estimator_observe(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char name[] = "estimator_observe", format[] = "dDddfiDDD";
    argument taken[9];
    batch of;
    correction effect;
    work scratch;
    size_t i, p, m, wide, samples = 0;
    int failed;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    failed = begin_batch(&of, name, taken) < 0;
    if (!failed && (taken[5].is.integer < 0 || taken[5].is.integer > 1000000000)) {
        PyErr_Format(PyExc_ValueError, "%s: samples: expected a number of at least 0", name);
        failed = 1;
    }
    if (!failed && !(0.0 <= taken[4].is.number && taken[4].is.number <= LONGEST)) {
        PyErr_Format(PyExc_ValueError, "%s: duration: expected a finite number of at least 0", name);
        failed = 1;
    }
    if (!failed) {
        p = (size_t)of.m.s.p;
        m = (size_t)of.m.s.m;
        wide = estimate_size(&of.m.s);
        samples = (size_t)taken[5].is.integer;
        failed = require_length(name, "y", &taken[2], of.count * samples * p) < 0
                 || require_length(name, "u", &taken[3], of.count * samples * m) < 0
                 || require_length(name, "correction", &taken[6], correction_size(&of.m.s)) < 0
                 || require_length(name, "work", &taken[7], work_size(&of.m.s)) < 0
                 || require_length(name, "rows", &taken[8], of.count * samples * wide) < 0;
    }
    if (!failed) {
        correction_bind(&effect, &of.m.s, taken[6].is.doubles);
        work_bind(&scratch, &of.m.s, taken[7].is.doubles);
        Py_BEGIN_ALLOW_THREADS
        for (i = 0; i < of.count; i++) {
            state at = state_at(&of, taken[1].is.doubles, i);
            observe_one(
                &of.m, &at, taken[2].is.doubles + i * samples * p,
                taken[3].is.doubles + i * samples * m, taken[4].is.number, (long)samples, &effect,
                &scratch, taken[8].is.doubles + i * samples * wide);
        }
        Py_END_ALLOW_THREADS
    }
    release_arguments(format, taken);
    return failed ? NULL : Py_NewRef(Py_None);
}

PyMethodDef estimator_methods[] = {
    BINDING("estimator_layouts", estimator_layouts, "Return the layouts of an estimator's records."),
    {"bank_constants", bank_constants, METH_NOARGS, "Return the constants of the bank."},
    BINDING("estimator_correct", estimator_correct, "Use one measurement for each state."),
    BINDING("estimator_predict", estimator_predict, "Predict each state over a time."),
    BINDING("estimator_read", estimator_read, "Write the estimate of each state."),
    BINDING("estimator_observe", estimator_observe, "Step each state through its samples."),
    {NULL, NULL, 0, NULL},
};
