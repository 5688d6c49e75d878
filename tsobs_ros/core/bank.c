/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The bank: all hypotheses together.
 *
 * Each sample adds its log-likelihood under each hypothesis to that hypothesis' score. If the best
 * hypothesis takes a sample for an outlier, the sample may also be the first sign of an event. So
 * forks of the best hypothesis suppose that the sensor jumped, that the arm was hit, or that it was
 * put elsewhere. If a torque stands out, a fork supposes that it never acted. The samples that
 * follow decide: the best fork takes its parent's place. Once per trial, a fork supposes that the
 * best hypothesis is wrong about the arm or its sensors.
 *
 * While nothing contradicts the design, it runs alone and the other hypotheses sleep. But if
 * parameters are learnt, all begin awake, as the start shows most about the parameters.
 */
#include "bank.h"

#include <string.h>

/* Kinds of an innovation in `scale_noise`; 0 is none. */
enum { REGULAR = 1, OUTLIER = 2 };

/* --- views --- */

int sizes_are_sound(const int64_t *numbers)
{
    estimator_sizes s;
    memcpy(&s, numbers, sizeof s);
    for (long i = 0; i < ESTIMATOR_SIZES; i++) {
        if (numbers[i] < 0 || numbers[i] > (i < 9 ? 1000 : 1000000000)) {
            return 0;
        }
    }
    return s.n >= 1 && s.plant >= 1 && s.plant <= s.n
           && (s.width == s.n || s.width >= s.n + 1 + (s.p > 6 ? s.p : 6))
           && (s.hypotheses == 1 || (s.hypotheses == STANDING + FORKS && s.width > s.n));
}

/* Return whether all places and kinds in a state are valid. */
static int state_is_sound(const model *m, const state *at)
{
    if (*at->best < 0 || *at->best >= m->s.hypotheses || *best_of(m, at).live == 0) {
        return 0;
    }
    for (long i = 0; i < m->s.hypotheses; i++) {
        const hypothesis h = hypothesis_of(m, at, i);
        if (*h.kind < 0 || *h.kind >= STANDING || *h.output < 0 || *h.output >= m->s.p
            || *h.fork < NO_FORK || *h.fork > OTHERWISE
            || (*h.kind != AS_DESIGNED && m->s.width == m->s.n)) {
            return 0;
        }
    }
    return 1;
}

const char *model_view(double *memory, size_t length, model *view)
{
    estimator_sizes *s = &view->s;
    if (length < ESTIMATOR_SIZES || !sizes_are_sound((const int64_t *)(void *)memory)) {
        return "expected a model's record";
    }
    memcpy(s, memory, sizeof *s);
    if (model_numbers_size(s) != length) {
        return "expected a model's record of another length";
    }
    MODEL_FIELDS(LAYOUT_BIND, s)
    if (!flow_is_sound(view->flow_record, (size_t)s->flow_size)) {
        return "expected a model's record with a flow";
    }
    const flow_sizes sizes = flow_sizes_of(view->flow_record);
    if (sizes.n != s->n || sizes.k != s->k
        || sizes.m != s->m + (*view->gain_mode == GAIN_OPEN ? 2 * s->p : 0)
        || flow_step_size(&sizes) > (size_t)s->scratch) {
        return "expected a model's record with a flow of its sizes";
    }
    view->design_flow = flow_view(&sizes, view->flow_record);
    const state initial = state_view(s, view->initial);
    if (!(*view->period >= SHORTEST) || (*view->supervised != 0 && s->hypotheses == 1)
        || (*view->torque_rate > 0.0 && s->width == s->n)
        || (s->m == 0 && (*view->torque_limit > 0.0 || *view->design_flow.kind == KIND_ARM))
        || ((*view->explains_motor != 0 || view->force[1] != 0.0)
            && *view->design_flow.kind != KIND_ARM)
        || !state_is_sound(view, &initial)) {
        return "expected a model's record of numbers that belong together";
    }
    return NULL;
}

void copy_state(const model *m, const double *from, double *to)
{
    const size_t all = (size_t)m->s.hypotheses, size = hypothesis_size(&m->s);
    const size_t first = state_size(&m->s) - all * size;
    memcpy(to, from, first * sizeof *to);
    for (size_t at = first; at < first + all * size; at += size) {
        if (*(const int64_t *)(const void *)(from + at) != 0) { /* live */
            memcpy(to + at, from + at, size * sizeof *to);
        } else if (*(const int64_t *)(const void *)(to + at) != 0) {
            memset(to + at, 0, size * sizeof *to);
        }
    }
}

/* --- torques --- */

/* A commanded torque acts from `delay` after its sample until `delay` after the next sample. Each
 * step of a prediction holds the mean of the torques that act during it, which changes velocities
 * as much as the torques themselves. */

/* Return the torque at the motor that a command makes once it has arrived there. */
static double at_motor(const model *m, double command)
{
    /* The subtraction keeps all bits if the offset is zero, even the sign of a zero torque. */
    return *m->torque_gain * command - (0.0 - *m->design_flow.torque_offset);
}

double mean_torque(const model *m, const state *at, double ahead, double duration)
{
    /* A command of age `oldest` arrives at the beginning of the interval, one of age `youngest` at
     * its end. The newest stays in force for ever, and the oldest remembered one always was. */
    const double oldest = *m->torque_delay - ahead, youngest = oldest - duration;
    double mean = at->past[0], from = youngest;
    for (long i = 0; i < m->s.past && from < oldest; i++) {
        const double *torque = at->past + 2 * i, age = torque[1];
        const double until = i + 1 < m->s.past ? minimum(age, oldest) : oldest;
        if (until > from) {
            mean += (until - from) / duration * (torque[0] - at->past[0]);
            from = until;
        }
    }
    return mean;
}

void hold_inputs(const model *m, state *at, const double *u)
{
    const long past = m->s.past;
    memcpy(at->held, u, (size_t)m->s.m * sizeof *u);
    if (m->s.m > 0) {
        at->held[0] = at_motor(m, u[0]);
    }
    if (past == 0) {
        return;
    }
    const double torque = at->held[0];
    if (isinf(at->past[1])) { /* the first torque is taken to have acted always */
        for (long i = 0; i < past; i++) {
            at->past[2 * i] = torque;
            at->past[2 * i + 1] = 0.0;
        }
    } else if (torque != at->past[0]) { /* otherwise the newest goes on */
        memmove(at->past + 2, at->past, 2 * (size_t)(past - 1) * sizeof *at->past);
        at->past[0] = torque;
        at->past[1] = 0.0;
    }
    at->held[0] = mean_torque(m, at, 0.0, *m->period);
}

/* Return the error variance of a hypothesis' state. */
static double variance_of(const model *m, const state *at, const hypothesis *h, long i)
{
    const long diagonal = i * (m->s.width + 1);
    if (*h->certified == 0) {
        return maximum(h->covariance[diagonal], 0.0);
    }
    const double std = scale_of(m, at) * sqrt(m->X[diagonal]);
    return std * std;
}

/* --- copies --- */

/* Remove a hypothesis. */
static void drop(const model *m, const hypothesis *h)
{
    memset(h->live, 0, hypothesis_size(&m->s) * sizeof(double));
}

/* Remove all hypotheses but the best. */
static void drop_others(const model *m, const state *at)
{
    hypothesis h;
    for (long i = 0; find_live(m, at, &i, &h); i++) {
        if (i != *at->best) {
            drop(m, &h);
        }
    }
}

/* Put a fork in the standing place of its kind, as the best hypothesis. */
static void take_place(const model *m, state *at, const hypothesis *h)
{
    *at->best = *h->kind;
    *h->fork = NO_FORK;
    memcpy(best_of(m, at).live, h->live, hypothesis_size(&m->s) * sizeof(double));
    drop(m, h);
}

/* Begin a hypothesis as a copy of the best one; the caller then changes what it supposes. */
static hypothesis begin_from_best(
    const model *m, const state *at, long place, int64_t fork, double score)
{
    const hypothesis h = hypothesis_of(m, at, place);
    memmove(h.live, best_of(m, at).live, hypothesis_size(&m->s) * sizeof(double));
    leave_certified(m, at, &h, BASIS_STARTING);
    *h.cause = fork == OTHERWISE ? BASIS_COVARIANCE : *h.cause;
    *h.fork = fork;
    *h.score = score;
    *h.age = 0.0;
    return h;
}

/* Clear the auxiliary states from `first` on, up to `end`. */
static void clear_auxiliary(const model *m, const hypothesis *h, long first, long end)
{
    const long width = m->s.width;
    for (long i = first; i < end; i++) {
        h->x[i] = 0.0;
        for (long j = 0; j < width; j++) {
            h->covariance[i * width + j] = 0.0;
            h->covariance[j * width + i] = 0.0;
        }
        for (long j = 0; j < m->s.k; j++) {
            h->sensitivity[j * width + i] = 0.0;
        }
    }
}

/* Change the kind of a hypothesis. The parts of the sensors are cleared, as the disturbance has to
 * explain them again. The torque's state is kept for FORCE, and for any kind in a gap. */
static void change_kind(const model *m, const state *at, const hypothesis *h, int64_t kind)
{
    *h->kind = kind;
    *h->size = kind == DRIFT            ? m->constants[DRIFT_SIZE]
               : kind == COLOURED_NOISE ? m->constants[COLOUR_SIZE]
               : kind == FORCE          ? 1.0
                                        : *h->size;
    clear_auxiliary(m, h, m->s.n + (kind == FORCE || *at->in_gap != 0), m->s.width);
}

/* Reset covariances and regressors to those of the start, but keep the estimate. */
static void reset_covariances(const model *m, const hypothesis *h)
{
    const long n = m->s.n, k = m->s.k, width = m->s.width;
    const state initial = state_view(&m->s, m->initial);
    const hypothesis first = hypothesis_of(m, &initial, 0);
    copy_matrix(first.covariance, width, h->covariance, width, n, n);
    copy_matrix(first.gamma, k, h->gamma, k, k, k);
    copy_matrix(first.sensitivity, width, h->sensitivity, width, k, n);
    *h->noise_share = 0.0;
}

/* Begin a hypothesis of a kind, otherwise a copy of the best one. */
static void begin_kind(
    const model *m, const state *at, long place, long kind, int64_t fork, double score)
{
    const long n = m->s.n, p = m->s.p, width = m->s.width;
    const hypothesis h = begin_from_best(m, at, place, fork, score);
    change_kind(m, at, &h, kind);
    for (long i = n; kind == FORCE && i < states_in_use(m, &h); i++) {
        if (h.covariance[i * (width + 1)] <= 0.0) {
            h.covariance[i * (width + 1)] = m->force[i - n] * m->force[i - n];
        }
    }
    for (long j = 0; j < p && kind == COLOURED_NOISE; j++) {
        h.covariance[(n + 1 + j) * (width + 1)] = m->R[j * p + j] * *h.size * *h.size;
    }
}

/* Return whether a kind is considered. A kind that equals the design is not, nor is TONE, which
 * begins once a tone is found. */
static int is_considered(const model *m, long kind)
{
    const double *c = m->constants;
    const double differences[TONE] = {
        1.0, m->force[0] + m->force[1], c[IMPERFECTION] - 1.0, c[NOISE_FACTOR] - 1.0,
        c[COLOUR_SIZE], c[DRIFT_SIZE],
    };
    return kind < TONE && differences[kind] > 0.0;
}

/* Begin the hypotheses that sleep, and keep all awake for a while. */
static void activate_bank(const model *m, state *at)
{
    for (long i = 0; *at->awake <= 0.0 && i < m->s.p; i++) {
        const sensor of = sensor_of(m, at, i); /* tones from before the sleep may be over */
        memset(of.tones, 0, (size_t)(4 * TONES) * sizeof *of.tones);
        of.recent[0] = of.recent[1] = *of.recent_time = *of.recent_counted = 0.0;
    }
    if (*at->awake <= 0.0 && *at->best == AS_DESIGNED) {
        const hypothesis h = best_of(m, at);
        copy_matrix(h.theta, m->s.k, at->settled_theta, m->s.k, 1, m->s.k);
        copy_matrix(h.gamma, m->s.k, at->settled_gamma, m->s.k, m->s.k, m->s.k);
    }
    for (long kind = 0; kind < TONE; kind++) {
        if (*hypothesis_of(m, at, kind).live == 0 && is_considered(m, kind)) {
            begin_kind(m, at, kind, kind, NO_FORK, -m->constants[FLOOR]);
        }
    }
    *at->awake = m->constants[AWAKE];
}

/* --- the sensors --- */

/* Track the size of white noise by the running median of the differences of successive innovations,
 * in steps of its logarithm. variance: variance of the innovations under the certified gain. */
static void scale_noise(const model *m, sensor *of, double innovation, double variance)
{
    const double elapsed = minimum(*of->since, *m->longest);
    const double limit = maximum(*of->noise_scale, 1.0) * *m->gate;
    const int64_t kind = fabs(innovation) > limit * sqrt(variance) ? OUTLIER : REGULAR;
    /* A pair of unlike kinds shows nothing. A pair of outliers counts: the noise may be larger. */
    if (*of->paired == kind) {
        const double expected = sqrt(2.0 * variance) * 0.6745; /* median of a normal one's size */
        const double rate = maximum(20.0 / (1.0 + 20.0 * *of->scale_age), 1.0);
        const double step = 1.0 + 0.5 * rate * elapsed;
        if (fabs(innovation - *of->previous) > *of->noise_scale * expected) {
            *of->noise_scale *= step;
        } else {
            *of->noise_scale = maximum(*of->noise_scale / step, m->constants[LEAST_SCALE]);
        }
        *of->scale_age += elapsed;
    }
    *of->previous = innovation;
    *of->paired = kind;
}

/* Return whether noise hides the quantisation of a sensor, so that no value should repeat. */
static int hides_steps(const sensor *of, double noise)
{
    return *of->rough > 3.0 * (*of->step > 0.0 ? *of->step : sqrt(noise));
}

/* Count a repetition of a value if it suggests a stuck sensor. If noise hides the sensor's steps,
 * each repetition does. Otherwise a value also repeats if the arm rests or moves by less than a
 * step. Then a repetition counts only once the prediction has left the value: once the innovation
 * exceeds its least size so far by more than a step plus the prediction's own sigma. The step is
 * learnt as the smallest difference of successive values, or of two such differences, as values of
 * a moving arm differ much; the noise (rough) as the running median of the differences of
 * innovations. Both may grow by a fiftieth per new value, so that an odd value is forgotten. */
static void count_repeats(const sensor *of, double y, const outlook *expected, double noise)
{
    const double rate = 1.02;
    const double distance = fabs(expected->innovation), difference = fabs(y - *of->value);
    const double change = fabs(expected->innovation - *of->before);
    *of->before = expected->innovation;
    if (difference == 0.0) {
        const double own = sqrt(maximum(expected->variance - noise, 0.0));
        const double step = *of->step > 0.0 ? *of->step : sqrt(noise);
        *of->nearest = minimum(*of->nearest, distance);
        *of->repeats += hides_steps(of, noise) || distance > *of->nearest + step + own;
        return;
    }
    if (isfinite(difference) && isfinite(change)) {
        const double next = change > *of->rough ? *of->rough * rate : *of->rough / rate;
        const double turn = fabs(y - *of->value - *of->motion);
        const double least = turn > 1e-6 * sqrt(noise) ? minimum(difference, turn) : difference;
        *of->rough = *of->step == 0.0 ? change : next;
        *of->step = *of->step == 0.0 ? least : minimum(least, rate * *of->step);
        *of->motion = y - *of->value;
    }
    *of->value = y;
    *of->nearest = distance;
    *of->repeats = 0;
}

/* Note the innovations of the best hypothesis, which is not corrected yet. Under supervision, leave
 * out the samples of stuck sensors, and track the noise by these innovations. Return whether the
 * hypothesis finds outliers. */
static int examine(const model *m, const state *at, correction *effect)
{
    int outliers = 0;
    for (long i = 0; i < m->s.p; i++) {
        sensor of = sensor_of(m, at, i);
        outlook *expected = outlook_of(effect, i);
        effect->innovation[i] = expected->innovation;
        effect->innovation_variance[i] = expected->variance;
        if (!effect->present[i] || *m->supervised == 0) {
            continue;
        }
        if (is_stuck(m, at, i)) {
            effect->present[i] = expected->used = 0;
        } else if (isfinite(expected->innovation)) {
            scale_noise(m, &of, expected->innovation, m->innovation_variance[i]);
        }
        outliers = outliers || (effect->present[i] && !expected->used);
    }
    return outliers;
}

/* Return whether the state's age has passed a multiple of an interval in the time `since`. */
static int has_passed(const state *at, double interval, double since)
{
    return floor(*at->age / interval) > floor((*at->age - since) / interval);
}

/* Return whether a frequency is near a natural one of the arm, where a wrong model looks like a
 * tone. For a second tone the margin is wider, to cover those of other parameters, too. */
static int is_natural(const model *m, double frequency, int is_second)
{
    const double step = m->constants[TONE_RATIO];
    const double ratio = is_second ? step * step : sqrt(step);
    return (frequency < ratio * m->modes[0] && m->modes[0] < ratio * frequency)
           || (frequency < ratio * m->modes[1] && m->modes[1] < ratio * frequency);
}

/* Return the lowest frequency of tones [rad/s]: within their memory it turns by four radians. */
static double lowest_tone(const model *m)
{
    return 4.0 / m->constants[AWAKE];
}

/* Return the 1 sigma of an output's innovations under the certified gain, in the present noise. */
static double innovation_std(const model *m, const state *at, long output)
{
    return noise_of(m, at, output) * sqrt(m->innovation_variance[output]);
}

/* Rotate the phasors of the design's innovations and, for clean sensors, of the motion that it
 * estimates, at all frequencies, and add the newest ones. If the design takes the sample for an
 * outlier, it may be lost itself, in a large tone. LOUD then takes its place, which is moved least.
 * Both are relative to the design's 1 sigma of innovations, and are first summed up over .015 rad
 * of the lowest frequency, .25 rad of the highest. No hypothesis is corrected by the sample yet. */
static void update_tones(const model *m, const state *at, const correction *effect)
{
    const double step = m->constants[TONE_RATIO];
    const hypothesis designed = hypothesis_of(m, at, AS_DESIGNED);
    const hypothesis loud = hypothesis_of(m, at, LOUD);
    for (long i = 0; i < m->s.p; i++) {
        if (!effect->present[i]) {
            continue;
        }
        const sensor of = sensor_of(m, at, i);
        const double *row = m->C + i * m->s.width, *x = designed.x;
        const double std = innovation_std(m, at, i);
        const double shown = at->y[i] - dot(m->D + i * m->s.p, at->sample, m->s.p);
        if (*loud.live != 0 && fabs(shown - dot(row, x, m->s.n)) > *m->gate * std) {
            x = loud.x;
        }
        of.recent[0] += clip((shown - dot(row, x, m->s.n)) / std, -3.0, 3.0);
        of.recent[1] += (dot(row, x, m->s.plant) - dot(row, at->centre, m->s.plant)) / std;
        *of.recent_time += *of.since;
        *of.recent_counted += counted_time(m, *of.since, *of.interval);
        if (*of.recent_time * lowest_tone(m) < 0.015) {
            continue;
        }
        const double left = 1.0 - share_of(*of.recent_counted, m->constants[AWAKE]);
        const long phasors = m->disturbed[i] != 0 ? 1 : 2;
        double rate = lowest_tone(m);
        for (long j = 0; j < TONES; j++, rate *= step) {
            double sin, cos;
            sine_and_cosine(rate * *of.recent_time, &sin, &cos);
            for (long k = 0; k < phasors; k++) {
                double *z = of.tones + 4 * j + 2 * k;
                const double first = z[0];
                z[0] = left * (cos * first - sin * z[1]) + of.recent[k];
                z[1] = left * (cos * z[1] + sin * first);
            }
        }
        of.recent[0] = of.recent[1] = *of.recent_time = *of.recent_counted = 0.0;
    }
}

/* A tone in innovations: power relative to white noise's, frequency [rad/s], and 1 sigma. */
typedef struct {
    double power, frequency, size;
} tone;

/* Begin a TONE of an output with one tone or two, as a copy of the best hypothesis. TONE_RESET also
 * forgets what that has learnt since the bank woke, which may have been the tone's, and takes the
 * state of LOUD, which the tone moved least. */
static void begin_tones(
    const model *m, const state *at, long place, int64_t output, const tone *tones, long count)
{
    const long k = m->s.k, width = m->s.width;
    const hypothesis h = begin_from_best(m, at, place, NO_FORK, -m->constants[FLOOR]);
    *h.output = output;
    *h.size = tones[0].size;
    change_kind(m, at, &h, TONE);
    for (long i = 0; i < count; i++) {
        const double size = tones[i].size, off = halfway_from(m, tones[i].frequency);
        const long first = m->s.n + 1 + 3 * i;
        double *variance = h.covariance + first * (width + 1);
        variance[0] = variance[width + 1] = size * size;
        variance[2 * (width + 1)] = off * off;
        h.x[first + 2] = tones[i].frequency;
    }
    if (place == TONE_RESET) {
        const hypothesis loud = hypothesis_of(m, at, LOUD);
        if (*loud.live != 0) {
            memcpy(h.x, loud.x, (size_t)m->s.n * sizeof *h.x);
        }
        reset_covariances(m, &h);
        copy_matrix(at->settled_gamma, k, h.gamma, k, k, k);
        for (long a = 0; a < k; a++) {
            h.theta[a] = h.anchor[a] = at->settled_theta[a];
            h.pending[a] = 0.0;
        }
        *h.significant = 0;
    }
}

/* Return the size of a phasor. */
static double size_of(const double *z)
{
    return sqrt(z[0] * z[0] + z[1] * z[1]);
}

/* Find the three loudest tones in an output's innovations, loudest first. Each is a local maximum;
 * its frequency is interpolated towards that of the louder neighbour, by the amplitudes of both. A
 * clean sensor's must not be small beside a local maximum of the motion that is at most two
 * frequencies away: then a wrong model of the arm is likelier than a tone. */
static void find_tones(const model *m, const state *at, long output, tone *found)
{
    const sensor of = sensor_of(m, at, output);
    const double share = share_of(maximum(*of.interval, *m->period), m->constants[AWAKE]);
    const double step = m->constants[TONE_RATIO];
    const double std = innovation_std(m, at, output);
    double loud[TONES + 2] = {0.0}, motion[TONES + 2] = {0.0}; /* with 0 beyond both ends */
    double rate = lowest_tone(m);
    for (long j = 1; j <= TONES; j++, rate *= step) {
        loud[j] = is_natural(m, rate, 0) ? 0.0 : size_of(of.tones + 4 * (j - 1));
        motion[j] = m->disturbed[output] != 0 ? 0.0 : size_of(of.tones + 4 * (j - 1) + 2);
    }
    rate = lowest_tone(m);
    for (long j = 1; j <= TONES; j++, rate *= step) {
        const double here = loud[j], other = maximum(loud[j - 1], loud[j + 1]);
        const double ratio = loud[j + 1] > loud[j - 1] ? step : 1.0 / step;
        tone next = {
            here * here * (2.0 - share) * share,
            rate * (here + ratio * other) / (here + other),
            6.0 * share * here * std, /* large, as the filter hides part of a slow tone */
        };
        int is_tone = here >= other;
        for (long i = j < 3 ? 1 : j - 2; i <= TONES && i <= j + 2; i++) {
            is_tone &= !(motion[i] >= maximum(motion[i - 1], motion[i + 1])
                         && motion[i] > 3.0 * here);
        }
        for (long rank = 0; is_tone && rank < 3; rank++) {
            const tone ranked = found[rank];
            if (next.power > ranked.power && (rank == 0 || !is_natural(m, next.frequency, 1))) {
                found[rank] = next;
                next = ranked;
            }
        }
    }
}

/* Four times per trial, propose the loudest tone of all outputs that have samples. If one tone
 * alone has failed, add the output's second one, unless the window or clipping may have made it
 * from the loudest. */
static void propose_tones(const model *m, state *at)
{
    const double *c = m->constants;
    const tone none = {c[TONE_SIGN], 0.0, 0.0};
    tone tones[3] = {none};
    int64_t output = 0;
    if (*at->awake <= 0.0 || !has_passed(at, 0.25 * c[TRIAL], *at->since)) {
        return;
    }
    for (long i = 0; i < m->s.p; i++) {
        tone own[3] = {none, none, {0.0, 0.0, 0.0}};
        const sensor of = sensor_of(m, at, i);
        if (at->y[i] == at->y[i] || *of.since <= *of.interval) {
            find_tones(m, at, i, own);
        }
        if (own[0].power > tones[0].power) {
            memcpy(tones, own, sizeof tones);
            output = i;
        }
    }
    const double frequency = tones[0].frequency;
    const double ratio = c[TONE_RATIO] * c[TONE_RATIO];
    const double apart = (tones[1].frequency - frequency) * c[AWAKE];
    const int are_two = tones[1].power > 2.5 * tones[2].power
                        && tones[1].power * minimum(1.0 + apart * apart, 8.0) > tones[0].power;
    for (long place = TONE; place <= TONE_RESET; place++) {
        const hypothesis h = hypothesis_of(m, at, place);
        const double now = h.x[m->s.n + 3], second = h.x[m->s.n + 6];
        /* A tone has three periods to prove itself, but little time once another is the loudest. */
        const int is_other = frequency < now / ratio || frequency > now * ratio;
        const double patience = is_other ? c[TRIAL] : maximum(c[AWAKE], 20.0 / now);
        const int failed_alone = *h.live != 0 && second == 0.0;
        if (*h.live != 0 && (is_natural(m, now, 0) || is_natural(m, second, 1))) {
            *h.score = -INFINITY;
        }
        if (frequency > 0.0 && *best_of(m, at).kind != TONE
            && (*h.live == 0 || (*h.score < -0.5 * c[FLOOR] && *h.age > patience))) {
            begin_tones(m, at, place, output, tones, 1 + (are_two && failed_alone));
        }
    }
}

/* --- forks --- */

/* Return a place for a fork: a free one, or the unlikeliest fork's if below a score; -1 if none. */
static long place_for(const model *m, const state *at, double score)
{
    long found = -1;
    for (long i = STANDING; i < m->s.hypotheses; i++) {
        const hypothesis h = hypothesis_of(m, at, i);
        if (*h.live == 0) {
            return i;
        }
        if (i != *at->best && *h.fork != STUCK && *h.score < score) {
            found = i;
            score = *h.score;
        }
    }
    return found;
}

/* Return how far a sample is from the estimate of a state; 0 if no output shows that. */
static double distance_of(const model *m, long i, const correction *effect)
{
    const int is_speed = i % 2 == 1 && *m->design_flow.kind == KIND_ARM;
    double most = 0.0;
    for (long j = 0; j < m->s.p; j++) {
        const double *by = m->C + j * m->s.width + i;
        /* A late angle contains its velocity, but that does not explain the innovation. */
        if (effect->present[j] && *by != 0.0 && !(is_speed && by[-1] != 0.0)) {
            most = maximum(most, fabs(effect->innovation[j] / *by));
        }
    }
    return most;
}

/* Open the disturbance of an output that may have jumped; a clean sensor drifts then. */
static void open_disturbance(
    const model *m, const state *at, hypothesis *h, long output, double innovation)
{
    const long width = m->s.width, place = m->s.n + 1 + output;
    const double *map = m->disturbance_map + output * width;
    if (m->disturbed[output] == 0) {
        if (*h->kind != DRIFT) {
            change_kind(m, at, h, DRIFT);
        }
        h->covariance[place * (width + 1)] += innovation * innovation;
        return;
    }
    for (long i = 0; i < m->s.n; i++) {
        h->covariance[i * (width + 1)] += map[i] != 0.0 ? innovation * innovation : 0.0;
    }
}

/* Open the speeds of the sides that an output shows, after a hit. They explain the innovation
 * within a period, but are at most the domain's. The hit came at any time in that period, and the
 * speed has turned the arm since. Return whether such a hit is enough for the innovation. */
static int open_speeds(
    const model *m, const state *at, hypothesis *h, long output, double innovation,
    const correction *effect)
{
    const long n = m->s.n, width = m->s.width;
    const double periods = maximum(1.0, *sensor_of(m, at, output).since / *m->period);
    double *P = h->covariance, most = sqrt(outlook_of(effect, output)->variance);
    for (long i = 1; i < 4; i += 2) {
        const double *by = m->C + output * width + i;
        const double turn = m->design_flow.phi[(i - 1) * n + i];
        const double std = minimum(fabs(innovation) / *m->period / m->scale[i], m->domain[i]);
        most += std * (fabs(by[-1]) * turn * periods + fabs(by[0]));
        if (by[-1] != 0.0 || by[0] != 0.0) {
            P[(i - 1) * (width + 1)] += std * std * turn * turn / 3.0;
            P[(i - 1) * width + i] += 0.5 * std * std * turn;
            P[i * width + i - 1] = P[(i - 1) * width + i];
            P[i * (width + 1)] += std * std;
        }
    }
    return fabs(innovation) <= *m->gate * most;
}

/* Open the states of a plant that is elsewhere: by the domain, and at least as far as the sample is
 * away, so that the disturbance need not change. An arm that starts elsewhere is there as a whole,
 * with its spring at rest: an angle that no output shows goes along with the other one. */
static void open_plant(const model *m, hypothesis *h, int is_new, const correction *effect)
{
    const long width = m->s.width;
    const int is_arm = *m->design_flow.kind == KIND_ARM;
    double *P = h->covariance;
    for (long i = 0; i < m->s.plant; i++) {
        const int is_speed = is_arm && i % 2 == 1;
        /* An estimated speed beyond the domain may be wrong by all of itself. */
        const double least = maximum(m->domain[i], is_speed ? fabs(h->x[i]) : 0.0);
        const double away = distance_of(m, i, effect), std = is_new ? away : maximum(least, away);
        const long other = (i + 2) % 4;
        P[i * (width + 1)] += std * std;
        if (is_new && is_arm && !is_speed && distance_of(m, other, effect) == 0.0) {
            const double same = away * m->scale[i] / m->scale[other];
            P[other * (width + 1)] += same * same;
            P[i * width + other] += away * same;
            P[other * width + i] = P[i * width + other];
        }
    }
}

/* Begin a fork that supposes an event at an unlikely sample of an output. The best hypothesis is
 * not corrected by the sample yet, and `expect_outputs` has marked the regular outputs. */
static void suppose(
    const model *m, const state *at, int64_t fork, long output, double innovation,
    correction *effect)
{
    /* If a clean sensor has only just put the arm where it is, the arm was not lost: the first
     * sample was an outlier. */
    const int is_new = *at->age < 8.0 * *m->period && m->disturbed[output] == 0;
    const int elsewhere = is_new ? OUTLIER_PRICE : LOST_PRICE;
    const double price = m->constants[fork == MOVED ? elsewhere : FORK_PRICE];
    const hypothesis from = best_of(m, at);
    const double score = *from.score - price;
    const long place = place_for(m, at, score);
    const double disturbance
        = dot(m->disturbance_map + output * m->s.width, from.x, m->s.n) + innovation;
    if (place < 0 || (fork == JUMPED && !(fabs(disturbance) <= m->disturbance_limit[output]))) {
        return;
    }
    hypothesis h = begin_from_best(m, at, place, fork, score);
    *h.cause = fork == JUMPED ? BASIS_JUMP : BASIS_STARTING;
    if (fork == JUMPED) {
        open_disturbance(m, at, &h, output, innovation);
    } else if (fork == MOVED) {
        open_plant(m, &h, is_new, effect);
    } else if (!open_speeds(m, at, &h, output, innovation, effect)) {
        drop(m, &h);
        return;
    }
    for (long i = 0; i < m->s.p; i++) {
        const outlook *of = outlook_of(effect, i);
        *h.score += i == output || of->used ? correct_by(m, at, &h, i, 0, 0, effect)
                                                : of->likelihood;
    }
    *h.corrected = 1;
    if (!isfinite(*h.score)) {
        drop(m, &h);
    }
}

/* Count repetitions. If noise should let no value repeat, a repetition begins a fork that supposes
 * stuck sensors and does not use them. Its score rises with each repetition, until all hypotheses
 * begin again from it. Write the outlooks of the best hypothesis, which is that fork then. */
static void judge_repeats(const model *m, state *at, correction *effect)
{
    const double sure = (double)*m->stuck_samples;
    double repeats = 0.0; /* most that go on, of sensors not yet known to be stuck */
    int is_found = 0;
    long place = STANDING;
    hypothesis h = best_of(m, at);
    expect_outputs(m, at, &h, effect);
    for (long i = 0; i < m->s.p; i++) {
        const sensor of = sensor_of(m, at, i);
        const double noise = m->R[i * m->s.p + i], before = (double)*of.repeats;
        if (effect->present[i]) {
            count_repeats(&of, at->y[i], outlook_of(effect, i), noise);
        }
        const double own = (double)*of.repeats;
        is_found |= before < sure && sure <= own;
        /* A message without the output says nothing about its repetitions. */
        const int go_on = effect->present[i] ? before < own : own > 0.0;
        repeats = go_on && own < sure && hides_steps(&of, noise) ? maximum(repeats, own) : repeats;
    }
    while (find_live(m, at, &place, &h) && *h.fork != STUCK) {
        place++;
    }
    const int exists = place < m->s.hypotheses;
    if (exists && is_found) {
        take_place(m, at, &h);
        drop_others(m, at);
        activate_bank(m, at);
        h = best_of(m, at);
        expect_outputs(m, at, &h, effect);
    } else if (exists && repeats == 0.0) {
        drop(m, &h);
    } else if (exists) {
        *h.score = m->constants[FLOOR] * (repeats / sure - 1.0);
    }
    if ((!exists || is_found) && *m->supervised != 0 && repeats > 0.0) {
        place = place_for(m, at, INFINITY);
        *begin_from_best(m, at, place, STUCK, -m->constants[FLOOR]).cause = BASIS_GAP;
    }
}

/* Suppose that the torque since the last sample never acted, if it stands out from those before and
 * after it by what changes the motor's speed by more than SUDDEN sigmas, and if none has done so
 * for a while: peaks that come often are the drive's own. */
static void suppose_wrong_torque(const model *m, const state *at, const double *u)
{
    const flow *f = &m->design_flow;
    const long n = m->s.n, inputs = flow_sizes_of(m->flow_record).inputs, speed = 3;
    if (*m->supervised == 0 || *f->kind != KIND_ARM || m->s.past > 0 || *at->torque_unknown != 0
        || *at->since > *m->longest) {
        return;
    }
    const double held = at->held[0], before = *at->torque_before, next = at_motor(m, u[0]);
    const double alone = held - clip(held, minimum(before, next), maximum(before, next));
    const double made = alone * *at->since / *m->period;
    const hypothesis best = best_of(m, at);
    const double limit = m->constants[SUDDEN] * sqrt(variance_of(m, at, &best, speed));
    if (!(fabs(made * f->gamma[speed * inputs]) > limit)) {
        return;
    }
    const double quiet = *at->torque_quiet, score = *best.score - m->constants[TORQUE_PRICE];
    const long place = place_for(m, at, score);
    *at->torque_quiet = 0.0;
    if (place < 0 || quiet < m->constants[AWAKE]) {
        return;
    }
    const hypothesis h = begin_from_best(m, at, place, WRONG_TORQUE, score);
    for (long i = 0; i < n; i++) {
        h.x[i] -= made * f->gamma[i * inputs];
    }
}

/* Begin a fork with the parameters of another hypothesis, if that knows them at least as well. */
static void suppose_parameters(
    const model *m, const state *at, const hypothesis *teacher, double score)
{
    const long k = m->s.k;
    const hypothesis best = best_of(m, at);
    int is_better = *teacher->live != 0 && *teacher->significant != 0;
    for (long a = 0; a < k; a++) {
        is_better = is_better && teacher->gamma[a * (k + 1)] <= best.gamma[a * (k + 1)];
    }
    const long place = is_better ? place_for(m, at, -INFINITY) : -1;
    if (place < 0) {
        return;
    }
    const hypothesis h = begin_from_best(m, at, place, OTHERWISE, score);
    for (long a = 0; a < k; a++) {
        const double *sensitivity = h.sensitivity + a * m->s.width;
        add_scaled(h.x, teacher->theta[a] - h.theta[a], sensitivity, states_in_use(m, &h));
        h.theta[a] = teacher->theta[a];
        h.anchor[a] = teacher->anchor[a];
        h.pending[a] = 0.0;
    }
    copy_matrix(teacher->gamma, k, h.gamma, k, k, k);
    *h.pass_age = *teacher->pass_age;
    *h.noise_share = *teacher->noise_share;
    *h.significant = 1;
}

/* Return whether noise is so loud that a jump which the design takes for an outlier is not even
 * sudden, and that a wrong model shows late. size: relative to the design's noise. */
static int is_loud(const model *m, double size)
{
    return size > *m->gate / m->constants[SUDDEN];
}

/* Once per trial, begin a fork of another kind, each kind but LOUD in turn, or as every second one
 * what the best hypothesis suggests: the design, while a young IMPERFECT is the best; the other of
 * two sizes of DRIFT; a size three times smaller or larger, in turn, of COLOURED_NOISE or a T-S
 * system's FORCE. In noise, another fork supposes the parameters of the hypothesis whose turn it
 * is. docs/estimator.md has the reasons, by "Other suppositions". */
static void suppose_otherwise(const model *m, const state *at)
{
    const double *c = m->constants;
    const long place = *at->best;
    if (*at->awake <= 0.0 || place >= STANDING || !has_passed(at, c[TRIAL], *at->since)) {
        return;
    }
    const hypothesis best = best_of(m, at);
    const long count = (long)fmod(floor(*at->age / c[TRIAL]), 2 * STANDING);
    const int seems_wrong = place == IMPERFECT && m->s.k > 0 && *best.age < 2.0 * c[AWAKE];
    const int tries_design = seems_wrong && count % 2 == 1;
    const long kind = tries_design ? AS_DESIGNED : (seems_wrong ? count / 2 : count) % STANDING;
    const int is_likely = tries_design && !is_loud(m, scale_of(m, at));
    const double score = *best.score - (is_likely ? 0.0 : 0.5 * c[FLOOR]);
    const long free = place_for(m, at, -INFINITY);
    const int is_scaled = place == COLOURED_NOISE
                          || (place == FORCE && *m->design_flow.kind == KIND_SYSTEM);
    if ((place == DRIFT || is_scaled) && count % 2 == 1 && free >= 0) {
        const hypothesis h = begin_from_best(m, at, free, OTHERWISE, score);
        if (is_scaled) {
            *h.size *= count % 4 == 1 ? 1.0 / 3.0 : 3.0;
        } else {
            *h.size = c[DRIFT_SIZE] * (*h.size < c[DRIFT_SIZE] ? 1.0 : 0.5);
        }
    } else if (kind != place && kind != LOUD && is_considered(m, kind) && free >= 0) {
        begin_kind(m, at, free, kind, OTHERWISE, score);
    }
    if (place >= LOUD && place != DRIFT && kind != place && kind != FORCE && kind != IMPERFECT) {
        const hypothesis teacher = hypothesis_of(m, at, kind);
        suppose_parameters(m, at, &teacher, score);
    }
}

void take_torque(const model *m, state *at, const double *u)
{
    if (*m->torque_limit > 0.0) {
        /* Before the first torque, torque_age is infinite. Late samples and those of two sensors
         * may be arbitrarily close, so at least a period counts. */
        const double elapsed = maximum(*at->torque_age, *m->period);
        const double before = m->s.past > 0 ? at->past[0] : at->held[0];
        if (!isfinite(u[0]) || !(fabs(u[0]) <= *m->torque_limit)
            || fabs(at_motor(m, u[0]) - before)
                   > *m->torque_gain * *m->torque_rate_limit * elapsed) {
            *at->torque_unknown = 1;
            return;
        }
    }
    suppose_wrong_torque(m, at, u);
    if (*at->since >= 0.5 * *m->period) { /* else another sensor sent the message */
        *at->torque_before = at->held[0];
    }
    hold_inputs(m, at, u);
    *at->torque_unknown = 0;
    *at->torque_age = 0.0;
}

/* Open IMPERFECT's disturbance by its distance from that of a fork which found a jump. So IMPERFECT
 * finds the jump, too, and keeps its own state and parameters of the arm. */
static void open_to_jump(const model *m, const state *at, const hypothesis *h)
{
    const hypothesis other = hypothesis_of(m, at, IMPERFECT);
    for (long i = 0; i < m->s.p && *other.live != 0; i++) {
        const double *map = m->disturbance_map + i * m->s.width;
        const double off = dot(map, h->x, m->s.n) - dot(map, other.x, m->s.n);
        for (long a = 0; a < m->s.n; a++) {
            other.covariance[a * (m->s.width + 1)] += map[a] != 0.0 ? off * off : 0.0;
        }
    }
}

/* Put the best fork in its parent's place once it is sure, and remove forks that have failed. */
static void select_forks(const model *m, state *at)
{
    hypothesis h;
    const double *c = m->constants;
    for (long i = STANDING; find_live(m, at, &i, &h); i++) {
        if (i == *at->best) {
            const hypothesis parent = hypothesis_of(m, at, *h.kind);
            if (*parent.live == 0 || *h.age > c[TRIAL] || *parent.score < -0.5 * c[FLOOR]) {
                at->won[*h.fork] += 1;
                if (*h.fork == JUMPED) {
                    open_to_jump(m, at, &h);
                }
                take_place(m, at, &h);
            }
        } else if (!(*h.score >= -c[FLOOR]) || (*h.fork < STUCK && *h.age > c[AWAKE])) {
            drop(m, &h); /* a true event would have won by then */
        }
    }
}

/* --- the bank --- */

/* Find the best hypothesis, and make all scores relative to its score. */
static void compare(const model *m, state *at)
{
    double most = -INFINITY;
    hypothesis h;
    for (long i = 0; find_live(m, at, &i, &h); i++) {
        if (*h.fork != STUCK && *h.score > most) {
            most = *h.score;
            *at->best = i;
        }
    }
    for (long i = 0; find_live(m, at, &i, &h); i++) {
        *h.score -= *h.fork != STUCK ? most : 0.0;
        if (i < STANDING) {
            *h.score = maximum(*h.score, -m->constants[FLOOR]);
        }
    }
}

/* Put the others to sleep if the design is the best, and no sign has come for a while. */
static void deactivate_bank(const model *m, state *at)
{
    hypothesis h;
    int is_calm = *at->best == AS_DESIGNED && *at->awake <= 0.0;
    for (long i = STANDING; find_live(m, at, &i, &h); i++) {
        is_calm = is_calm && *h.fork == OTHERWISE;
    }
    if (is_calm) {
        drop_others(m, at);
    }
}

/* Track how still the plant has been in the last seconds: the share of its motion that the
 * estimate's noise makes, in the state that moves most. */
static void follow_motion(const model *m, state *at, const hypothesis *h)
{
    const double share = *at->age > 0.0 ? share_of(*m->period, 2.0) : 1.0;
    *at->stillness = 1.0;
    for (long i = 0; i < m->s.plant; i++) {
        const double off = h->x[i] - at->centre[i];
        at->centre[i] += share * off;
        at->spread[i] = (1.0 - share) * (at->spread[i] + share * off * off);
        at->noise[i] += share * (variance_of(m, at, h, i) - at->noise[i]);
        *at->stillness = minimum(*at->stillness, at->noise[i] / at->spread[i]);
    }
}

/* Fork the best hypothesis at each outlier. If the output has a disturbance, a sudden innovation is
 * enough to suppose a jump or a hit and, soon after a hit or another start, that the arm is
 * elsewhere. In loud noise, a jump is also due without a sign, four times per trial, while the bank
 * is awake or another kind than the design is the best.
 *
 * A sudden innovation that is no outlier may be due to a hit if its product with the previous one
 * is large, too, which is rare in noise. A value that repeats although noise should let none repeat
 * shows no hit, as the sensor may be stuck.
 *
 * Return whether forks may have used the scratch of `expect_outputs`. */
static int fork_best(const model *m, const state *at, correction *effect)
{
    const hypothesis best = best_of(m, at);
    const int is_new = *best.cause == BASIS_STARTING && *best.age < m->constants[TRIAL];
    int forked = 0;
    for (long i = 0; i < m->s.p; i++) {
        const sensor of = sensor_of(m, at, i);
        const double innovation = effect->innovation[i];
        const double std = sqrt(effect->innovation_variance[i]);
        const double sudden = m->constants[SUDDEN] * std;
        const int is_outlier = !outlook_of(effect, i)->used, is_disturbed = m->disturbed[i] != 0;
        const int is_sudden = is_outlier || (is_disturbed && fabs(innovation) > sudden);
        const int is_due = is_disturbed && (*at->awake > 0.0 || *best.kind != AS_DESIGNED)
                           && is_loud(m, noise_of(m, at, i))
                           && has_passed(at, 0.25 * m->constants[TRIAL], *of.since);
        if (!effect->present[i] || !(is_sudden || is_due)) {
            continue;
        }
        if (is_sudden && *m->design_flow.kind == KIND_ARM
            && (is_outlier || best.previous[i] * (innovation / std) > m->constants[SUDDEN])
            && !(*of.repeats > 0 && hides_steps(&of, m->R[i * (m->s.p + 1)]))) {
            suppose(m, at, HIT, i, innovation, effect);
        }
        if (is_outlier || (is_sudden && is_new)) {
            suppose(m, at, MOVED, i, innovation, effect);
        }
        suppose(m, at, JUMPED, i, is_sudden ? innovation : sudden, effect);
        forked = 1;
    }
    return forked;
}

/* Update the share of recent samples that a hypothesis uses. */
static void track_inliers(const model *m, const state *at, hypothesis *h, correction *effect)
{
    const double share = share_of(counted_time(m, *at->since, 0.0), m->constants[PATIENCE]);
    int present = 0, used = 0;
    for (long i = 0; i < m->s.p; i++) {
        present = present || effect->present[i];
        used = used || outlook_of(effect, i)->used;
    }
    *h->inlier += present * share * (used - *h->inlier);
}

/* Return whether a hypothesis leaves out most samples. */
static int is_lost(const model *m, const hypothesis *h)
{
    return *h->inlier < m->constants[REJECTING] && *h->age >= m->constants[PATIENCE];
}

/* Correct a hypothesis of the bank, and update its score. */
static void use_sample(const model *m, state *at, long place, correction *effect)
{
    hypothesis h = hypothesis_of(m, at, place);
    expect_outputs(m, at, &h, effect);
    if (place == *at->best && fork_best(m, at, effect)) {
        expect_outputs(m, at, &h, effect);
    }
    for (long i = 0; *h.fork == STUCK && i < m->s.p; i++) {
        outlook_of(effect, i)->used &= *sensor_of(m, at, i).repeats == 0;
    }
    const double likelihood = correct_hypothesis(m, at, &h, effect);
    *h.score += *h.fork != STUCK ? likelihood : 0.0;
    track_inliers(m, at, &h, effect);
    /* By chance a moving arm explains some samples of a burst of outliers, but seldom most. */
    for (long i = 0; (*h.fork == HIT || *h.fork == MOVED) && i < m->s.p; i++) {
        const int is_outlier = effect->present[i] && !outlook_of(effect, i)->used;
        *h.score -= is_outlier ? m->constants[OUTLIER_PRICE] : 0.0;
    }
}

/* Return whether a rival is of no use any more, and would only widen the bounds. One of an arm
 * leaves out most samples: its averages stand still, so it would for ever. One of a T-S system is
 * contradicted, for tens of seconds after a jump of the sensor, while nothing contradicts the
 * design. */
static int is_useless(const model *m, const state *at, long place, const hypothesis *h)
{
    const hypothesis best = best_of(m, at);
    if (*m->design_flow.kind == KIND_ARM) {
        return is_rival(place) && is_lost(m, h) && !is_lost(m, &best);
    }
    return is_rival(place) && is_contradicted(m, h) && *at->best == AS_DESIGNED
           && *best.slow_power < 2.0 * m->constants[SIGN_SLOW];
}

/* Correct all hypotheses, and fork the best one if it does not expect the sample. */
static void correct_bank(const model *m, state *at, correction *effect)
{
    judge_repeats(m, at, effect);
    const long best = *at->best;
    hypothesis h = best_of(m, at);
    const int outliers = examine(m, at, effect);
    follow_motion(m, at, &h);
    if (*m->supervised == 0) {
        correct_hypothesis(m, at, &h, effect);
        track_inliers(m, at, &h, effect);
        if (is_lost(m, &h)) {
            reset_covariances(m, &h);
            *h.inlier = 1.0;
            *h.age = 0.0;
        }
        return;
    }
    const int has_sign = outliers || *h.slow_power > m->constants[SIGN_SLOW];
    if (*at->age > 0.0 ? has_sign : m->s.k > 0) {
        activate_bank(m, at);
    }
    *at->outliers += outliers;
    if (*at->awake > 0.0) {
        update_tones(m, at, effect);
    }
    /* The best one is last, so that its forks, corrected as they begin, are not corrected again. */
    for (long i = m->s.hypotheses - 1; i >= 0; i--) {
        if (i != best && *hypothesis_of(m, at, i).live != 0) {
            use_sample(m, at, i, effect);
        }
    }
    use_sample(m, at, best, effect);
    compare(m, at);
    select_forks(m, at);
    for (long i = 0; find_live(m, at, &i, &h) && i < STANDING; i++) {
        const int is_finite = isfinite(*h.score) && isfinite(h.x[0]);
        if (i != *at->best && (!is_finite || is_useless(m, at, i, &h))) {
            if (*h.kind == TONE) {
                drop(m, &h);
            } else {
                begin_kind(m, at, i, i, NO_FORK, -m->constants[FLOOR]);
            }
        }
    }
    propose_tones(m, at);
    compare(m, at); /* the best one may have been a tone that ends, or not finite */
    suppose_otherwise(m, at);
    deactivate_bank(m, at);
    if (*at->best != AS_DESIGNED) {
        /* Otherwise another one may be likelier only for its better gain. */
        h = hypothesis_of(m, at, AS_DESIGNED);
        leave_certified(m, at, &h, BASIS_COVARIANCE);
    }
}

void correct(const model *m, state *at, const double *y, correction *effect)
{
    const long p = m->s.p;
    hypothesis h;
    if (*at->in_gap != 0 && *at->torque_unknown == 0) {
        for (long i = 0; find_live(m, at, &i, &h); i++) {
            if (*h.kind != FORCE || *m->explains_motor != 0) {
                clear_auxiliary(m, &h, m->s.n, m->s.n + 1);
            }
        }
        *at->in_gap = 0;
    }
    for (long i = 0; i < p; i++) {
        const int there = isfinite(y[i]) != 0;
        at->y[i] = there ? y[i] : NAN;
        at->sample[i] = there ? y[i] : at->sample[i];
        effect->present[i] = there;
    }
    correct_bank(m, at, effect);
    *at->since = 0.0;
    for (long i = 0; i < p; i++) {
        const sensor of = sensor_of(m, at, i);
        const int there = at->y[i] == at->y[i], used = outlook_of(effect, i)->used != 0;
        *of.interval = there ? *of.since : *of.interval;
        *of.since = there ? 0.0 : *of.since;
        *of.gated += there && !used;
        *of.missing += !there;
    }
}

/* Return whether a hypothesis' covariance is below the certified bound, and not far below it: one
 * gain for all angles of an arm under strong gravity, or for rules of a T-S system that differ
 * much, may be far worse than Riccati's. */
static int is_covered(const model *m, const hypothesis *h, double *difference)
{
    const long n = m->s.n, width = m->s.width;
    const double most = *m->design_flow.kind == KIND_SYSTEM ? 1.3 : 1.6;
    for (long i = 0; i < m->s.plant; i++) {
        if (m->X[i * (width + 1)] > most * most * h->covariance[i * (width + 1)]) {
            return 0;
        }
    }
    copy_matrix(m->X, width, difference, n, n, n);
    for (long i = 0; i < n; i++) {
        add_scaled(difference + i * n, -1.0, h->covariance + i * width, n);
    }
    return is_nonnegative(difference, n);
}

/* The certified bound holds for the whole interval to the next regular sample and, times
 * `late_factor`, for one more period. */
void predict(const model *m, state *at, double duration, int between_samples, work *scratch)
{
    const double shortest = between_samples ? 0.0 : *m->shortest;
    const int known = *at->torque_unknown == 0;
    const int regular = shortest <= duration && duration <= *m->longest && known;
    const hypothesis best = best_of(m, at);
    const int is_late = between_samples && !regular && known && *best.certified != 0
                        && *best.corrected != 0 && duration <= 2.0 * *m->period
                        && *m->late_factor >= 1.0;
    /* A system's input may be held until a second sample is lost; `coast` steps over both. */
    const double longest = *m->design_flow.kind == KIND_SYSTEM ? 1.9 * *m->period : *m->longest;
    const int in_gap = *m->torque_rate > 0.0 && *m->gain_mode != GAIN_OPEN && !is_late
                       && (*at->in_gap != 0 || !known || duration > longest);
    const double age = known ? *at->since : minimum(*at->torque_age, *at->age);
    const double rate = in_gap ? *m->torque_rate : 0.0;
    /* The 1 sigma of the torque where a gap begins. */
    const double spread = known ? 0.0 : minimum(rate * *at->torque_age, *m->torque_spread);
    const double opened = maximum(spread, rate * *m->period);
    course along = course_over(m, duration, rate * rate * (2.0 * age + duration), scratch);
    hypothesis h;
    *at->late = is_late;
    for (long i = 0; find_live(m, at, &i, &h); i++) {
        const int simple = *m->gain_mode == GAIN_OPEN
                           || (*h.certified != 0 && *h.corrected != 0 && (regular || is_late));
        if (between_samples && !counts_in_bounds(m, at, i, &h)) {
            continue;
        }
        if (!simple) {
            leave_certified(m, at, &h, BASIS_GAP);
        }
        if (in_gap && *at->in_gap == 0) {
            h.covariance[m->s.n * (m->s.width + 1)] += opened * opened;
        }
        predict_hypothesis(m, at, &h, &along, simple, scratch);
        if (!simple && !between_samples && !in_gap && *m->gain_mode == GAIN_CERTIFIED
            && i == AS_DESIGNED && *at->best == AS_DESIGNED && *h.settling <= 0.0
            && is_covered(m, &h, scratch->half)) {
            *h.certified = 1;
        }
    }
    *at->in_gap = in_gap;
    if (between_samples) {
        return;
    }
    for (long i = 0; i < m->s.past; i++) {
        at->past[2 * i + 1] += duration;
    }
    if (m->s.past > 0 && !isinf(at->past[1])) {
        at->held[0] = mean_torque(m, at, 0.0, *m->period);
    }
    *at->torque_age += duration;
    *at->torque_quiet += duration;
    *at->since += duration;
    *at->age += duration;
    *at->awake = maximum(0.0, *at->awake - duration);
    for (long i = 0; i < m->s.p; i++) {
        *sensor_of(m, at, i).since += duration;
    }
}
