/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The steps of an estimator, each in place on one state record.
 *
 * The premise variable is the estimate itself; the flow's closed form of the T-S blend is exact on
 * the domain. One rule chooses the gain: the constant certified gain while the certificate's bound
 * X covers the error covariance, the Riccati (Kalman) gain along the estimate while it does not:
 * after a start, a reset or a missed sample. The hand-over rests on that covariance, which trusts
 * the initial one and is linearised along the estimate.
 *
 * An output that is missing, or far beyond reason, is left out. The certified gain is for all of
 * them together, so then the gain is that of Riccati for the others.
 */
#include "filter.h"

/* --- views --- */

/* Bind a model's flow of n states, if it is a record for this estimator. Return 0 or -1. */
static int bind_flow(
    const double *memory, int64_t length, const estimator_sizes *s, int64_t n, flow *view)
{
    flow_sizes sizes;
    if (!flow_is_valid(memory, (size_t)length)) {
        return -1;
    }
    sizes = flow_sizes_of(memory);
    *view = flow_view(memory);
    return sizes.n == n && sizes.m == s->m && sizes.k == s->k && sizes.p <= s->p
                   && flow_scratch_size(&sizes) <= (size_t)s->scratch
               ? 0
               : -1;
}

int sizes_are_sound(const int64_t *numbers)
{
    const estimator_sizes s = sizes_of(numbers);
    long i;
    for (i = 0; i < ESTIMATOR_SIZES; i++) {
        if (numbers[i] < 0 || numbers[i] > (i < 9 ? 1000 : 1000000000)) {
            return 0;
        }
    }
    return s.n >= 1 && s.width >= s.n && s.width >= s.n_gap && s.plant >= 1 && s.plant <= s.n
           && (s.n_gap == 0 || s.n_gap >= s.n + 2) && (s.n_gap == 0) == (s.gap_size == 0)
           && (s.bank == 0 || s.bank == ALTERNATIVES);
}

/* Return whether the model is one of an arm: four states of the plant, and the torque. */
static int is_arm(const model *m)
{
    return *m->design_flow.kind == KIND_ARM && m->s.n >= 4 && m->s.m >= 1;
}

int model_view(double *memory, size_t length, model *view)
{
    estimator_sizes *s = &view->s;
    long i;
    if (length < ESTIMATOR_SIZES || !sizes_are_sound((const int64_t *)(void *)memory)) {
        return -1;
    }
    *s = sizes_of((const int64_t *)(void *)memory);
    if (model_numbers_size(s) != length) {
        return -1;
    }
    MODEL_FIELDS(LAYOUT_BIND, s)
    if (bind_flow(view->flow, s->flow_size, s, s->n, &view->design_flow) < 0
        || (s->n_gap > 0 && bind_flow(view->gap, s->gap_size, s, s->n_gap, &view->gap_flow) < 0)) {
        return -1;
    }
    for (i = 0; i < s->bank; i++) {
        alternative_model *assumed = &view->hypotheses[i];
        alternative_model_bind(
            assumed, s, view->alternatives + (size_t)i * alternative_model_size(s));
        if (*assumed->n != 0
            && (*assumed->n > s->width
                || bind_flow(assumed->flow, s->bank_size, s, *assumed->n, &view->bank_flows[i]) < 0)) {
            return -1;
        }
    }
    if (*view->jump_budget > MAX_JUMP_BUDGET) {
        return -1;
    }
    /* Torques with a limit are the first input; those that are doubted are an arm's. */
    return (*view->torque_limit > 0.0 && s->m < 1) || (*view->torque_doubt > 0.0 && !is_arm(view))
               ? -1
               : 0;
}

int state_is_sound(const model *m, const state *at)
{
    long i;
    if (*at->hypothesis < 0 || *at->hypothesis > m->s.bank || (*at->awake != 0 && m->s.bank == 0)
        || (*at->in_gap != 0 && m->s.n_gap == 0)) {
        return 0;
    }
    if ((is_suspected(at) || *at->torque_step != 0.0) && !is_arm(m)) {
        return 0;
    }
    for (i = 0; i < m->s.p; i++) {
        const sensor of = sensor_of(m, at, i);
        if (*of.watched < 0 || *of.watched > WINDOW || *of.jump_count < 0
            || *of.jump_count > MAX_JUMP_BUDGET) {
            return 0;
        }
    }
    return 1;
}

/* --- correction --- */

/* Remember the newest sample of each output, and use those that there are. */
static void take_sample(const model *m, state *at, const double *y, correction *effect)
{
    long i;
    for (i = 0; i < m->s.p; i++) {
        const int there = isfinite(y[i]) != 0;
        at->y[i] = there ? y[i] : NAN;
        effect->weight[i] = there ? 1.0 : 0.0;
        if (there) {
            at->sample[i] = y[i];
        }
    }
}

static long count_used(const model *m, const correction *effect)
{
    long used = 0, i;
    for (i = 0; i < m->s.p; i++) {
        used += effect->weight[i] > 0.0;
    }
    return used;
}

/* Return whether every sensor is stuck. */
static int is_stuck(const model *m, const state *at)
{
    int stuck = 1;
    long i;
    for (i = 0; i < m->s.p; i++) {
        const sensor of = sensor_of(m, at, i);
        stuck = stuck && 0 < *m->stuck_samples && *m->stuck_samples <= *of.repeats;
    }
    return stuck;
}

/* Take an output of no weight out of what the gain is made of. */
static void leave_out(const model *m, correction *effect, long output, long n)
{
    const long p = (long)m->s.p, k = (long)m->s.k, i = output;
    long j;
    for (j = 0; j < p; j++) {
        effect->known[i * p + j] = 0.0;
        effect->known[j * p + i] = 0.0;
    }
    effect->known[i * p + i] = 1.0;
    for (j = 0; j < n; j++) {
        effect->crossed[i * n + j] = 0.0;
    }
    if (k > 0) {
        for (j = 0; j < k; j++) {
            effect->omega[i * k + j] = 0.0;
            effect->cross[i * k + j] = 0.0;
        }
        for (j = 0; j < p; j++) {
            effect->explained[i * p + j] = 0.0;
            effect->explained[j * p + i] = 0.0;
        }
    }
}

/* Write the innovation y - C x - D y, its covariance S = C Sigma C' + R (+ Omega Gamma Omega'), and
 * the gain for it. The gain for an output of no weight is 0. */
void expect(const model *m, state *at, correction *effect)
{
    const long n = width_in_use(m, at), p = (long)m->s.p, k = (long)m->s.k;
    const long width = (long)m->s.width;
    double *S = effect->innovation_covariance;
    long i, j;
    for (i = 0; i < p; i++) {
        double expected = dot(m->C + i * width, at->x, n);
        if (*m->gain_mode == GAIN_OPEN) { /* else D is zero, but not times infinity */
            expected += dot(m->D + i * p, at->sample, p);
        }
        effect->innovation[i] = at->y[i] - expected;
    }
    if (*m->gain_mode == GAIN_OPEN) {
        copy_rows(m->R, S, p, p, p);
    } else if (*at->certified != 0) {
        copy_rows(m->innovation_covariance, S, p, p, p);
        copy_rows(m->K, effect->gain, n, p, p);
    } else {
        congruence(m->C, width, at->covariance, width, m->R, effect->crossed, S, p, p, n);
    }
    copy_rows(S, effect->known, p, p, p);
    if (k > 0) {
        for (i = 0; i < p; i++) {
            for (j = 0; j < k; j++) {
                effect->omega[i * k + j] = dot(m->C + i * width, at->upsilon + j * width, n);
            }
        }
        congruence(
            effect->omega, k, at->gamma, k, NULL, effect->cross, effect->explained, p, p, k);
        for (i = 0; i < p * p; i++) {
            S[i] += effect->explained[i];
        }
    }
    for (i = 0; i < p; i++) {
        if (!(effect->weight[i] > 0.0)) {
            leave_out(m, effect, i, n);
        }
    }
    if (*m->gain_mode != GAIN_OPEN && *at->certified == 0) {
        solve(effect->known, effect->crossed, effect->factor, effect->crossed, p, n);
        for (i = 0; i < n; i++) {
            for (j = 0; j < p; j++) {
                effect->gain[i * p + j] = effect->crossed[j * n + i];
            }
        }
    }
}

/* Return by how much the innovations are larger than the learning assumes: the mean of the error
 * covariance relative to the certified bound, tr(P Sigma)/n, at least 1, and what was measured. */
static double inflation_of(const model *m, const state *at, int learning)
{
    const long n = (long)m->s.n, width = (long)m->s.width;
    double inflation = 1.0;
    long i;
    if (learning && *at->certified == 0) {
        double total = 0.0;
        for (i = 0; i < n; i++) {
            total += dot(m->P + i * width, at->covariance + i * width, n);
        }
        inflation = larger(total / (double)n, 1.0);
    }
    if (*m->supervised != 0) {
        const double scale = larger(*at->noise_scale, 1.0);
        inflation *= scale * scale * larger(*at->nis, 1.0) * samples_in_one(at);
    }
    return inflation;
}

/* Correct estimate and parameters by an innovation, with the outlier's weight. The covariance
 * shrinks with the weighted gain too: if it shrank as for a full correction, an estimate that is
 * wrong would take sample after sample for an outlier, and its bound would fall. */
static void apply_correction(const model *m, state *at, correction *effect, int adapt)
{
    const long n = width_in_use(m, at), p = (long)m->s.p, k = (long)m->s.k;
    const long width = (long)m->s.width;
    double inflation;
    long i, j;
    adapt = adapt && *at->age >= *m->adaptation_start;
    for (j = 0; j < p; j++) {
        adapt = adapt && !(0.0 < effect->weight[j] && effect->weight[j] < 1.0);
    }
    inflation = inflation_of(m, at, adapt && k > 0);
    for (i = 0; i < n; i++) {
        for (j = 0; j < p; j++) {
            if (effect->weight[j] > 0.0) {
                effect->gain[i * p + j] *= effect->weight[j];
                at->x[i] += effect->gain[i * p + j] * effect->innovation[j];
            }
        }
    }
    *at->corrected = 1;
    if (*at->certified != 0) {
        *at->settling = 0.0;
    } else {
        joseph_form(
            m->C, width, m->R, at->covariance, width, effect->gain, effect->squares,
            at->covariance, width, n, p);
    }
    if (k > 0) {
        const int moving = moves(m, at);
        learn(m, at, effect, adapt && moving, inflation);
    }
}

/* Follow what a used sample showed, after the estimate is corrected. */
static void supervise(
    const model *m, state *at, correction *effect, int jumped, int suspected)
{
    correct_response(m, at, effect);
    if (suspected) {
        leave_certified(m, at, BASIS_TORQUE);
        distrust_torque(m, at);
    } else if (jumped) {
        *at->evidence = 0.0;
    }
    limit_disturbances(m, at->x, at->covariance, width_in_use(m, at));
    guard(m, at);
}

/* Weigh the hypotheses, and keep the disturbances of the selected one within their limits. */
static void weigh_hypotheses(const model *m, state *at, correction *effect, long used)
{
    /* What is far beyond reason shows nothing, unless the design is what is far off. */
    if (used > 0 || (!is_stuck(m, at) && *at->hypothesis != AS_DESIGNED)) {
        weigh(m, at, effect);
    }
    if (*at->hypothesis != AS_DESIGNED) {
        const long place = (long)*at->hypothesis - 1;
        const alternative chosen = alternative_of(m, at, place);
        limit_disturbances(m, chosen.x, chosen.covariance, (long)*m->hypotheses[place].n);
    }
}

void correct(const model *m, state *at, const double *y, correction *effect)
{
    int adapt = 1, jumped = 0, suspected = 0;
    long used, i;
    if (*at->torque_unknown == 0) {
        *at->in_gap = 0;
    }
    if (*at->torque_step != 0.0) {
        if (is_suspected(at)) {
            leave_certified(m, at, BASIS_TORQUE);
        }
        begin_step(m, at);
    }
    take_sample(m, at, y, effect);
    expect(m, at, effect);
    if (*m->supervised != 0) {
        suspected = weigh_step(m, at, effect);
        jumped = judge(m, at, effect);
        adapt = *at->pause <= 0.0 && *at->resting == 0;
    }
    used = *m->gain_mode != GAIN_OPEN ? count_used(m, effect) : 0;
    if (used > 0) {
        if (used < m->s.p) {
            /* The certified gain is for all outputs together. */
            leave_certified(m, at, BASIS_GAP);
            expect(m, at, effect);
        }
        apply_correction(m, at, effect, adapt);
    }
    if (jumped) {
        /* A jump may be so large that its samples themselves are not used. */
        follow_jumps(m, at);
    }
    if (used > 0) {
        if (*m->supervised != 0) {
            supervise(m, at, effect, jumped, suspected);
        }
        if ((jumped || suspected) && *at->hypothesis == AS_DESIGNED) {
            bank_sleep(m, at);
        }
    }
    if (*m->supervised != 0 && m->s.bank != 0) {
        weigh_hypotheses(m, at, effect, used);
    }
    *at->since = 0.0;
    for (i = 0; i < m->s.p; i++) {
        const sensor of = sensor_of(m, at, i);
        const int there = at->y[i] == at->y[i];
        if (there) {
            *of.since = 0.0;
        }
        if (effect->weight[i] == 0.0) {
            *(there ? of.gated : of.missing) += 1;
        }
    }
}

/* --- prediction --- */

void leave_certified(const model *m, state *at, int64_t cause)
{
    if (cause == BASIS_JUMP) {
        *at->cause = cause;
    }
    if (*at->certified != 0) {
        const double *bound = *at->corrected != 0 ? m->posterior : m->X;
        *at->cause = cause;
        copy_rows(bound, at->covariance, (long)m->s.n, (long)m->s.n, (long)m->s.width);
        *at->certified = 0;
    }
}

/* Let the ages grow over a time that ends at a sample. */
static void grow_older(const model *m, state *at, double duration)
{
    long i;
    *at->torque_age += duration;
    *at->distrust = maximum(0.0, *at->distrust - duration);
    *at->pause = maximum(0.0, *at->pause - duration);
    *at->watch_age += duration;
    *at->since += duration;
    for (i = 0; i < m->s.p; i++) {
        *sensor_of(m, at, i).since += duration;
    }
    *at->doubt = maximum(0.0, *at->doubt - duration);
    *at->relearned = maximum(0.0, *at->relearned - duration / *m->relearn_time);
    if (m->s.k > 0) {
        forget_slowly(m, at, duration);
    }
}

/* The certified bound serves the whole interval to the next regular sample, and with `late_factor`
 * a period beyond. */
void predict(
    const model *m, state *at, const double *u, double duration, int between_samples,
    work *scratch)
{
    const long width = (long)m->s.width;
    const double shortest = between_samples ? 0.0 : *m->shortest;
    const int known = *at->torque_unknown == 0;
    const int regular = shortest <= duration && duration <= *m->longest && known;
    const int as_proved = *at->certified != 0 && *at->corrected != 0;
    const int late = between_samples && !regular && known && as_proved
                     && duration <= 2.0 * *m->period && *m->late_factor >= 1.0;
    const int simple = *m->gain_mode == GAIN_OPEN || late || (as_proved && regular);
    int in_gap;
    *at->late = late;
    if (!simple) {
        leave_certified(m, at, BASIS_GAP);
    }
    in_gap = !simple && m->s.n_gap > 0
             && (*at->in_gap != 0 || *at->torque_unknown != 0 || duration > *m->longest);
    if (in_gap && *at->in_gap == 0) {
        enter_gap(m, at);
    }
    flow_advance(
        in_gap ? &m->gap_flow : &m->design_flow, at->x, at->upsilon,
        simple ? NULL : at->covariance, width, at->theta, at->sample, u, duration, scratch->flow);
    *at->in_gap = in_gap;
    *at->corrected = 0;
    if (!simple) {
        *at->settling = maximum(0.0, *at->settling - duration);
        if (!(between_samples || in_gap) && *m->gain_mode == GAIN_CERTIFIED
            && *at->settling <= 0.0 && is_below(at->covariance, width, m->X, width, scratch->square, (long)m->s.n)) {
            *at->certified = 1;
            copy_rows(m->X, at->covariance, (long)m->s.n, (long)m->s.n, width);
        }
    }
    if (*at->awake != 0) {
        predict_alternatives(m, at, u, duration, scratch);
    }
    if (!between_samples) {
        follow_step(m, at, duration, scratch);
        grow_older(m, at, duration);
    }
}

void restart(const model *m, state *at)
{
    const long n = (long)m->s.n, k = (long)m->s.k, width = (long)m->s.width;
    state initial;
    long i;
    state_bind(&initial, &m->s, m->initial);
    *at->settling = *initial.settling;
    *at->age = 0.0;
    *at->certified = 0;
    *at->corrected = 0;
    *at->in_gap = 0;
    *at->cause = BASIS_STARTING;
    for (i = 0; i < m->s.p; i++) {
        const sensor of = sensor_of(m, at, i);
        forget_value(REPETITION_OF(&of));
    }
    for (i = 0; i < n; i++) {
        at->x[i] = 0.0;
    }
    *at->significant = 0;
    *at->pass_age = 0.0;
    *at->passes = 0;
    for (i = 0; i < k; i++) {
        at->theta[i] = 0.0;
        at->anchor[i] = 0.0;
        at->pending[i] = 0.0;
    }
    copy_rows(initial.covariance, at->covariance, n, n, width);
    copy_rows(initial.gamma, at->gamma, k, k, k);
    copy_rows(initial.upsilon, at->upsilon, k, n, width);
    copy_rows(initial.gram, at->gram, k, k, k);
    keep_nothing_else(m, at);
    forget_step(m, at);
}
