/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of trackers. The first four arguments are a tracker's memories: model, memory, ring and
 * scratch.
 */
#include "history.h"
#include "python.h"

#define TRACKER "model memory ring scratch"

/* Bind a tracker to the first four arguments; return whether they are its memories. */
static int take_tracker(const signature *of, const argument *t, tracker *bound)
{
    const tracker_memory given = {
        t[0].is.doubles, t[1].is.doubles, t[2].is.doubles, t[3].is.doubles,
        (size_t)t[0].length, (size_t)t[1].length, (size_t)t[2].length, (size_t)t[3].length,
    };
    const char *wrong = tracker_bind(bound, &given);
    return wrong == NULL || refuse(of, wrong) != NULL;
}

/* Return whether stamps, y and u, arguments from a place on, and what becomes of them, those from
 * another place on, belong together; take them. */
static int take_measurements(
    const signature *of, const argument *t, int from, int to, const tracker *by,
    measurements *given, outcomes *written)
{
    const int64_t count = t[from].length, outputs = count * by->m.s.p;
    *given = (measurements){
        count, t[from].is.integers, t[from + 1].is.doubles, t[from + 2].is.doubles};
    *written = (outcomes){t[to].is.integers, t[to + 1].is.integers, t[to + 2].is.doubles,
                          t[to + 3].is.doubles};
    return HAVE(from + 1, outputs, count * by->m.s.m) &&
           HAVE(to, count, outputs, outputs, outputs);
}

BIND(history_scratch_size, "di", "model slots")
{
    model m;
    const rewind_sizes sizes = {&m.s, t[1].is.integer};
    if (model_view(t[0].is.doubles, (size_t)t[0].length, &m) < 0 || t[1].is.integer < 0 ||
        t[1].is.integer > INT32_MAX) {
        return refuse(of, "expected a model record and a number");
    }
    return PyLong_FromSize_t(rewind_scratch_size(&sizes));
}

BIND(history_offer, "dDDDdddiDDDD",
     TRACKER " stamps y u now codes output_codes innovations expected_std")
{
    tracker by;
    measurements given;
    outcomes written;
    if (!take_tracker(of, t, &by) || !take_measurements(of, t, 4, 8, &by, &given, &written)) {
        return NULL;
    }
    offer(&by, &given, t[7].is.integer, &written);
    Py_RETURN_NONE;
}

BIND(history_estimate, "dDDDiD", TRACKER " stamp row")
{
    tracker by;
    if (!take_tracker(of, t, &by) || !HAVE(5, (int64_t)estimate_size(&by.m.s))) {
        return NULL;
    }
    return PyBool_FromLong(estimate_at(&by, t[4].is.integer, t[5].is.doubles));
}

BIND(history_advance, "dDDD" "ddd" "DDDD" "ddd" "DDDi",
     TRACKER " stamps y u codes output_codes innovations expected_std"
             " tick_stamps now known newest there rows stale_after")
{
    tracker by;
    measurements given;
    outcomes written;
    const int64_t count = t[11].length;
    int64_t before = 0;
    if (!take_tracker(of, t, &by) || !take_measurements(of, t, 4, 7, &by, &given, &written) ||
        !HAVE(12, count, count, count, count, count * (int64_t)estimate_size(&by.m.s))) {
        return NULL;
    }
    for (int64_t tick = 0; tick < count; tick++) {
        if (t[13].is.integers[tick] < before || t[13].is.integers[tick] > given.count) {
            return refuse(of, "known: expected numbers of samples that ascend");
        }
        before = t[13].is.integers[tick];
    }
    const history_ticks ticks = {
        count, t[11].is.integers, t[12].is.integers, t[13].is.integers,
        t[14].is.integers, t[15].is.integers, t[16].is.doubles,
    };
    Py_BEGIN_ALLOW_THREADS
    advance(&by, &given, &written, &ticks, t[17].is.integer);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

PyMethodDef history_methods[] = {
    METHOD(history_scratch_size), METHOD(history_offer),
    METHOD(history_estimate),     METHOD(history_advance),  {NULL, NULL, 0, NULL},
};
