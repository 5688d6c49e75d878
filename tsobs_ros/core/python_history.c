/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of histories, and of replays by them. The first four arguments of each are a tracker's
 * memories: model, memory, ring and scratch.
 */
#include "python.h"
#include "replay.h"

/* --- arguments --- */

/* Bind a tracker to four arguments; return 0, or -1 with an exception. */
static int take_tracker(const char *function, const argument *taken, tracker *bound)
{
    const tracker_memory given = {
        taken[0].is.doubles, taken[1].is.doubles, taken[2].is.doubles, taken[3].is.doubles,
        (size_t)taken[0].length, (size_t)taken[1].length, (size_t)taken[2].length,
        (size_t)taken[3].length,
    };
    const char *wrong = tracker_bind(bound, &given);
    if (wrong != NULL) {
        PyErr_Format(PyExc_ValueError, "%s: %s", function, wrong);
        return -1;
    }
    return 0;
}

/* Take stamps, y and u from three arguments; return 0, or -1 with an exception. */
static int take_measurements(
    const char *function, const argument *taken, const tracker *t, measurements *given)
{
    const size_t count = (size_t)taken[0].length;
    given->count = taken[0].length;
    given->stamps = taken[0].is.integers;
    given->y = taken[1].is.doubles;
    given->u = taken[2].is.doubles;
    if (require_length(function, "y", &taken[1], count * (size_t)t->m.s.p) < 0) {
        return -1;
    }
    return require_length(function, "u", &taken[2], count * (size_t)t->m.s.m);
}

/* Take what becomes of so many measurements from four arguments; return 0, or -1. */
static int take_outcomes(
    const char *function, const argument *taken, const tracker *t, int64_t count, outcomes *written)
{
    const size_t samples = (size_t)count, outputs = samples * (size_t)t->m.s.p;
    written->codes = taken[0].is.integers;
    written->output_codes = taken[1].is.integers;
    written->innovations = taken[2].is.doubles;
    written->expected_std = taken[3].is.doubles;
    if (require_length(function, "outcomes", &taken[0], samples) < 0 ||
        require_length(function, "output_codes", &taken[1], outputs) < 0 ||
        require_length(function, "innovations", &taken[2], outputs) < 0) {
        return -1;
    }
    return require_length(function, "expected_std", &taken[3], outputs);
}

static size_t numbers_in_row(const tracker *t)
{
    return estimate_size(&t->m.s);
}

/* --- histories --- */

static const layout_field memory_layout[] = {HISTORY_FIELDS(LAYOUT_ROW, unused)};

static PyObject *layout(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module, (void)given, (void)count;
    return fields_as_list(memory_layout, sizeof memory_layout / sizeof memory_layout[0]);
}

static PyObject *scratch_size(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "history_scratch_size", *const format = "di";
    argument taken[2];
    PyObject *result = NULL;
    model m;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    if (model_view(taken[0].is.doubles, (size_t)taken[0].length, &m) < 0 ||
        taken[1].is.integer < 0 || taken[1].is.integer > INT32_MAX) {
        PyErr_Format(PyExc_ValueError, "%s: expected a model record and a number", name);
    } else {
        const rewind_sizes sizes = {&m.s, taken[1].is.integer};
        result = PyLong_FromSize_t(rewind_scratch_size(&sizes));
    }
    release_arguments(format, taken);
    return result;
}

static PyObject *history_is_sound(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "history_is_sound", *const format = "dDDD";
    argument taken[4];
    PyObject *result = NULL;
    tracker t;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    if (take_tracker(name, taken, &t) == 0) {
        result = PyBool_FromLong(are_states_sound(&t));
    }
    release_arguments(format, taken);
    return result;
}

static PyObject *history_offer(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "history_offer", *const format = "dDDDdddiDDDD";
    argument taken[12];
    PyObject *result = NULL;
    tracker t;
    measurements samples;
    outcomes written;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    if (take_tracker(name, taken, &t) == 0 &&
        take_measurements(name, taken + 4, &t, &samples) == 0 &&
        take_outcomes(name, taken + 8, &t, samples.count, &written) == 0) {
        offer(&t, &samples, taken[7].is.integer, &written);
        result = Py_NewRef(Py_None);
    }
    release_arguments(format, taken);
    return result;
}

static PyObject *history_estimate(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "history_estimate", *const format = "dDDDiD";
    argument taken[6];
    PyObject *result = NULL;
    tracker t;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    if (take_tracker(name, taken, &t) == 0 &&
        require_length(name, "row", &taken[5], numbers_in_row(&t)) == 0) {
        result = PyBool_FromLong(estimate_at(&t, taken[4].is.integer, taken[5].is.doubles));
    }
    release_arguments(format, taken);
    return result;
}

/* Return whether stamps ascend, and are later than any before. */
static int do_ascend(const tracker *t, const measurements *given)
{
    int64_t before = newest_stamp(t), i;
    for (i = 0; i < given->count; i++) {
        if (given->stamps[i] <= before) {
            return 0;
        }
        before = given->stamps[i];
    }
    return 1;
}

static PyObject *history_follow(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "history_follow", *const format = "dDDDdddD";
    argument taken[8];
    PyObject *result = NULL;
    tracker t;
    measurements samples;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    if (take_tracker(name, taken, &t) == 0 &&
        take_measurements(name, taken + 4, &t, &samples) == 0 &&
        require_length(
            name, "rows", &taken[7], (size_t)samples.count * numbers_in_row(&t)) == 0) {
        if (!do_ascend(&t, &samples)) {
            PyErr_Format(PyExc_ValueError, "%s: stamps: expected them to ascend", name);
        } else {
            Py_BEGIN_ALLOW_THREADS
            follow(&t, &samples, taken[7].is.doubles);
            Py_END_ALLOW_THREADS
            result = Py_NewRef(Py_None);
        }
    }
    release_arguments(format, taken);
    return result;
}

static PyObject *history_copy(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "history_copy", *const format = "dDDDdDDD";
    argument taken[8];
    PyObject *result = NULL;
    tracker from, to;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    if (take_tracker(name, taken, &from) == 0 && take_tracker(name, taken + 4, &to) == 0) {
        if (from.slots != to.slots || from.state_size != to.state_size) {
            PyErr_Format(PyExc_ValueError, "%s: expected rings of the same size", name);
        } else {
            copy_history(&from, &to);
            result = Py_NewRef(Py_None);
        }
    }
    release_arguments(format, taken);
    return result;
}

static PyObject *history_forget(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "history_forget", *const format = "dDDD";
    argument taken[4];
    PyObject *result = NULL;
    tracker t;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    if (take_tracker(name, taken, &t) == 0) {
        forget(&t);
        result = Py_NewRef(Py_None);
    }
    release_arguments(format, taken);
    return result;
}

/* --- replays --- */

/* Take ticks from six arguments, of which all or none have estimates; return 0, or -1. */
static int take_ticks(const char *function, const argument *taken, const tracker *t,
                      replay_ticks *ticks)
{
    static const char *const names[] = {"stamps", "now", "min_known", "max_known", "reset_after"};
    const Py_ssize_t count = taken[0].length;
    int64_t i;
    for (i = 1; i < 5; i++) {
        if (require_length(function, names[i], &taken[i], (size_t)count) < 0) {
            return -1;
        }
    }
    ticks->stamps = taken[0].is.integers;
    ticks->now = taken[1].is.integers;
    ticks->min_known = taken[2].is.integers;
    ticks->max_known = taken[3].is.integers;
    ticks->reset_after = taken[4].is.integers;
    ticks->estimates = taken[5].is.doubles;
    ticks->width = count > 0 ? taken[5].length / count : 0;
    if (ticks->width > 2 * t->m.s.plant || (count > 0 && taken[5].length % count != 0)) {
        PyErr_Format(PyExc_ValueError, "%s: estimates: expected states and bounds", function);
        return -1;
    }
    return 0;
}

/* Take results from nine arguments, and check that the ticks use samples that there are. */
static int take_results(
    const char *function, const argument *taken, const tracker *t, int64_t samples, int64_t ticks,
    replay_results *results)
{
    if (take_outcomes(function, taken, t, samples, &results->of_samples) < 0 ||
        require_length(function, "ticks_of_use", &taken[4], (size_t)samples) < 0 ||
        require_length(function, "newest", &taken[5], (size_t)ticks) < 0 ||
        require_length(function, "there", &taken[6], (size_t)ticks) < 0 ||
        require_length(function, "counts", &taken[7], 2) < 0) {
        return -1;
    }
    results->ticks_of_use = taken[4].is.integers;
    results->newest = taken[5].is.integers;
    results->there = taken[6].is.integers;
    results->counts = taken[7].is.integers;
    results->rows = taken[8].is.doubles;
    return 0;
}

/* Return whether a range of ticks uses samples that there are, one after the other. */
static int is_range_sound(
    const replay_ticks *ticks, const replay_results *results, int64_t samples, int64_t count,
    int64_t begin, int64_t end)
{
    int64_t tick;
    if (begin < 0 || end > count || results->counts[0] < 0) {
        return 0;
    }
    for (tick = begin; tick < end; tick++) {
        if (ticks->min_known[tick] > samples) {
            return 0;
        }
    }
    return 1;
}

static PyObject *replay_advance(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "replay_advance";
    static const char *const format = "dDDD" "ddddd" "dddddd" "DDDDDDDDD" "iii";
    argument taken[27];
    PyObject *result = NULL;
    tracker t;
    replay_samples samples;
    replay_ticks ticks;
    replay_results results;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    if (take_tracker(name, taken, &t) == 0 &&
        take_measurements(name, taken + 4, &t, &samples.given) == 0 &&
        require_length(name, "evidence", &taken[7], (size_t)samples.given.count) == 0 &&
        require_length(name, "begins", &taken[8], (size_t)samples.given.count) == 0 &&
        take_ticks(name, taken + 9, &t, &ticks) == 0 &&
        take_results(
            name, taken + 15, &t, samples.given.count, taken[9].length, &results) == 0) {
        const int64_t begin = taken[24].is.integer, end = taken[25].is.integer;
        const size_t rows = end > begin ? (size_t)(end - begin) : 0;
        samples.evidence = taken[7].is.integers;
        samples.begins = taken[8].is.integers;
        if (!is_range_sound(
                &ticks, &results, samples.given.count, taken[9].length, begin, end)) {
            PyErr_Format(PyExc_ValueError, "%s: the ticks do not belong to the samples", name);
        } else if (require_length(name, "rows", &taken[23], rows * numbers_in_row(&t)) == 0) {
            int64_t next;
            Py_BEGIN_ALLOW_THREADS
            next = make_ticks(
                &t, &samples, &ticks, &results, begin, end, taken[26].is.integer);
            Py_END_ALLOW_THREADS
            result = PyLong_FromLongLong(next);
        }
    }
    release_arguments(format, taken);
    return result;
}

PyMethodDef history_methods[] = {
    BINDING("history_layout", layout, "Return the fields of a history's record."),
    BINDING("history_scratch_size", scratch_size, "Return the numbers of a history's scratch."),
    BINDING("history_is_sound", history_is_sound, "Return whether all states are the model's."),
    BINDING("history_offer", history_offer, "Use measurements; see history.h."),
    BINDING("history_estimate", history_estimate, "Write the estimate at a stamp."),
    BINDING("history_follow", history_follow, "Use measurements and estimate at each."),
    BINDING("history_copy", history_copy, "Copy a history to another tracker."),
    BINDING("history_forget", history_forget, "Forget all measurements."),
    BINDING("replay_advance", replay_advance, "Make ticks; see replay.h."),
    {NULL, NULL, 0, NULL},
};
