/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "tsobs.h"

#include <string.h>

#include "arithmetic.h"

static const double NANOSECONDS = 1e9;

/* --- the ring --- */

/* Return the numbers of the state at a place, counted from the oldest state. */
static double *numbers_at(const tracker *t, int64_t place)
{
    const int64_t slot = (*t->h.first + place) % *t->h.turn;
    return t->room.ring + (size_t)slot * t->state_size;
}

/* Return the state at a place, counted from the oldest state. */
static state state_at(const tracker *t, int64_t place)
{
    return state_view(&t->m.s, numbers_at(t, place));
}

/* Return the stamp of the state at a place [ns], which is the state's first number. */
static int64_t stamp_at(const tracker *t, int64_t place)
{
    return *(const int64_t *)(const void *)numbers_at(t, place);
}

/* Return the newest stamp [ns], or 0 if there is none. */
static int64_t newest_stamp(const tracker *t)
{
    return *t->h.length > 0 ? stamp_at(t, *t->h.length - 1) : 0;
}

/* Return the number of states in the ring up to a stamp [ns]; mostly these are all. */
static int64_t count_up_to(const tracker *t, int64_t stamp)
{
    int64_t low = 0, high = *t->h.length;
    if (newest_stamp(t) <= stamp) {
        return high;
    }
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (stamp_at(t, middle) <= stamp) {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    return low;
}

int tsobs_history_is_sound(const history *h)
{
    return *h->max_steps >= 1 && *h->max_steps <= MOST_STEPS && *h->first >= 0
           && *h->turn <= *h->max_steps + SPARE_SLOTS && (*h->first == 0 || *h->first < *h->turn)
           && *h->length >= 0 && *h->length <= *h->turn && *h->length <= *h->max_steps + 1
           && *h->span >= 0 && *h->future >= 0 && *h->restart_after >= 0;
}

const char *tsobs_tracker_bind(
    tracker *view, double *model, size_t model_length, double *room, size_t room_length)
{
    const char *wrong = model_view(model, model_length, &view->m);
    if (wrong != NULL) {
        return wrong;
    }
    if (room_length < history_size(NULL)) {
        return "expected the room of a tracker";
    }
    view->h = history_view(NULL, room);
    if (!tsobs_history_is_sound(&view->h)) {
        return "expected a history whose places and limits belong together";
    }
    const room_sizes sizes = {&view->m.s, *view->h.max_steps + SPARE_SLOTS};
    if (room_length != tracker_room_size(&sizes)) {
        return "expected the room of a tracker of this model";
    }
    view->room = tracker_room_view(&sizes, room);
    view->state_size = state_size(&view->m.s);
    view->effect = correction_view(&view->m.s, view->room.effect);
    view->scratch = work_view(&view->m.s, view->room.work);
    return NULL;
}

/* --- measurements --- */

/* Return whether inputs are used without outputs: new ones, in a gap within `restart_after`. */
static int moves_by_inputs(const tracker *t, int64_t place, int64_t stamp, const double *u)
{
    const model *m = &t->m;
    /* Torques on their way to the motor are remembered, but only one per period. */
    const double least = m->s.past > 0 ? 0.5 * NANOSECONDS * *m->period : 1.0;
    double since = INFINITY;
    if (*m->gain_mode == GAIN_OPEN || m->s.m == 0 || count_finite(u, (long)m->s.m) < m->s.m
        || place < 0 || (double)(stamp - stamp_at(t, place)) < least) {
        return 0;
    }
    const state at = state_at(t, place);
    for (long i = 0; i < m->s.p; i++) {
        since = minimum(since, *sensor_of(m, &at, i).since);
    }
    return since * NANOSECONDS + (double)(stamp - *at.stamp) <= (double)*t->h.restart_after;
}

/* Return why a measurement cannot be used, or USED. */
static int64_t refusal(
    const tracker *t, int64_t stamp, const double *y, const double *u, int64_t now)
{
    const history *h = &t->h;
    const int64_t place = count_up_to(t, stamp) - 1;
    const int has_inputs = *t->m.torque_limit > 0.0 /* then take_torque judges them */
                           || count_finite(u, (long)t->m.s.m) == t->m.s.m;
    const int has_outputs = count_finite(y, (long)t->m.s.p) > 0;
    if (!has_inputs || !(has_outputs || moves_by_inputs(t, place, stamp, u))) {
        return NON_FINITE;
    }
    if (stamp <= 0) {
        return ZERO_STAMP;
    }
    if (stamp - *h->future > now) {
        return FROM_FUTURE;
    }
    if (stamp < newest_stamp(t) - *h->span
        || (*h->length > *h->max_steps && stamp <= stamp_at(t, 0))) {
        return TOO_OLD;
    }
    return place >= 0 && stamp_at(t, place) == stamp ? DUPLICATE : USED;
}

/* Start over from the initial state, but keep the state's counts, which are neighbours. */
static void restart(tracker *t, double *numbers, state *at, int failed)
{
    int64_t counts[1 + (OTHERWISE + 1) + OUTCOMES + 2];
    memcpy(counts, at->outliers, sizeof counts);
    copy_state(&t->m, t->m.initial, numbers);
    memcpy(at->outliers, counts, sizeof counts);
    *at->restarts += 1;
    *at->failures += failed;
}

/* Correct a state by a measurement; return whether innovations and their variances are finite. */
static int correct_by_sample(tracker *t, state *at, const double *y, const double *u)
{
    double total = 0.0;
    take_torque(&t->m, at, u);
    correct(&t->m, at, y, &t->effect);
    for (int64_t i = 0; i < t->m.s.p; i++) {
        total += isfinite(y[i]) ? t->effect.innovation[i] : 0.0;
        total += t->effect.innovation_variance[i];
    }
    return isfinite(total) != 0;
}

/* Forget the oldest states: those beyond the largest number, and those out of reach of a late
 * measurement, except for the newest of these, at which a rewind can begin. */
static void forget_oldest(tracker *t, int64_t stamp)
{
    history *h = &t->h;
    while (*h->length > *h->max_steps + 1
           || (*h->length > 1 && stamp_at(t, 1) < stamp - *h->span)) {
        *h->first = (*h->first + 1) % *h->turn;
        *h->length -= 1;
    }
}

/* Make room in the ring for one more state. The ring cycles through only as many slots as were
 * needed so far, so that a slot is still in the processor's cache when it is used again. */
static void widen_ring(tracker *t)
{
    history *h = &t->h;
    const int64_t turn = *h->turn, slots = *h->max_steps + SPARE_SLOTS;
    if (*h->length < turn) {
        return;
    }
    *h->turn = 2 * turn < slots - 2 ? 2 * turn + 2 : slots;
    if (*h->first > 0) { /* the oldest states move to the new end */
        double *oldest = numbers_at(t, 0);
        const size_t size = t->state_size, count = (size_t)(turn - *h->first);
        *h->first += *h->turn - turn;
        memmove(numbers_at(t, 0), oldest, count * size * sizeof *oldest);
    }
}

/* Predict the newest state to a measurement, correct, and store it; return the outcome. */
static int64_t step_to(tracker *t, int64_t stamp, const double *y, const double *u)
{
    history *h = &t->h;
    widen_ring(t);
    double *numbers = numbers_at(t, *h->length);
    state at = state_view(&t->m.s, numbers);
    int used = 0;
    if (*h->length == 0) {
        copy_state(&t->m, t->m.initial, numbers);
    } else {
        const int64_t elapsed = stamp - stamp_at(t, *h->length - 1);
        copy_state(&t->m, numbers_at(t, *h->length - 1), numbers);
        if (elapsed > *h->restart_after) {
            restart(t, numbers, &at, 0);
        } else {
            predict(&t->m, &at, (double)elapsed / NANOSECONDS, 0, &t->scratch);
        }
    }
    if (!correct_by_sample(t, &at, y, u)) {
        restart(t, numbers, &at, 1);
        correct_by_sample(t, &at, y, u);
    }
    int64_t code = *at.torque_unknown != 0 ? IMPLAUSIBLE_TORQUE : USED;
    for (int64_t i = 0; i < t->m.s.m; i++) {
        code = isnan(u[i]) ? UNKNOWN_INPUT : code;
    }
    for (int64_t i = 0; i < t->m.s.p; i++) {
        used = used || outlook_of(&t->effect, i)->used;
    }
    code = used ? code : count_finite(y, (long)t->m.s.p) > 0 ? GATED : NON_FINITE;
    *at.stamp = stamp;
    memcpy(at.u, u, (size_t)t->m.s.m * sizeof *u);
    at.judged[code] += code != USED;
    *h->length += 1;
    *h->steps += 1;
    *h->coasted_periods = 0;
    forget_oldest(t, stamp);
    return code;
}

/* Drop states from a place on, but keep their measurements for a rewind; return their number. */
static int64_t set_aside(tracker *t, int64_t place)
{
    const size_t p = (size_t)t->m.s.p, m = (size_t)t->m.s.m;
    const int64_t count = *t->h.length - place;
    for (int64_t j = 0; j < count; j++) {
        const state step = state_at(t, place + j);
        t->room.stamps[j] = *step.stamp;
        memcpy(t->room.y + (size_t)j * p, step.y, p * sizeof *step.y);
        memcpy(t->room.u + (size_t)j * m, step.u, m * sizeof *step.u);
    }
    *t->h.length = place;
    return count;
}

/* Write the outcome of each output of a measurement that was not refused. */
static void write_outcome(const tracker *t, const double *y, const outcomes *written, int64_t i)
{
    const int64_t p = t->m.s.p;
    for (int64_t j = 0; j < p; j++) {
        const double variance = t->effect.innovation_variance[j];
        const int64_t code = outlook_of(&t->effect, j)->used ? USED : GATED;
        written->output_codes[i * p + j] = isfinite(y[j]) ? code : NON_FINITE;
        written->innovations[i * p + j] = code == USED ? t->effect.innovation[j] : NAN;
        written->expected_std[i * p + j] = variance >= 0.0 ? sqrt(variance) : NAN;
    }
}

/* Offer the measurements i to end - 1. */
static void offer_some(
    tracker *t, const measurements *given, int64_t i, int64_t end, int64_t now,
    const outcomes *written)
{
    const int64_t p = t->m.s.p, m = t->m.s.m;
    /* In a rewind: the number of measurements set aside, and of those already used again. */
    int64_t aside = 0, again = 0;
    while (i < end || again < aside) {
        /* A measurement older than the newest state waits until the rewind is over. */
        const int is_repeated =
            again < aside && (i >= end || given->stamps[i] > t->room.stamps[again] ||
                              given->stamps[i] < newest_stamp(t));
        if (is_repeated) {
            step_to(t, t->room.stamps[again], t->room.y + again * p, t->room.u + again * m);
            again++;
            continue;
        }
        const int64_t stamp = given->stamps[i];
        const double *y = given->y + i * p, *u = given->u + i * m;
        int64_t code = refusal(t, stamp, y, u, now);
        if (code == USED && again < aside && stamp == t->room.stamps[again]) {
            code = DUPLICATE;
        }
        if (code == USED) {
            if (again >= aside && stamp < newest_stamp(t)) {
                aside = set_aside(t, count_up_to(t, stamp));
                again = 0;
            }
            *t->h.rewinds += again < aside;
            *t->h.accepted += 1;
            code = step_to(t, stamp, y, u);
            write_outcome(t, y, written, i);
        } else {
            t->h.refused[code] += 1;
            for (int64_t j = 0; j < p; j++) {
                written->output_codes[i * p + j] = code;
                written->innovations[i * p + j] = written->expected_std[i * p + j] = NAN;
            }
        }
        written->codes[i++] = code;
    }
}

void tsobs_offer(tracker *t, const measurements *given, int64_t now, const outcomes *written)
{
    offer_some(t, given, 0, given->count, now, written);
}

/* --- estimates --- */

/* Return the state at a place, predicted over a duration [s] if that is above 0. The state after
 * the whole periods of a gap is kept, so that the next call does not predict through all of it. */
static state coast(tracker *t, int64_t place, double duration)
{
    history *h = &t->h;
    const double period = *t->m.period;
    const int64_t whole = duration > 2.0 * period ? (int64_t)floor(duration / period) : 0;
    const int is_memorable = place == *h->length - 1;
    int64_t taken = is_memorable && *h->coasted_periods <= whole ? *h->coasted_periods : 0;
    const double *from = taken > 0 ? t->room.coasted : numbers_at(t, place);
    state shown = state_view(&t->m.s, t->room.shown);
    if (!(duration > 0.0)) {
        return state_at(t, place);
    }
    copy_state(&t->m, from, t->room.shown);
    while (taken < whole) {
        /* The first two are one step, which the estimator does not take for a regular one. */
        const int64_t periods = taken == 0 ? 2 : 1;
        predict(&t->m, &shown, (double)periods * period, 0, &t->scratch);
        taken += periods;
    }
    if (whole > 0 && is_memorable) {
        copy_state(&t->m, t->room.shown, t->room.coasted);
        *h->coasted_periods = whole;
    }
    const double rest = duration - (double)whole * period;
    if (rest > 0.0) {
        predict(&t->m, &shown, rest, 1, &t->scratch);
    }
    return shown;
}

int tsobs_estimate_at(tracker *t, int64_t stamp, double *row)
{
    const int64_t place = count_up_to(t, stamp) - 1;
    if (place < 0) {
        return 0;
    }
    const int64_t elapsed = stamp - stamp_at(t, place);
    const double remaining = (double)elapsed / NANOSECONDS;
    if (elapsed > *t->h.restart_after) {
        return 0;
    }
    const state shown = coast(t, place, remaining);
    const estimate estimated = estimate_view(&t->m.s, row);
    if (!read_out(&t->m, &shown, &estimated, &t->scratch)) {
        *t->h.bad_outputs += 1;
        return 0;
    }
    const int is_inside = fabs(estimated.state[0]) <= *t->h.x_max;
    if (!is_inside && *estimated.basis <= BASIS_LEARNT) {
        *estimated.basis = BASIS_OUTSIDE;
        *estimated.claimed = 0.0;
    }
    *estimated.in_domain = is_inside;
    *estimated.age = remaining;
    return 1;
}

void tsobs_advance(
    tracker *t, const measurements *given, const outcomes *written, const history_ticks *ticks,
    int64_t stale_after)
{
    const int64_t width = (int64_t)estimate_size(&t->m.s);
    int64_t done = 0;
    for (int64_t tick = 0; tick < ticks->count; tick++) {
        const int64_t known = ticks->known[tick], stamp = ticks->stamps[tick];
        offer_some(t, given, done, known, ticks->now[tick], written);
        done = known;
        ticks->newest[tick] = newest_stamp(t);
        ticks->there[tick] = ticks->newest[tick] > 0 && stamp > 0 /* else no estimate is that old */
                             && stamp - ticks->newest[tick] <= stale_after
                             && tsobs_estimate_at(t, stamp, ticks->rows + tick * width);
    }
}
