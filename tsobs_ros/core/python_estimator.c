/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of the estimator: its steps for some states one after the other.
 */
#include "estimator.h"
#include "matrices.h"
#include "python.h"

/* Longest duration of a step [s], whose periods can be counted. */
#define LONGEST 1e12

#define CONSTANT_ROW(name, value, what) {#name, value, what},

BIND(bank_constants, "", "")
{
    static const struct {
        const char *name;
        double value;
        const char *what;
    } rows[] = {BANK_CONSTANTS(CONSTANT_ROW)};
    PyObject *list = PyList_New(0);
    (void)of, (void)t;
    for (size_t i = 0; list != NULL && i < CONSTANTS; i++) {
        PyObject *row = Py_BuildValue("(sds)", rows[i].name, rows[i].value, rows[i].what);
        if (row == NULL || PyList_Append(list, row) < 0) {
            Py_CLEAR(list);
        }
        Py_XDECREF(row);
    }
    return list;
}

/* Bind the model and look at each state, the first two arguments. Return the number of states, or -1
 * with an exception. */
static int64_t begin_batch(const signature *of, const argument *t, model *m)
{
    if (model_view(t[0].is.doubles, (size_t)t[0].length, m) < 0) {
        refuse(of, "model: expected a model's record");
        return -1;
    }
    const int64_t size = (int64_t)state_size(&m->s), count = t[1].length / size;
    if (t[1].length != count * size) {
        PyErr_Format(PyExc_ValueError, "%s: states: expected records of %lld numbers, got %zd",
                     of->function, (long long)size, t[1].length);
        return -1;
    }
    for (int64_t i = 0; i < count; i++) {
        state at;
        state_bind(&at, &m->s, t[1].is.doubles + i * size);
        if (!state_is_sound(m, &at)) {
            PyErr_Format(PyExc_ValueError, "%s: states: state %lld is no state of this model",
                         of->function, (long long)i);
            return -1;
        }
    }
    return count;
}

/* Return the state at a place. */
static state state_at(const model *m, const argument *t, int64_t place)
{
    state at;
    state_bind(&at, &m->s, t[1].is.doubles + place * (int64_t)state_size(&m->s));
    return at;
}

/* Return whether an argument is a duration; else raise a ValueError. */
static int is_duration(const signature *of, const argument *t, int place)
{
    const double duration = t[place].is.number;
    return (0.0 <= duration && duration <= LONGEST) ||
           refuse(of, "duration: expected a finite number of at least 0") != NULL;
}

BIND(estimator_correct, "dDdD", "model states y corrections")
{
    model m;
    const int64_t count = begin_batch(of, t, &m);
    if (count < 0) {
        return NULL;
    }
    const int64_t size = (int64_t)correction_size(&m.s);
    if (!HAVE(2, count * m.s.p, count * size)) {
        return NULL;
    }
    for (int64_t i = 0; i < count; i++) {
        state at = state_at(&m, t, i);
        correction effect;
        correction_bind(&effect, &m.s, t[3].is.doubles + i * size);
        correct(&m, &at, t[2].is.doubles + i * m.s.p, &effect);
    }
    Py_RETURN_NONE;
}

BIND(estimator_predict, "dDdfiD", "model states u duration between_samples work")
{
    model m;
    work scratch;
    const int64_t count = begin_batch(of, t, &m);
    if (count < 0 || !HAVE(2, count * m.s.m) || !HAVE(5, (int64_t)work_size(&m.s)) ||
        !is_duration(of, t, 3)) {
        return NULL;
    }
    work_bind(&scratch, &m.s, t[5].is.doubles);
    for (int64_t i = 0; i < count; i++) {
        state at = state_at(&m, t, i);
        hold_inputs(&m, &at, t[2].is.doubles + i * m.s.m);
        predict(&m, &at, t[3].is.number, t[4].is.integer != 0, &scratch);
    }
    Py_RETURN_NONE;
}

BIND(estimator_read, "ddDD", "model states rows work")
{
    model m;
    work scratch;
    const int64_t count = begin_batch(of, t, &m);
    if (count < 0 ||
        !HAVE(2, count * (int64_t)estimate_size(&m.s), (int64_t)work_size(&m.s))) {
        return NULL;
    }
    double *row = t[2].is.doubles;
    work_bind(&scratch, &m.s, t[3].is.doubles);
    for (int64_t i = 0; i < count; i++) {
        const state at = state_at(&m, t, i);
        estimate said;
        row = estimate_bind(&said, &m.s, row);
        read_out(&m, &at, &said, &scratch);
    }
    Py_RETURN_NONE;
}

/* Step a state through its samples and write a row after each. */
static void observe_one(
    const model *m, state *at, const double *y, const double *u, double duration, int64_t samples,
    correction *effect, work *scratch, double *row)
{
    const int64_t p = m->s.p, inputs = m->s.m;
    estimate said;
    for (int64_t sample = 0; sample < samples; sample++) {
        if (sample > 0) {
            predict(m, at, duration, 0, scratch);
        }
        take_torque(m, at, u + sample * inputs);
        if (has_finite(y + sample * p, (long)p)) {
            correct(m, at, y + sample * p, effect);
        }
        row = estimate_bind(&said, &m->s, row);
        read_out(m, at, &said, scratch);
    }
}

BIND(estimator_observe, "dDddfiDDD", "model states y u duration samples correction work rows")
{
    model m;
    correction effect;
    work scratch;
    const int64_t samples = t[5].is.integer, count = begin_batch(of, t, &m);
    if (count < 0 || !is_duration(of, t, 4)) {
        return NULL;
    }
    if (samples < 0 || samples > 1000000000) {
        return refuse(of, "samples: expected a number of at least 0");
    }
    const int64_t p = m.s.p, inputs = m.s.m, wide = (int64_t)estimate_size(&m.s), all = count * samples;
    if (!HAVE(2, all * p, all * inputs) ||
        !HAVE(6, (int64_t)correction_size(&m.s), (int64_t)work_size(&m.s), all * wide)) {
        return NULL;
    }
    correction_bind(&effect, &m.s, t[6].is.doubles);
    work_bind(&scratch, &m.s, t[7].is.doubles);
    Py_BEGIN_ALLOW_THREADS
    for (int64_t i = 0; i < count; i++) {
        state at = state_at(&m, t, i);
        observe_one(
            &m, &at, t[2].is.doubles + i * samples * p, t[3].is.doubles + i * samples * inputs,
            t[4].is.number, samples, &effect, &scratch, t[8].is.doubles + i * samples * wide);
    }
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

BIND(estimator_innovations, "ddddfffiDDDD",
     "model durations y u link_friction motor_friction gate corrected_until innovations variances "
     "states scratch")
{
    model m;
    if (model_view(t[0].is.doubles, (size_t)t[0].length, &m) < 0 || m.s.k != 0) {
        return refuse(of, "model: expected a model's record without parameters");
    }
    const int64_t n = m.s.n, count = t[1].length, outputs = count * m.s.p;
    const sample_log log = {count, t[1].is.doubles, t[2].is.doubles, t[3].is.doubles};
    const filter_options options = {t[4].is.number, t[5].is.number, t[6].is.number};
    double *states = t[10].length > 0 ? t[10].is.doubles : NULL;
    const int rubs = options.link_friction > 0.0 || options.motor_friction > 0.0;
    if (rubs && *m.design_flow.kind != KIND_ARM) {
        return refuse(of, "link_friction, motor_friction: expected 0 of a model that is no arm");
    }
    for (int64_t i = 0; i < count; i++) {
        if (!(log.durations[i] <= LONGEST)) {
            return refuse(of, "durations: expected finite numbers");
        }
    }
    if (!HAVE(2, outputs, count * m.s.m) ||
        !HAVE(8, outputs, outputs, states != NULL ? count * n : 0,
              (int64_t)innovations_scratch_size(&m))) {
        return NULL;
    }
    Py_BEGIN_ALLOW_THREADS
    write_innovations(
        &m, &log, &options, t[7].is.integer, t[8].is.doubles, t[9].is.doubles, states,
        t[11].is.doubles);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

PyMethodDef estimator_methods[] = {
    METHOD(bank_constants),
    METHOD(estimator_correct),
    METHOD(estimator_predict),
    METHOD(estimator_read),
    METHOD(estimator_observe),
    METHOD(estimator_innovations),
    {NULL, NULL, 0, NULL},
};
