/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Supervision works on each output by itself. The size of white noise is that of the differences of
 * neighbouring innovations, in which a wrong model does not show. The colour of a wrong model is
 * the product of neighbours, in which white noise does not. An innovation that is far too large is
 * an outlier and has little influence. Eight that lean to one side of a sudden are a jump of the
 * sensor. A long average that is far too large, and of one side, is an estimate that has lost the
 * arm, or a sensor that lies if the other outputs are as expected. Everything is decided on the
 * innovation in sigmas of the present noise and on durations between stamps, and each decision
 * shows in what the bounds are said to rest on. docs/estimator.md has the rules and their reasons.
 */
#include "filter.h"

/* From so much evidence on, innovations may be the torque's fault. */
#define SUSPICION 4.0

/* Innovations count up to so many sigmas in averages, so that outliers do not make them. */
#define CLIP 5.0

/* Median of a normal variable's size. */
#define MEDIAN 0.6745

/* Age of the learning from which on slow innovations are not of what is still to be learnt [s]. */
#define LEARNT_BY 10.0

/* Innovations are neighbours if at most so many periods lie between them. */
#define NEIGHBOURS 10.0

/* The noise's scale is kept above it, so that it grows in seconds if a quiet sensor gets noisy. */
#define LEAST_SCALE 0.5

/* What an output's innovation is a sign of. */
enum { USELESS, EARLY_OUTLIERS, LOST, JUMPED, AS_USUAL };

/* Half-second average of |r| below which an excluded output is used again. */
#define BACK 2.0

/* How many times wider than after a jump the covariance of a sensor's disturbance is if all trust
 * in it is lost. */
#define WIDE 20.0

/* Kinds of an innovation for the noise's scale, 0 for none. */
enum { REGULAR = 1, OUTLIER = 2 };

/* A jump: of the newest eight innovations, seven have one sign, six are beyond 1 sigma, and four
 * differences of neighbours are small. The newest four have its size. */
enum { LEANING = 8, SAME_SIGN = 7, FAR = 6, CLOSE = 4 };

/* Largest share of their sum before them, and least ratio of sizes among the newest four. */
#define SUDDEN 0.4
#define EVEN 0.3

/* Coloured powers: the largest before a jump, the least of a wrong model, the largest under a
 * certified bound, the least of a lost arm. That of white noise has a standard deviation of 0.07. */
#define CALM 0.7
#define STRAIN 1.0
#define SMOOTH 2.0

/* A larger `nis` contradicts a certified bound, which then comes back after so long [s]. */
#define DOUBT 3.0

/* So many outliers in a row, within so many seconds after a start, mean that it began from one. */
#define IN_A_ROW 5
#define EARLY 1.0

/* A lone innovation counts up to so many times `lost`. */
#define LOST_CLIP 4.0

/* Correlation of neighbours that white noise has by chance, and the largest that is used. */
#define WHITE 0.15
#define ALIKE 0.9

static void doubt(state *at, int64_t basis)
{
    *at->doubt = DOUBT;
    *at->doubted = basis;
}

/* Start the averages and the window of the innovations over. */
static void forget(sensor *of)
{
    int i;
    *of->nis = 1.0;
    *of->magnitude = 1.0;
    *of->coloured_power = 0.0;
    *of->watched = 0;
    *of->paired = 0;
    for (i = 0; i < WINDOW; i++) {
        of->recent[i] = 0.0;
        of->calm[i] = 0.0;
    }
}

/* Return whether innovations of one side have been far too large for long. */
static int is_lost(const model *m, const sensor *of)
{
    return *of->magnitude > *m->lost && *of->coloured_power > SMOOTH;
}

/* Add to the covariance what an output's newest samples have done, as they may be wrong. */
static void distrust(
    const model *m, state *at, const sensor *of, long output, const correction *effect,
    int64_t samples)
{
    const long n = (long)m->s.n, p = (long)m->s.p, width = (long)m->s.width;
    const int64_t first = *of->watched - samples;
    double total = 0.0;
    int64_t j;
    long a, b;
    for (j = first > 0 ? first : 0; j < *of->watched; j++) {
        total += copysign(of->sizes[j], of->recent[j]);
    }
    leave_certified(m, at, BASIS_GAP);
    for (a = 0; a < n; a++) {
        for (b = 0; b < n; b++) {
            at->covariance[a * width + b]
                += total * effect->gain[a * p + output] * (total * effect->gain[b * p + output]);
        }
    }
}

/* Follow the size of white noise by the running median of neighbouring differences: a stochastic
 * approximation in the logarithm of the scale. The variance is that of the innovations under the
 * certified gain. */
static void scale_noise(const model *m, sensor *of, double innovation, double variance)
{
    const double elapsed = *of->since;
    const double limit = larger(*of->noise_scale, 1.0) * *m->gate;
    const int64_t kind = fabs(innovation) > limit * sqrt(variance) ? OUTLIER : REGULAR;
    /* An outlier and its neighbour show nothing; if most are outliers, the noise is larger. */
    if (*of->paired == kind && elapsed <= NEIGHBOURS * *m->period) {
        const double expected = sqrt(2.0 * variance) * MEDIAN;
        const double rate = larger(20.0 / (1.0 + 20.0 * *of->scale_age), 1.0);
        const double step = 1.0 + 0.5 * rate * elapsed;
        if (fabs(innovation - *of->previous) > *of->noise_scale * expected) {
            *of->noise_scale *= step;
        } else {
            *of->noise_scale = larger(*of->noise_scale / step, LEAST_SCALE);
        }
        *of->scale_age += elapsed;
    }
    *of->previous = innovation;
    *of->paired = kind;
}

static void note_jump(const model *m, const state *at, sensor *of)
{
    int64_t i;
    while (*of->jump_count >= *m->jump_budget) {
        *of->jump_count -= 1;
        for (i = 0; i < *of->jump_count; i++) {
            of->jump_ages[i] = of->jump_ages[i + 1];
        }
    }
    of->jump_ages[*of->jump_count] = *at->watch_age;
    *of->jump_count += 1;
}

/* Return whether the newest of the innovations are as large as each other, and close. */
static int is_even(const double *recent, double total)
{
    const double reach = 0.5 * fabs(total) / LEANING;
    double least = CLIP, most = 0.0;
    int close = 0, i;
    /* All of the newest must be from after the jump, since they show its size. */
    for (i = WINDOW - CLOSE; i < WINDOW; i++) {
        least = minimum(least, fabs(recent[i]));
        most = maximum(most, fabs(recent[i]));
    }
    if (least < EVEN * most) {
        return 0;
    }
    /* Nor is it a jump if the samples differ as much among themselves, as in a burst of noise. */
    for (i = WINDOW - LEANING + 1; i < WINDOW; i++) {
        close += fabs(recent[i] - recent[i - 1]) < reach;
    }
    return close >= CLOSE;
}

/* Return whether the newest innovations lean to one side, of a sudden and all alike. */
static int leans(const model *m, const sensor *of)
{
    const double *recent = of->recent;
    /* A torque makes them lean as the second power of time: within a window, but not at once. */
    const int early = m->s.t == 0 ? LEANING : 2 * LEANING;
    double total = 0.0, before = 0.0;
    int positives = 0, up = 0, down = 0, i;
    if (*of->watched < WINDOW) {
        return 0;
    }
    for (i = 0; i < early; i++) {
        before += recent[i];
    }
    for (i = WINDOW - LEANING; i < WINDOW; i++) {
        total += recent[i];
        positives += recent[i] > 0.0;
        up += recent[i] > 1.0;
        down += recent[i] < -1.0;
    }
    /* A few outliers can make the sum, whose least is 6 sigma of white noise. */
    if ((positives > LEANING - positives ? positives : LEANING - positives) < SAME_SIGN
        || (up > down ? up : down) < FAR || fabs(total) <= 6.0 * sqrt((double)LEANING)) {
        return 0;
    }
    /* A wrong model makes them lean little by little. */
    if (before * copysign(1.0, total) > SUDDEN * fabs(total)) {
        return 0;
    }
    return is_even(recent, total);
}

static int may_jump(const model *m, const state *at, const sensor *of)
{
    const int64_t count = *of->jump_count;
    if (m->jump_std[0] == 0.0 || *m->jump_budget == 0 || *at->watch_age < *m->jump_quiet) {
        return 0;
    }
    if (count > 0 && *at->watch_age - of->jump_ages[count - 1] < *m->jump_duration) {
        return 0;
    }
    return count < *m->jump_budget
           || *at->watch_age - of->jump_ages[0] > *m->jump_budget_window;
}

/* Remember an innovation, which is r sigmas, in the window and the averages. */
static void remember(
    const model *m, sensor *of, double innovation, double r, double weight)
{
    const double clipped = minimum(maximum(r, -CLIP), CLIP);
    const double bounded = minimum(fabs(r), LOST_CLIP * *m->lost);
    double coloured = *of->coloured_power;
    int j;
    if (*of->watched > 0) {
        const double product = clipped * of->recent[*of->watched - 1];
        coloured += *m->second_share * (product - coloured);
    }
    if (*of->watched == WINDOW) {
        for (j = 0; j < WINDOW - 1; j++) {
            of->recent[j] = of->recent[j + 1];
            of->calm[j] = of->calm[j + 1];
            of->sizes[j] = of->sizes[j + 1];
        }
    } else {
        *of->watched += 1;
    }
    of->recent[*of->watched - 1] = clipped;
    of->sizes[*of->watched - 1] = fabs(innovation);
    of->calm[*of->watched - 1] = *of->coloured_power;
    *of->nis += *m->second_share * (clipped * clipped - *of->nis);
    /* A lone value of any size must not give the estimate up. */
    *of->magnitude += *m->magnitude_share * (bounded - *of->magnitude);
    *of->coloured_power = coloured;
    *of->in_a_row = weight < 1.0 ? *of->in_a_row + 1 : 0;
}

/* Take an output's newest innovations for a jump. */
static void take_jump(
    const model *m, state *at, sensor *of, long output, correction *effect)
{
    const double innovation = effect->innovation[output];
    double least = fabs(innovation);
    int j;
    for (j = WINDOW - CLOSE; j < WINDOW; j++) {
        least = minimum(least, of->sizes[j]);
    }
    *of->leap = copysign(least, innovation);
    *of->jumped = 1;
    if (m->s.p > 1 && m->disturbed[output] == 0) {
        /* It may be wrong all the same, which the other outputs decide. */
        distrust(m, at, of, output, effect, LEANING);
        *of->excluded = 1;
        effect->weight[output] = 0.0;
    }
    /* The averages start over: they belong to the time before the jump. */
    forget(of);
    if (*of->excluded != 0) {
        *of->magnitude = *m->lost;
    }
    note_jump(m, at, of);
}

/* Weigh one output by its innovation and return what that is a sign of. */
static int judge_output(
    const model *m, state *at, sensor *of, long output, correction *effect)
{
    const long p = (long)m->s.p, i = output;
    const double variance = effect->innovation_covariance[i * p + i];
    const double innovation = effect->innovation[i];
    double r, size, limit, weight = 1.0;
    count_repeats(REPETITION_OF(of), at->y[i], innovation, variance, m->R[i * p + i], 0.0);
    if (0 < *m->stuck_samples && *m->stuck_samples <= *of->repeats) {
        if (*of->repeats == *m->stuck_samples) {
            distrust(m, at, of, i, effect, *m->stuck_samples);
        }
        effect->weight[i] = 0.0;
        return USELESS;
    }
    r = variance >= 0.0 ? innovation / sqrt(variance) : (double)NAN;
    if (!isfinite(r)) {
        effect->weight[i] = 0.0;
        return USELESS;
    }
    scale_noise(m, of, innovation, m->innovation_covariance[i * p + i]);
    r /= larger(*of->noise_scale, 1.0);
    size = fabs(r);
    limit = *m->gate * sqrt(larger(*of->coloured_power, 1.0));
    if (size > limit) {
        weight = (limit / size) * (limit / size);
    }
    if (size > *m->reject) {
        weight = 0.0;
    }
    effect->weight[i] = weight;
    remember(m, of, innovation, r, weight);
    if (*at->settling > 0.0 && *at->watch_age < EARLY && *of->in_a_row >= IN_A_ROW) {
        return EARLY_OUTLIERS;
    }
    if (is_lost(m, of)) {
        return LOST;
    }
    if (weight < 1.0) {
        *at->outliers += 1;
    }
    if (leans(m, of) && of->calm[0] < CALM && *at->evidence < SUSPICION && may_jump(m, at, of)) {
        take_jump(m, at, of, i, effect);
        return JUMPED;
    }
    return AS_USUAL;
}

/* Add uncertainty to a disturbance's states, for a change that the model does not foresee: so much,
 * as a standard deviation, to each state that the disturbance is read from. The state is after a
 * correction with a Riccati gain. */
static void inflate(const model *m, state *at, long output, double std)
{
    const long width = (long)m->s.width;
    long i;
    for (i = 0; i < m->s.n; i++) {
        if (m->disturbance_map[output * width + i] != 0.0) {
            at->covariance[i * width + i] += std * std;
        }
    }
}

/* Start the estimate over, after the sample, which may be the worst of those that led here. The
 * disturbance is wide open, as a sensor is lost more often than the arm. */
static void give_up(const model *m, state *at, correction *effect)
{
    long i;
    int j;
    if (*at->hypothesis != AS_DESIGNED) {
        adopt(m, at);
    } else {
        bank_sleep(m, at);
        restart(m, at);
        for (i = 0; i < m->s.p; i++) {
            if (isfinite(m->disturbance_limit[i])) {
                inflate(m, at, i, m->disturbance_limit[i]);
            }
        }
        *at->corrected = 1;
    }
    for (i = 0; i < m->s.p; i++) {
        sensor of = sensor_of(m, at, i);
        forget(&of);
        *of.jump_count = 0;
        *of.excluded = 0;
        effect->weight[i] = 0.0;
        for (j = 0; j < MAX_JUMP_BUDGET; j++) {
            of.jump_ages[j] = 0.0;
        }
    }
    *at->strained = 0.0;
    *at->watch_age = 0.0;
    *at->losses += 1;
    doubt(at, BASIS_STARTING);
    if (*at->hypothesis == AS_DESIGNED
        || *alternative_of(m, at, (long)*at->hypothesis - 1).nis > MAX_NIS) {
        bank_sleep(m, at);
    }
}

/* Begin again, as the first samples were outliers themselves, and the others are taken for some. */
static void begin_again(const model *m, state *at, correction *effect)
{
    long i;
    bank_sleep(m, at);
    restart(m, at);
    for (i = 0; i < m->s.p; i++) {
        sensor of = sensor_of(m, at, i);
        forget(&of);
        *of.in_a_row = 0;
        effect->weight[i] = isfinite(at->y[i]) ? 1.0 : 0.0;
    }
    *at->strained = 0.0;
    *at->watch_age = 0.0;
    expect(m, at, effect);
}

/* Trust those outputs no longer that have lost the arm alone: the others are as expected. */
static void exclude_lost(const model *m, state *at, correction *effect)
{
    long i;
    for (i = 0; i < m->s.p; i++) {
        sensor of = sensor_of(m, at, i);
        if (*of.excluded == 0 && is_lost(m, &of)) {
            if (m->disturbed[i] != 0) {
                forget(&of);
            }
            *of.jumped = 2;
            *of.excluded = 1 - m->disturbed[i];
            effect->weight[i] = 0.0;
        }
    }
}

/* Take the largest of the used outputs' averages for those of all. */
static void sum_up(const model *m, state *at)
{
    double nis = -INFINITY, coloured = -INFINITY, scale = -INFINITY;
    long there = 0, i;
    for (i = 0; i < m->s.p; i++) {
        const sensor of = sensor_of(m, at, i);
        if (m->s.p == 1 || (at->y[i] == at->y[i] && *of.excluded == 0)) {
            nis = maximum(nis, *of.nis);
            coloured = maximum(coloured, *of.coloured_power);
            scale = maximum(scale, *of.noise_scale);
            there += 1;
        }
    }
    if (there > 0) {
        *at->nis = nis;
        *at->coloured_power = coloured;
        *at->noise_scale = scale;
    }
}

/* Weigh each output by its innovation, which the supervision remembers. Return whether a sensor
 * jumped. */
int judge(const model *m, state *at, correction *effect)
{
    long there = 0, early = 0, lost = 0, off = 0, i;
    int jumped = 0, regular = 0, contradicted = 0;
    double colour = 0.0;
    for (i = 0; i < m->s.p; i++) {
        sensor of = sensor_of(m, at, i);
        int verdict;
        *of.jumped = 0;
        if (effect->weight[i] == 0.0) {
            continue;
        }
        verdict = judge_output(m, at, &of, i, effect);
        if (verdict == USELESS) {
            continue;
        }
        if (*of.excluded != 0 && verdict != JUMPED) {
            effect->weight[i] = 0.0;
            if (*of.magnitude < BACK) {
                *of.excluded = 0;
            }
            continue;
        }
        there += 1;
        early += verdict == EARLY_OUTLIERS;
        lost += verdict == LOST;
        off += verdict == LOST || *of.nis > MAX_NIS;
        jumped = jumped || verdict == JUMPED;
        if (verdict == AS_USUAL) {
            regular = 1;
            colour = larger(*of.coloured_power, colour);
            contradicted = contradicted || *of.nis > MAX_NIS;
        }
    }
    if (early > 0 && early == there) {
        begin_again(m, at, effect);
        jumped = 0;
    } else if (lost > 0 && off == there) {
        give_up(m, at, effect);
        jumped = 0;
    } else if (jumped || lost > 0) {
        jumped = 1;
        if (lost > 0) {
            exclude_lost(m, at, effect);
        }
        doubt(at, BASIS_JUMP);
        *at->strained = 0.0;
    } else if (regular) {
        if (contradicted || colour > MAX_COLOUR) {
            doubt(at, BASIS_CONTRADICTED);
        }
        *at->strained = colour > STRAIN ? *at->strained + *m->period : 0.0;
    }
    sum_up(m, at);
    return jumped;
}

/* Move a disturbance by the least of the innovations that lean, by the smallest change. */
static void leap(const model *m, state *at, long output)
{
    const long n = (long)m->s.n;
    const double *h = m->disturbance_map + output * m->s.width;
    const double square = dot(h, h, n), by = *sensor_of(m, at, output).leap;
    long j;
    for (j = 0; j < n; j++) {
        at->x[j] += by * (h[j] / square);
    }
}

/* Move the disturbance of a sensor that jumped, and open its covariance. */
void follow_jumps(const model *m, state *at)
{
    int disturbed = 0;
    long i;
    for (i = 0; i < m->s.p; i++) {
        disturbed = disturbed || (*sensor_of(m, at, i).jumped != 0 && m->disturbed[i] != 0);
    }
    if (!disturbed) {
        return;
    }
    unlearn(m, at);
    for (i = 0; i < m->s.p; i++) {
        if (*sensor_of(m, at, i).jumped == 1 && m->disturbed[i] != 0) {
            leap(m, at, i);
        }
    }
    leave_certified(m, at, BASIS_JUMP);
    for (i = 0; i < m->s.p; i++) {
        const sensor of = sensor_of(m, at, i);
        if (*of.jumped != 0 && m->disturbed[i] != 0) {
            const double widest = minimum(m->disturbance_limit[i], WIDE * m->jump_std[i]);
            inflate(m, at, i, *of.jumped == 1 ? m->jump_std[i] : widest);
            *at->jumps += 1;
        }
    }
    *at->settling = maximum(*m->jump_duration, *at->settling);
    *at->corrected = 1;
    *at->pause = *m->jump_duration;
}

/* Return how many innovations say as much about parameters as one of white noise. Neighbours that
 * are alike repeat each other. Slow innovations may come of what is not learnt; soon after a start
 * they come of what is still to be learnt. */
double samples_in_one(const state *at)
{
    double share
        = minimum(maximum(*at->coloured_power / larger(*at->nis, 1.0) - WHITE, 0.0), ALIKE);
    double samples;
    if (*at->hypothesis == COLOURED_NOISE) {
        share = ALIKE;
    }
    samples = (1.0 + share) / (1.0 - share);
    if (*at->hypothesis != AS_DESIGNED || *at->age >= LEARNT_BY) {
        samples = larger(*at->slow_power, samples);
    }
    return samples;
}

/* Keep each disturbance w = h x within its limit, by the likeliest change of all n states: a change
 * of w alone would leave the innovation unexplained. */
void limit_disturbances(const model *m, double *x, const double *covariance, long n)
{
    const long designed = (long)m->s.n, width = (long)m->s.width;
    long i, j;
    for (i = 0; i < m->s.p; i++) {
        const double *h = m->disturbance_map + i * width, limit = m->disturbance_limit[i];
        const double omega = dot(h, x, designed);
        double variance, excess;
        if (fabs(omega) <= limit) {
            continue;
        }
        variance = quadratic(covariance, width, h, designed);
        if (variance > 0.0) {
            excess = omega - copysign(limit, omega);
            for (j = 0; j < n; j++) {
                x[j] -= excess * (dot(h, covariance + j * width, designed) / variance);
            }
        }
    }
}
