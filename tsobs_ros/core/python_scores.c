/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of scores.
 */
#include "python.h"
#include "scores.h"

/* Return whether each quantity's truth and estimate are where the arrays have numbers. */
static int are_places_sound(const scored_runs *runs, const score_options *options)
{
    int64_t item, i;
    for (item = 0; item < options->quantities; item++) {
        const int64_t *place = options->places + 4 * item;
        if (place[0] < 0 || place[0] > 2 || place[1] < 0 || place[1] >= runs->columns[place[0]] ||
            place[2] >= runs->width || place[3] >= runs->width) {
            return 0;
        }
    }
    for (i = 0; i < options->bases; i++) {
        if (options->claims[i] < 0 || options->claims[i] >= options->claim_count) {
            return 0;
        }
    }
    return runs->columns[0] > 0 && runs->basis >= 0 && runs->basis + 1 < runs->width;
}

/* Fill in the views of what is given; return whether all lengths belong together. */
static int take_runs(const argument *taken, scored_runs *runs, score_options *options)
{
    const double *limits = taken[0].is.doubles;
    int64_t rows, i;
    int is_whole;
    runs->samples = taken[5].length;
    runs->runs = taken[9].length;
    rows = runs->runs * runs->samples;
    if (taken[0].length < 4 || rows <= 0 || taken[10].length % rows != 0) {
        return 0;
    }
    is_whole = 1;
    for (i = 0; i < 3; i++) {
        runs->truths[i] = taken[6 + i].is.doubles;
        runs->columns[i] = taken[6 + i].length / rows;
        is_whole = is_whole && taken[6 + i].length % rows == 0;
    }
    runs->basis = taken[4].is.integer;
    runs->times = taken[5].is.doubles;
    runs->last_measured = taken[9].is.integers;
    runs->rows = taken[10].is.doubles;
    runs->width = taken[10].length / rows;
    options->quantities = taken[2].length;
    options->bases = taken[3].length;
    options->claim_count = taken[13].length / runs->runs;
    options->places = taken[1].is.integers;
    options->jumps = taken[2].is.doubles;
    options->claims = taken[3].is.integers;
    options->after_start = limits[0];
    options->after_jump = limits[1];
    options->same_jump = limits[2];
    options->sigmas = limits[3];
    return is_whole && taken[1].length >= 4 * options->quantities &&
           are_places_sound(runs, options);
}

static PyObject *scores_add_up(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "scores_add_up", *const format = "ddddiddddddDDDDD";
    PyObject *result = NULL;
    argument taken[16];
    scored_runs runs;
    score_options options;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    if (!take_runs(taken, &runs, &options)) {
        PyErr_Format(PyExc_ValueError, "%s: the arrays do not belong together", name);
    } else {
        const size_t items = (size_t)(runs.runs * options.quantities);
        const score_sums sums = {taken[11].is.doubles, taken[12].is.doubles, taken[14].is.doubles,
                                 taken[15].is.doubles, taken[13].is.integers};
        if (require_length(name, "settled", &taken[11], 5 * items) == 0 &&
            require_length(
                name, "claimed", &taken[12], 4 * items * (size_t)options.claim_count) == 0 &&
            require_length(name, "reach", &taken[14], (size_t)runs.runs) == 0 &&
            require_length(name, "scratch", &taken[15], 2 * (size_t)options.quantities) == 0) {
            Py_BEGIN_ALLOW_THREADS
            add_up(&runs, &options, &sums);
            Py_END_ALLOW_THREADS
            result = Py_NewRef(Py_None);
        }
    }
    release_arguments(format, taken);
    return result;
}

PyMethodDef scores_methods[] = {
    BINDING("scores_add_up", scores_add_up, "Add up what scores are made of; see scores.h."),
    {NULL, NULL, 0, NULL},
};
