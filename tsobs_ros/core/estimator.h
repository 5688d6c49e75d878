/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The estimator: its records, and its steps in place on one state record.
 *
 *     correct:  x <- x + K (y - C x)        predict:  x <- flow(x, u, T)
 *
 * A model record begins with its sizes, see `estimator_sizes`, so that `model_view` needs no other
 * arguments. Fields of n states have rows of `width` numbers, the most that the estimate, the one
 * in a gap or an alternative has; what is behind the states in use is left alone. All else is
 * dense. Flags are 0 or 1.
 */
#ifndef TSOBS_ESTIMATOR_H
#define TSOBS_ESTIMATOR_H

#include "flow.h"
#include "layout.h"

enum {
    WINDOW = 24,          /* innovations of an output that are looked at together for a jump */
    MAX_JUMP_BUDGET = 32, /* jumps that a sensor's record has room for */
    ALTERNATIVES = 4,     /* hypotheses besides the design, in the order of `hypothesis` */
    CONDITIONS = 6        /* numbers of a row that say what the others are worth */
};

/* Gains: none, as the observer is integrated, that of Riccati, or the certified one. */
enum { GAIN_OPEN, GAIN_RICCATI, GAIN_CERTIFIED };

/* What the bounds rest on. */
enum {
    BASIS_CERTIFIED,
    BASIS_LEARNT,
    BASIS_STARTING,
    BASIS_GAP,
    BASIS_JUMP,
    BASIS_TORQUE,
    BASIS_CONTRADICTED,
    BASIS_HYPOTHESIS,
    BASIS_OUTSIDE
};

/* What the learning of parameters does. */
enum { LEARNING_NONE, LEARNING_STARTING, LEARNING_ACTIVE, LEARNING_AFTER_JUMP, LEARNING_STRAINED };

/* What the estimate takes the arm and its sensor for. */
enum { AS_DESIGNED, FORCE, STRONG_FORCE, COLOURED_NOISE, DRIFT };

/* Sizes of an estimator, the first numbers of its model record, as 64-bit integers. */
#define ESTIMATOR_SIZES 13
typedef struct {
    int64_t n;         /* augmented states */
    int64_t width;     /* the most states of n, n_gap and the alternatives: length of rows */
    int64_t plant;     /* of the plant's own states, the first */
    int64_t p;         /* outputs */
    int64_t m;         /* inputs and scheduled signals */
    int64_t k;         /* learnt parameters */
    int64_t n_gap;     /* augmented states in a gap, 0 if the torque is held there */
    int64_t t;         /* torques that are estimated */
    int64_t bank;      /* alternatives, ALTERNATIVES or 0 */
    int64_t flow_size; /* numbers of the design's flow, */
    int64_t gap_size;  /* of the flow in a gap, */
    int64_t bank_size; /* of the longest flow of an alternative, */
    int64_t scratch;   /* and of the scratch that they need */
} estimator_sizes;

/* Return the sizes that a model record's first numbers are, and whether they belong together. */
static inline estimator_sizes sizes_of(const int64_t *numbers)
{
    const estimator_sizes s = {
        numbers[0], numbers[1], numbers[2], numbers[3],  numbers[4],  numbers[5], numbers[6],
        numbers[7], numbers[8], numbers[9], numbers[10], numbers[11], numbers[12]};
    return s;
}
int sizes_are_sound(const int64_t *numbers);

/* What is remembered of one output.
 *
 * recent, sizes, calm: its newest innovations in sigmas and in units, and the coloured power before
 * each, the newest of `watched` last. leap: by how much they lean after a jump. nis, magnitude,
 * coloured_power: averages of r^2, |r| and the product of neighbours. noise_scale: size of the
 * white noise relative to the design's; scale_age: time it has been learnt for [s]; previous,
 * paired: the innovation before and its kind; since: time since the last sample [s]. slow:
 * low-passed innovation in sigmas; slow_power: power of it relative to a white one's. jump_ages,
 * jump_count: of its jumps since a start; jumped: whether the newest sample shows one, or (2) that
 * all trust in it is lost. excluded: whether the other outputs contradict it.
 *
 * Of repeats: value: the latest one, NaN before the first. step, rough: of the sensor, and of the
 * differences of its innovations, 0 before the first difference. before: innovation of the sample
 * before. nearest: least |y - C x| of the value. repeats: repetitions that count. Then counts. */
#define SENSOR_FIELDS(F, s)                 \
    F(VECTOR, recent, WINDOW, 1)            \
    F(VECTOR, sizes, WINDOW, 1)             \
    F(VECTOR, calm, WINDOW, 1)              \
    F(COUNT, watched, 1, 1)                 \
    F(COUNT, in_a_row, 1, 1)                \
    F(NUMBER, nis, 1, 1)                    \
    F(NUMBER, magnitude, 1, 1)              \
    F(NUMBER, noise_scale, 1, 1)            \
    F(NUMBER, scale_age, 1, 1)              \
    F(NUMBER, previous, 1, 1)               \
    F(NUMBER, leap, 1, 1)                   \
    F(COUNT, paired, 1, 1)                  \
    F(NUMBER, since, 1, 1)                  \
    F(NUMBER, coloured_power, 1, 1)         \
    F(NUMBER, slow, 1, 1)                   \
    F(NUMBER, slow_power, 1, 1)             \
    F(VECTOR, jump_ages, MAX_JUMP_BUDGET, 1) \
    F(COUNT, jump_count, 1, 1)              \
    F(COUNT, jumped, 1, 1)                  \
    F(COUNT, excluded, 1, 1)                \
    F(NUMBER, value, 1, 1)                  \
    F(NUMBER, step, 1, 1)                   \
    F(NUMBER, rough, 1, 1)                  \
    F(NUMBER, before, 1, 1)                 \
    F(NUMBER, nearest, 1, 1)                \
    F(COUNT, repeats, 1, 1)                 \
    F(COUNT, gated, 1, 1)                   \
    F(COUNT, missing, 1, 1)
LAYOUT_DECLARE(sensor, SENSOR_FIELDS, estimator_sizes)

/* A filter under another hypothesis.
 *
 * x, covariance, upsilon: as of the estimator, with states of its own behind the design's. score:
 * logarithm of its likelihood relative to the best. nis: one-second average of the squares of its
 * innovations in sigmas. variances: expected of the newest innovations. */
#define ALTERNATIVE_FIELDS(F, s)               \
    F(VECTOR, x, s->width, 1)                  \
    F(MATRIX, covariance, s->width, s->width)  \
    F(MATRIX, upsilon, s->k, s->width)         \
    F(NUMBER, score, 1, 1)                     \
    F(NUMBER, nis, 1, 1)                       \
    F(VECTOR, variances, s->p, 1)
LAYOUT_DECLARE(alternative, ALTERNATIVE_FIELDS, estimator_sizes)

/* All that an estimator remembers.
 *
 * stamp, y, u: of the newest sample [ns], a missing output is NaN. sample: the newest of each
 * output. held: inputs in use, those of the newest sample with plausible ones; torque_age: time
 * since that [s]; torque_unknown: whether it is not the newest. torque_change to distrust: of the
 * torque's supervision, as what was suspected of it, and since when.
 * x: estimate in design coordinates. covariance: of its error; the certificate's bound while
 * `certified`. While `in_gap` both have the unknown torque's states too. late: whether it is read
 * after the stamp at which the next sample was due. settling: least time with Riccati gains left
 * [s]. corrected: whether a sample was used since the last prediction. cause: basis of that
 * covariance.
 *
 * theta, gamma, upsilon (by rows), gram, age: of the adaptation. pending: change of theta that is
 * used once it is significant. anchor, pass_age [s], passes: where the present pass of learning
 * began, how long it takes, and how many there were. theta_before, pending_before, gamma_before:
 * of two earlier samples, the older one last; kept: samples until the next are kept. centre,
 * spread: mean and variance of x over some seconds. relearned: used part of the budget of learning;
 * resting: whether it is used up. pinned: time for which a parameter has been at its limit [s];
 * strained: time for which innovations have contradicted the model [s]. pause: time for which the
 * adaptation rests after a jump [s].
 *
 * sensors: of the outputs. nis, coloured_power, noise_scale, slow_power: the largest of theirs.
 * since: time since the last sample [s]. doubt: time for which nothing is certified [s]; doubted:
 * basis meanwhile. watch_age: time since a start [s]. awake, awake_time [s]: of the alternatives.
 * hypothesis: the selected one. score: of the design. The others are counts. */
#define STATE_FIELDS(F, s)                               \
    F(COUNT, stamp, 1, 1)                                \
    F(VECTOR, y, s->p, 1)                                \
    F(VECTOR, sample, s->p, 1)                           \
    F(VECTOR, u, s->m, 1)                                \
    F(VECTOR, held, s->m, 1)                             \
    F(NUMBER, torque_age, 1, 1)                          \
    F(COUNT, torque_unknown, 1, 1)                       \
    F(NUMBER, torque_change, 1, 1)                       \
    F(NUMBER, torque_step, 1, 1)                         \
    F(NUMBER, step_age, 1, 1)                            \
    F(NUMBER, departure, 1, 1)                           \
    F(VECTOR, response, s->width, 1)                     \
    F(NUMBER, evidence, 1, 1)                            \
    F(NUMBER, distrust, 1, 1)                            \
    F(VECTOR, x, s->width, 1)                            \
    F(MATRIX, covariance, s->width, s->width)            \
    F(NUMBER, settling, 1, 1)                            \
    F(COUNT, certified, 1, 1)                            \
    F(COUNT, late, 1, 1)                                 \
    F(COUNT, corrected, 1, 1)                            \
    F(COUNT, in_gap, 1, 1)                               \
    F(VECTOR, theta, s->k, 1)                            \
    F(MATRIX, gamma, s->k, s->k)                         \
    F(MATRIX, upsilon, s->k, s->width)                   \
    F(MATRIX, gram, s->k, s->k)                          \
    F(VECTOR, pending, s->k, 1)                          \
    F(COUNT, significant, 1, 1)                          \
    F(VECTOR, anchor, s->k, 1)                           \
    F(NUMBER, pass_age, 1, 1)                            \
    F(COUNT, passes, 1, 1)                               \
    F(MATRIX, theta_before, 2, s->k)                     \
    F(MATRIX, pending_before, 2, s->k)                   \
    F(MATRIX, gamma_before, 2, s->k * s->k)              \
    F(COUNT, kept, 1, 1)                                 \
    F(VECTOR, centre, s->width, 1)                       \
    F(VECTOR, spread, s->width, 1)                       \
    F(COUNT, cause, 1, 1)                                \
    F(NUMBER, age, 1, 1)                                 \
    F(MATRIX, sensors, s->p, sensor_size(s))             \
    F(NUMBER, nis, 1, 1)                                 \
    F(NUMBER, coloured_power, 1, 1)                      \
    F(NUMBER, noise_scale, 1, 1)                         \
    F(NUMBER, slow_power, 1, 1)                          \
    F(NUMBER, since, 1, 1)                               \
    F(NUMBER, strained, 1, 1)                            \
    F(NUMBER, doubt, 1, 1)                               \
    F(COUNT, doubted, 1, 1)                              \
    F(COUNT, resting, 1, 1)                              \
    F(NUMBER, relearned, 1, 1)                           \
    F(COUNT, awake, 1, 1)                                \
    F(NUMBER, awake_time, 1, 1)                          \
    F(COUNT, hypothesis, 1, 1)                           \
    F(NUMBER, score, 1, 1)                               \
    F(MATRIX, alternatives, s->bank, alternative_size(s)) \
    F(NUMBER, watch_age, 1, 1)                           \
    F(NUMBER, pause, 1, 1)                               \
    F(NUMBER, pinned, 1, 1)                              \
    F(COUNT, outliers, 1, 1)                             \
    F(COUNT, jumps, 1, 1)                                \
    F(COUNT, losses, 1, 1)                               \
    F(COUNT, adaptation_resets, 1, 1)                    \
    F(COUNT, gated, 1, 1)                                \
    F(COUNT, implausible, 1, 1)                          \
    F(COUNT, restarts, 1, 1)                             \
    F(COUNT, failures, 1, 1)
LAYOUT_DECLARE(state, STATE_FIELDS, estimator_sizes)

/* A sample's effect, and behind `weight` scratch of the same step. The gain has a row of p numbers
 * for each state. */
#define CORRECTION_FIELDS(F, s)                                             \
    F(VECTOR, innovation, s->p, 1)                                          \
    F(MATRIX, innovation_covariance, s->p, s->p)                            \
    F(MATRIX, gain, s->width, s->p)                                         \
    F(VECTOR, weight, s->p, 1)                                              \
    F(MATRIX, known, s->p, s->p)                                            \
    F(MATRIX, explained, s->p, s->p)                                        \
    F(MATRIX, omega, s->p, s->k)                                            \
    F(MATRIX, cross, s->p, s->k)                                            \
    F(MATRIX, factor, s->p, s->p)                                           \
    F(MATRIX, crossed, s->p, s->width)                                      \
    F(MATRIX, turned, s->p, s->k)                                           \
    F(VECTOR, whitened, s->p, 1)                                            \
    F(VECTOR, shift, s->k, 1)                                               \
    F(VECTOR, scaled, s->k, 1)                                              \
    F(MATRIX, root, s->k, s->k)                                             \
    F(MATRIX, vectors, 2, s->width)                                         \
    F(MATRIX, squares, 3, s->width * (s->width > s->p ? s->width : s->p))
LAYOUT_DECLARE(correction, CORRECTION_FIELDS, estimator_sizes)

/* An estimate in physical units. finite: whether all numbers are. */
#define READOUT_FIELDS(F, s)                    \
    F(VECTOR, state, s->plant, 1)               \
    F(VECTOR, state_bound, s->plant, 1)         \
    F(VECTOR, disturbance, s->p, 1)             \
    F(VECTOR, disturbance_rate, s->p, 1)        \
    F(VECTOR, disturbance_bound, s->p, 1)       \
    F(VECTOR, parameters, s->k, 1)              \
    F(VECTOR, parameter_bound, s->k, 1)         \
    F(VECTOR, designed_disturbance, s->p, 1)    \
    F(VECTOR, designed_bound, s->p, 1)          \
    F(VECTOR, torque_disturbance, s->t, 1)      \
    F(VECTOR, torque_disturbance_bound, s->t, 1) \
    F(COUNT, basis, 1, 1)                       \
    F(COUNT, parameters_valid, 1, 1)            \
    F(NUMBER, noise_scale, 1, 1)                \
    F(NUMBER, coloured_power, 1, 1)             \
    F(COUNT, learning, 1, 1)                    \
    F(COUNT, hypothesis, 1, 1)                  \
    F(COUNT, finite, 1, 1)
LAYOUT_DECLARE(readout, READOUT_FIELDS, estimator_sizes)

/* Scratch of a prediction or a readout. */
#define WORK_FIELDS(F, s)                 \
    F(VECTOR, flow, s->scratch, 1)        \
    F(MATRIX, square, s->width, s->width) \
    F(MATRIX, small, s->k, s->k)          \
    F(VECTOR, share, s->k, 1)             \
    F(VECTOR, moved, s->width, 1)
LAYOUT_DECLARE(work, WORK_FIELDS, estimator_sizes)

/* A hypothesis' model.
 *
 * flow: a record of its own sizes. n: number of its states, the last of them a torque; 0 if it is
 * not considered. C: outputs. variances: of the white noise of one sample of each. added: initial
 * variances of its own states. prior: by how much its score must exceed the design's. hysteresis:
 * by how much less, once it is selected. */
#define ALTERNATIVE_MODEL_FIELDS(F, s)  \
    F(VECTOR, flow, s->bank_size, 1)    \
    F(COUNT, n, 1, 1)                   \
    F(MATRIX, C, s->p, s->width)        \
    F(VECTOR, variances, s->p, 1)       \
    F(NUMBER, prior, 1, 1)              \
    F(NUMBER, hysteresis, 1, 1)         \
    F(VECTOR, added, s->width, 1)
LAYOUT_DECLARE(alternative_model, ALTERNATIVE_MODEL_FIELDS, estimator_sizes)

/* A model: sizes, flows, the initial state, output, gains, bounds and options. */
#define MODEL_FIELDS(F, s)                                         \
    F(COUNT, n, 1, 1)                                              \
    F(COUNT, width, 1, 1)                                          \
    F(COUNT, plant, 1, 1)                                          \
    F(COUNT, p, 1, 1)                                              \
    F(COUNT, m, 1, 1)                                              \
    F(COUNT, k, 1, 1)                                              \
    F(COUNT, n_gap, 1, 1)                                          \
    F(COUNT, t, 1, 1)                                              \
    F(COUNT, bank, 1, 1)                                           \
    F(COUNT, flow_size, 1, 1)                                      \
    F(COUNT, gap_size, 1, 1)                                       \
    F(COUNT, bank_size, 1, 1)                                      \
    F(COUNT, scratch, 1, 1)                                        \
    F(VECTOR, flow, s->flow_size, 1)                               \
    F(VECTOR, gap, s->gap_size, 1)                                 \
    F(MATRIX, alternatives, s->bank, alternative_model_size(s))    \
    F(VECTOR, initial, state_size(s), 1)                           \
    F(NUMBER, period, 1, 1)                                        \
    F(NUMBER, shortest, 1, 1)                                      \
    F(NUMBER, longest, 1, 1)                                       \
    F(NUMBER, late_factor, 1, 1)                                   \
    F(NUMBER, rate_variance, 1, 1)                                 \
    F(NUMBER, torque_limit, 1, 1)                                  \
    F(NUMBER, torque_rate_limit, 1, 1)                             \
    F(NUMBER, torque_spread, 1, 1)                                 \
    F(NUMBER, torque_doubt, 1, 1)                                  \
    F(COUNT, gain_mode, 1, 1)                                      \
    F(MATRIX, C, s->p, s->width)                                   \
    F(MATRIX, D, s->p, s->p)                                       \
    F(MATRIX, R, s->p, s->p)                                       \
    F(MATRIX, K, s->width, s->p)                                   \
    F(MATRIX, X, s->width, s->width)                               \
    F(MATRIX, P, s->width, s->width)                               \
    F(MATRIX, posterior, s->width, s->width)                       \
    F(MATRIX, innovation_covariance, s->p, s->p)                   \
    F(VECTOR, scale, s->plant, 1)                                  \
    F(MATRIX, disturbance_map, s->p, s->width)                     \
    F(MATRIX, disturbance_direct, s->p, s->p)                      \
    F(MATRIX, rate_map, s->p, s->width)                            \
    F(MATRIX, torque_map, s->t, s->width)                          \
    F(COUNTS, disturbed, s->p, 1)                                  \
    F(VECTOR, state_std, s->width, 1)                              \
    F(VECTOR, disturbance_std, s->p, 1)                            \
    F(VECTOR, torque_std, s->t, 1)                                 \
    F(VECTOR, limits, s->k, 1)                                     \
    F(NUMBER, theta_variance, 1, 1)                                \
    F(NUMBER, motion_share, 1, 1)                                  \
    F(NUMBER, random_walk, 1, 1)                                   \
    F(NUMBER, significance, 1, 1)                                  \
    F(NUMBER, pass_time, 1, 1)                                     \
    F(NUMBER, pass_reach, 1, 1)                                    \
    F(NUMBER, adaptation_start, 1, 1)                              \
    F(NUMBER, memory, 1, 1)                                        \
    F(NUMBER, excitation, 1, 1)                                    \
    F(COUNT, covered, 1, 1)                                        \
    F(COUNT, supervised, 1, 1)                                     \
    F(NUMBER, gate, 1, 1)                                          \
    F(NUMBER, reject, 1, 1)                                        \
    F(VECTOR, jump_std, s->p, 1)                                   \
    F(NUMBER, jump_duration, 1, 1)                                 \
    F(NUMBER, jump_quiet, 1, 1)                                    \
    F(COUNT, jump_budget, 1, 1)                                    \
    F(NUMBER, jump_budget_window, 1, 1)                            \
    F(NUMBER, lost, 1, 1)                                          \
    F(COUNT, stuck_samples, 1, 1)                                  \
    F(VECTOR, disturbance_limit, s->p, 1)                          \
    F(NUMBER, strain, 1, 1)                                        \
    F(COUNT, relearn_budget, 1, 1)                                 \
    F(NUMBER, relearn_time, 1, 1)                                  \
    F(NUMBER, second_share, 1, 1)                                  \
    F(NUMBER, magnitude_share, 1, 1)                               \
    F(NUMBER, sign_share, 1, 1)                                    \
    F(NUMBER, sign_power_share, 1, 1)                              \
    F(NUMBER, score_fade, 1, 1)
LAYOUT_DECLARE(model_numbers, MODEL_FIELDS, estimator_sizes)

/* View of a model record: its sizes, its numbers, and its flows. */
typedef struct {
    estimator_sizes s;
    flow design_flow, gap_flow, bank_flows[ALTERNATIVES];
    alternative_model hypotheses[ALTERNATIVES];
    MODEL_FIELDS(LAYOUT_POINTER, unused)
} model;

/* Bind a view to a model record of so many numbers, which is only read. Return 0, or -1 if its
 * sizes do not belong to a record of this length. */
int model_view(double *memory, size_t length, model *view);

/* Return whether the counts of a state that serve as places are within its fields. */
int state_is_sound(const model *m, const state *at);

/* Return what is remembered of an output, and the filter under a hypothesis (its code - 1). */
static inline sensor sensor_of(const model *m, const state *at, long output)
{
    sensor found;
    sensor_bind(&found, &m->s, at->sensors + (size_t)output * sensor_size(&m->s));
    return found;
}

static inline alternative alternative_of(const model *m, const state *at, long place)
{
    alternative found;
    alternative_bind(&found, &m->s, at->alternatives + (size_t)place * alternative_size(&m->s));
    return found;
}

/* Accept the inputs of a measurement, or hold those before; the state is predicted to the
 * measurement's stamp, and not corrected yet. */
void take_torque(const model *m, state *at, const double *u);

/* Use one measurement, NaN of an output that is missing. */
void correct(const model *m, state *at, const double *y, correction *effect);

/* Predict over a time of at least 0 [s] with held inputs. between_samples: whether the time ends
 * before the next sample and the result is only read. */
void predict(
    const model *m, state *at, const double *u, double duration, int between_samples, work *scratch);

/* Write the estimate and its bounds in physical units. */
void read_out(const model *m, const state *at, readout *said, work *scratch);

/* Write the numbers of a readout one after the other; return how many, `row_width`. */
long write_row(const model *m, const readout *said, double *row);

static inline long row_width(const estimator_sizes *s)
{
    return (long)(2 * s->plant + 5 * s->p + 2 * s->k + 2 * s->t + CONDITIONS);
}

/* Set the estimate and the adaptation to those before any measurement; the rest stays. A state
 * before any measurement at all is a copy of `m->initial`, state_size(&m->s) numbers. */
void restart(const model *m, state *at);

#endif
