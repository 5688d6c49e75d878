/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The estimator: a bank of hypotheses, each a filter and a weight.
 *
 *     correct:  x <- x + K (y - C x)        predict:  x <- flow(x, u, T)
 *
 * All hypotheses are stepped by the same code and differ in numbers only. The weights follow Bayes'
 * rule; what is published is the mixture. docs/estimator.md explains it.
 *
 * A model record begins with its sizes, see `estimator_sizes`, so that `model_view` needs no other
 * arguments. Fields of n states have rows of `width` numbers: the design's states, and behind them
 * the auxiliary ones, first the unknown torque, then parts of the sensors' disturbance. Flags are 0
 * or 1.
 */
#ifndef TSOBS_ESTIMATOR_H
#define TSOBS_ESTIMATOR_H

#include "flow.h"
#include "layout.h"

/* Gains: none, as the observer is integrated, that of Riccati, or the certified one. */
enum { GAIN_OPEN, GAIN_RICCATI, GAIN_CERTIFIED };

/* What the bounds rest on. */
enum {
    BASIS_CERTIFIED,
    BASIS_LEARNT,
    BASIS_COVARIANCE,
    BASIS_STARTING,
    BASIS_GAP,
    BASIS_JUMP,
    BASIS_CONTRADICTED,
    BASIS_HYPOTHESIS,
    BASIS_OUTSIDE
};

/* What the learning of parameters does. */
enum { LEARNING_NONE, LEARNING_STARTING, LEARNING_ACTIVE };

/* What a hypothesis takes the arm and its sensors for. The standing ones, in this order, are
 * followed by room for forks. */
enum {
    AS_DESIGNED,
    FORCE,          /* an unknown torque at the motor */
    IMPERFECT,      /* a model that is wrong in ways that it does not say */
    LOUD,           /* white noise that is larger than designed */
    COLOURED_NOISE, /* noise that is alike from sample to sample */
    DRIFT,          /* sensors that move away */
    TONE,           /* a sensor that oscillates */
    STANDING,
    FORKS = 6
};

/* What a fork supposes to have happened at its first sample. */
enum { NO_FORK, JUMPED, HIT, MOVED };

/* The constants of the bank: name, value, and what it is. All others are the design's, or options.
 * docs/estimator.md gives the reason for each, and what half and twice of it do. */
#define BANK_CONSTANTS(C)                                                                      \
    C(FLOOR, 12.0, "how far a standing hypothesis may fall behind the best [nat]")             \
    C(OUTLIER_PRICE, 7.0, "how unlikely an outlier is, by the likeliest sample [nat]")          \
    C(FORK_PRICE, 10.0, "prior of a jump or a hit at an outlier [nat]")                        \
    C(LOST_PRICE, 14.0, "prior of an arm that is elsewhere at an outlier [nat]")               \
    C(SUDDEN, 3.5, "innovation at which a sensor may have jumped [sigma]")                     \
    C(TRIAL, 1.0, "age at which the best fork takes its parent's place [s]")                   \
    C(NOISE_FACTOR, 16.0, "variance of loud noise, by the design's")                           \
    C(IMPERFECTION, 100.0, "process noise of an imperfect model, by the design's")             \
    C(FORCE_SHARE, 0.03, "1 sigma of the unknown torque, by the reference torque")             \
    C(FORCE_TIME, 1.0, "its correlation time [s]")                                             \
    C(COLOUR_TIME, 0.05, "correlation time of coloured noise [s]")                             \
    C(COLOUR_SIZE, 1.5, "1 sigma of coloured noise, by the sensor's white noise")              \
    C(DRIFT_SIZE, 2.0, "1 sigma of a drift, by the sensor's noise")                           \
    C(DRIFT_TIME, 10.0, "its correlation time [s]")                                            \
    C(TONE_TIME, 20.0, "time for which a tone keeps its phase [s]")                            \
    C(TONE_SIGN, 50.0, "power of an innovation's tone, by white noise's, that proposes one")   \
    C(FIRST_TONE, 0.8, "lowest frequency at which tones are looked for [rad/s]")               \
    C(TONE_RATIO, 1.25, "ratio of neighbouring ones")                                          \
    C(LEAST_SCALE, 0.5, "least measured noise, by the design's; 1 is used then")               \
    C(REJECTING, 0.54, "share of used samples below which a lone filter opens its covariance")  \
    C(PATIENCE, 0.5, "time over which that share is averaged [s]")                             \
    C(SIGN_SLOW, 0.7, "power of slow innovations, by white noise's, that wakes the bank")      \
    C(AWAKE, 5.0, "time from the last sign to sleep, and memory of tones [s]")                  \
    C(SLOW_TIME, 0.4, "time constant of slow innovations [s]")                                 \
    C(POWER_TIME, 2.5, "time constant of their power [s]")                                     \
    C(MOVING, 6.0, "motion, by bounds, from which on parameters are learnt")                   \
    C(CURVED, 0.3, "share of a learnt distance by which regressors are wrong")                 \
    C(QUIET, 0.22, "slow power that white noise leaves, by that of all innovations")           \
    C(VOID, 4.0, "power of innovations, by that expected, from which on nothing is claimed")

#define BANK_CONSTANT_NAME(name, value, what) name,
enum { BANK_CONSTANTS(BANK_CONSTANT_NAME) CONSTANTS };

enum { TONES = 13 }; /* frequencies at which innovations are listened to */

/* Sizes of an estimator, the first numbers of its model record, as 64-bit integers. */
#define ESTIMATOR_SIZES 11
typedef struct {
    int64_t n;          /* augmented states of the design */
    int64_t width;      /* these and the auxiliary ones: length of rows */
    int64_t plant;      /* of the plant's own states, the first */
    int64_t p;          /* outputs */
    int64_t m;          /* inputs and scheduled signals */
    int64_t k;          /* learnt parameters */
    int64_t t;          /* torques that are estimated */
    int64_t hypotheses; /* 1, or STANDING + FORKS */
    int64_t past;       /* torques that are remembered, 0 if none is late at the motor */
    int64_t flow_size;  /* numbers of the flow, */
    int64_t scratch;    /* and of the scratch that it needs */
} estimator_sizes;

/* Return the sizes that a model record's first numbers are, and whether they belong together. */
static inline estimator_sizes sizes_of(const int64_t *numbers)
{
    const estimator_sizes s = {numbers[0], numbers[1], numbers[2], numbers[3], numbers[4],
                               numbers[5], numbers[6], numbers[7], numbers[8], numbers[9],
                               numbers[10]};
    return s;
}
int sizes_are_sound(const int64_t *numbers);

/* What is remembered of one output.
 *
 * noise_scale: size of the white noise relative to the design's; scale_age: time it has been learnt
 * for [s]; previous, paired: the innovation before and its kind; since: time since the last sample
 * [s]. tones: what the design's innovations have of each frequency, cosine and sine. pull: sum of
 * the innovations since the value repeats.
 *
 * Of repeats: value: the latest one, NaN before the first. step, rough: of the sensor, and of the
 * differences of its innovations, 0 before the first difference. before: innovation of the sample
 * before. nearest: least |y - C x| of the value. repeats: repetitions that count. Then counts. */
#define SENSOR_FIELDS(F, s)           \
    F(NUMBER, noise_scale, 1, 1)      \
    F(NUMBER, scale_age, 1, 1)        \
    F(NUMBER, previous, 1, 1)         \
    F(COUNT, paired, 1, 1)            \
    F(NUMBER, since, 1, 1)            \
    F(MATRIX, tones, TONES, 2)        \
    F(NUMBER, pull, 1, 1)             \
    F(NUMBER, value, 1, 1)            \
    F(NUMBER, step, 1, 1)             \
    F(NUMBER, rough, 1, 1)            \
    F(NUMBER, before, 1, 1)           \
    F(NUMBER, nearest, 1, 1)          \
    F(COUNT, repeats, 1, 1)           \
    F(COUNT, gated, 1, 1)             \
    F(COUNT, missing, 1, 1)
LAYOUT_DECLARE(sensor, SENSOR_FIELDS, estimator_sizes)

/* A hypothesis: a filter and a weight.
 *
 * live: whether it is considered. kind, fork: what it supposes. score: logarithm of its weight
 * relative to the best. age: time since it began [s]; settling: least time with Riccati gains left
 * [s]. certified: whether the certified gain serves, and the covariance is the certificate's bound;
 * cause: basis of the bounds while it is not. corrected: whether a sample was used since the last
 * prediction. x, covariance: estimate in design coordinates, and of its error.
 *
 * inlier: average of whether samples are used. previous, nis, colour, slow, slow_power: of the
 * innovations in sigmas, the one before, averages of their squares and of the products of
 * neighbours over a second, low-passed, and the power of that relative to white noise's.
 *
 * theta, gamma, upsilon (by rows), gram, learning: of the parameters, and the time they have been
 * learnt for [s]. pending: change of theta that is used once it is significant. anchor, pass_age
 * [s], passes: where the present pass of learning began, how long it takes.
 *
 * frequency [rad/s], size, output: of a tone. */
#define HYPOTHESIS_FIELDS(F, s)               \
    F(COUNT, live, 1, 1)                      \
    F(COUNT, kind, 1, 1)                      \
    F(COUNT, fork, 1, 1)                      \
    F(NUMBER, score, 1, 1)                    \
    F(NUMBER, age, 1, 1)                      \
    F(NUMBER, settling, 1, 1)                 \
    F(COUNT, certified, 1, 1)                 \
    F(COUNT, cause, 1, 1)                     \
    F(COUNT, corrected, 1, 1)                 \
    F(VECTOR, x, s->width, 1)                 \
    F(MATRIX, covariance, s->width, s->width) \
    F(NUMBER, inlier, 1, 1)                   \
    F(VECTOR, previous, s->p, 1)              \
    F(NUMBER, nis, 1, 1)                      \
    F(NUMBER, colour, 1, 1)                   \
    F(VECTOR, slow, s->p, 1)                  \
    F(NUMBER, slow_power, 1, 1)               \
    F(VECTOR, theta, s->k, 1)                 \
    F(MATRIX, gamma, s->k, s->k)              \
    F(MATRIX, upsilon, s->k, s->width)        \
    F(MATRIX, gram, s->k, s->k)               \
    F(NUMBER, learning, 1, 1)                 \
    F(VECTOR, pending, s->k, 1)               \
    F(COUNT, significant, 1, 1)               \
    F(VECTOR, anchor, s->k, 1)                \
    F(NUMBER, pass_age, 1, 1)                 \
    F(NUMBER, frequency, 1, 1)                \
    F(NUMBER, size, 1, 1)                     \
    F(COUNT, output, 1, 1)
LAYOUT_DECLARE(hypothesis, HYPOTHESIS_FIELDS, estimator_sizes)

/* All that an estimator remembers.
 *
 * stamp, y, u: of the newest sample [ns], a missing output is NaN. sample: the newest of each
 * output. held: inputs in use, those of the newest sample with plausible ones, of an arm the torque
 * at the motor over the coming period. past: torques on their way there, the newest first, each with
 * the time since it was commanded [s], which is infinite before the first. torque_age: time since the
 * newest plausible torque [s]; torque_unknown: whether that is not the newest sample's. late: whether
 * it is read after the stamp at which the next sample was due.
 *
 * hypotheses: the filters, zeros where there is none. best: place of the likeliest. awake: time for which all are considered
 * [s]. sensors: of the outputs. noise_scale: the largest of theirs. since: time since the last
 * sample [s]. centre, spread: mean and variance of the plant's states over some seconds. The others
 * are counts. */
#define STATE_FIELDS(F, s)                                \
    F(COUNT, stamp, 1, 1)                                 \
    F(VECTOR, y, s->p, 1)                                 \
    F(VECTOR, sample, s->p, 1)                            \
    F(VECTOR, u, s->m, 1)                                 \
    F(VECTOR, held, s->m, 1)                              \
    F(MATRIX, past, s->past, 2)                           \
    F(NUMBER, torque_age, 1, 1)                           \
    F(COUNT, torque_unknown, 1, 1)                        \
    F(COUNT, late, 1, 1)                                  \
    F(COUNT, in_gap, 1, 1)                                \
    F(COUNT, best, 1, 1)                                  \
    F(NUMBER, awake, 1, 1)                                \
    F(MATRIX, sensors, s->p, sensor_size(s))              \
    F(NUMBER, noise_scale, 1, 1)                          \
    F(NUMBER, since, 1, 1)                                \
    F(NUMBER, age, 1, 1)                                  \
    F(VECTOR, centre, s->plant, 1)                        \
    F(VECTOR, spread, s->plant, 1)                        \
    F(COUNT, moving, 1, 1)                                \
    F(COUNT, outliers, 1, 1)                              \
    F(COUNT, jumps, 1, 1)                                 \
    F(COUNT, hits, 1, 1)                                  \
    F(COUNT, losses, 1, 1)                                \
    F(COUNT, gated, 1, 1)                                 \
    F(COUNT, implausible, 1, 1)                           \
    F(COUNT, unknown_inputs, 1, 1)                        \
    F(COUNT, restarts, 1, 1)                              \
    F(COUNT, failures, 1, 1)                              \
    F(MATRIX, hypotheses, s->hypotheses, hypothesis_size(s))
LAYOUT_DECLARE(state, STATE_FIELDS, estimator_sizes)

/* A sample's effect on the likeliest hypothesis, and behind `weight` scratch of the same step. The
 * gain has a row of p numbers for each state. */
#define CORRECTION_FIELDS(F, s)             \
    F(VECTOR, innovation, s->p, 1)          \
    F(MATRIX, innovation_covariance, s->p, s->p) \
    F(MATRIX, gain, s->width, s->p)         \
    F(VECTOR, weight, s->p, 1)              \
    F(VECTOR, innovations, s->p, 1)         \
    F(VECTOR, variances, s->p, 1)           \
    F(VECTOR, likelihoods, s->p, 1)         \
    F(COUNTS, used, s->p, 1)                \
    F(VECTOR, crossed, s->width, 1)         \
    F(MATRIX, omega, s->p, s->k)            \
    F(VECTOR, cross, s->k, 1)               \
    F(VECTOR, scaled, s->k, 1)              \
    F(MATRIX, root, s->k, s->k)
LAYOUT_DECLARE(correction, CORRECTION_FIELDS, estimator_sizes)

/* An estimate in physical units, a row of doubles. Bounds are 1 sigma.
 *
 * basis: BASIS_...; claimed: whether the bounds are claimed to hold; learning: LEARNING_...;
 * hypothesis: what the arm and its sensors are taken for, AS_DESIGNED, FORCE and so on; in_domain:
 * whether the state is in the certificate's domain, 1 where no domain is known; age: time since the
 * newest sample before it [s]. */
#define ESTIMATE_FIELDS(F, s)                    \
    F(VECTOR, state, s->plant, 1)                \
    F(VECTOR, state_bound, s->plant, 1)          \
    F(VECTOR, disturbance, s->p, 1)              \
    F(VECTOR, disturbance_rate, s->p, 1)         \
    F(VECTOR, disturbance_bound, s->p, 1)        \
    F(VECTOR, parameters, s->k, 1)               \
    F(VECTOR, parameter_bound, s->k, 1)          \
    F(VECTOR, torque_disturbance, s->t, 1)       \
    F(VECTOR, torque_disturbance_bound, s->t, 1) \
    F(NUMBER, basis, 1, 1)                       \
    F(NUMBER, claimed, 1, 1)                     \
    F(NUMBER, parameters_valid, 1, 1)            \
    F(NUMBER, noise_scale, 1, 1)                 \
    F(NUMBER, coloured_power, 1, 1)              \
    F(NUMBER, learning, 1, 1)                    \
    F(NUMBER, hypothesis, 1, 1)                  \
    F(NUMBER, in_domain, 1, 1)                   \
    F(NUMBER, age, 1, 1)
LAYOUT_DECLARE(estimate, ESTIMATE_FIELDS, estimator_sizes)

/* Scratch of a prediction or a readout. */
#define WORK_FIELDS(F, s)                            \
    F(VECTOR, flow, s->scratch, 1)                   \
    F(MATRIX, square, s->width, s->width)            \
    F(MATRIX, tangents, s->width - s->n + 1, s->n)   \
    F(VECTOR, drives, s->width - s->n + 1, 1)        \
    F(VECTOR, inputs, s->m, 1)                       \
    F(MATRIX, small, s->k, s->k)                     \
    F(VECTOR, share, s->k, 1)                        \
    F(VECTOR, functional, s->width, 1)               \
    F(VECTOR, weights, s->hypotheses, 1)
LAYOUT_DECLARE(work, WORK_FIELDS, estimator_sizes)

/* A model: sizes, flow, the initial state, output, gains, bounds and options.
 *
 * period to longest: of samples [s]. late_factor: of the certificate's bound for a period after the
 * next sample was due. torque_rate: 1 sigma of the rate of a torque that is unknown [N m/s], 0 if
 * it is held. torque_limit, torque_rate_limit: of plausible torques; torque_spread: 1 sigma of a
 * torque of which nothing is known. torque_gain to torque_delay: of the torque at an arm's motor,
 * gain u(t - delay) + offset [-], [N m], [s]. force: 1 sigma of an unknown
 * force, 0 without a hypothesis of one. C to innovation_covariance: outputs and gains, in physical
 * units from `scale` on. domain: 1 sigma of the plant's states where nothing is known of them.
 * limits, theta_deviation: of the parameters. stuck_samples: repetitions of a stuck sensor. */
#define MODEL_FIELDS(F, s)                         \
    F(COUNT, n, 1, 1)                              \
    F(COUNT, width, 1, 1)                          \
    F(COUNT, plant, 1, 1)                          \
    F(COUNT, p, 1, 1)                              \
    F(COUNT, m, 1, 1)                              \
    F(COUNT, k, 1, 1)                              \
    F(COUNT, t, 1, 1)                              \
    F(COUNT, hypothesis_count, 1, 1)               \
    F(COUNT, past_count, 1, 1)                     \
    F(COUNT, flow_size, 1, 1)                      \
    F(COUNT, scratch, 1, 1)                        \
    F(VECTOR, flow, s->flow_size, 1)               \
    F(VECTOR, initial, state_size(s), 1)           \
    F(VECTOR, constants, CONSTANTS, 1)             \
    F(NUMBER, period, 1, 1)                        \
    F(NUMBER, shortest, 1, 1)                      \
    F(NUMBER, longest, 1, 1)                       \
    F(NUMBER, late_factor, 1, 1)                   \
    F(NUMBER, torque_rate, 1, 1)                   \
    F(NUMBER, torque_limit, 1, 1)                  \
    F(NUMBER, torque_rate_limit, 1, 1)             \
    F(NUMBER, torque_spread, 1, 1)                 \
    F(NUMBER, torque_gain, 1, 1)                   \
    F(NUMBER, torque_offset, 1, 1)                 \
    F(NUMBER, torque_delay, 1, 1)                  \
    F(NUMBER, force, 1, 1)                         \
    F(COUNT, gain_mode, 1, 1)                      \
    F(MATRIX, C, s->p, s->width)                   \
    F(MATRIX, D, s->p, s->p)                       \
    F(MATRIX, R, s->p, s->p)                       \
    F(MATRIX, K, s->width, s->p)                   \
    F(MATRIX, X, s->width, s->width)               \
    F(MATRIX, P, s->width, s->width)               \
    F(MATRIX, posterior, s->width, s->width)       \
    F(MATRIX, innovation_covariance, s->p, s->p)   \
    F(VECTOR, scale, s->plant, 1)                  \
    F(MATRIX, disturbance_map, s->p, s->width)     \
    F(MATRIX, disturbance_direct, s->p, s->p)      \
    F(MATRIX, rate_map, s->p, s->width)            \
    F(MATRIX, torque_map, s->t, s->width)          \
    F(COUNTS, disturbed, s->p, 1)                  \
    F(VECTOR, state_std, s->width, 1)              \
    F(VECTOR, disturbance_std, s->p, 1)            \
    F(VECTOR, torque_std, s->t, 1)                 \
    F(VECTOR, domain, s->plant, 1)                 \
    F(VECTOR, limits, s->k, 1)                     \
    F(VECTOR, theta_deviation, s->k, 1)            \
    F(NUMBER, random_walk, 1, 1)                   \
    F(NUMBER, significance, 1, 1)                  \
    F(NUMBER, pass_time, 1, 1)                     \
    F(NUMBER, adaptation_start, 1, 1)              \
    F(NUMBER, memory, 1, 1)                        \
    F(NUMBER, excitation, 1, 1)                    \
    F(COUNT, covered, 1, 1)                        \
    F(COUNT, supervised, 1, 1)                     \
    F(NUMBER, gate, 1, 1)                          \
    F(COUNT, stuck_samples, 1, 1)                  \
    F(VECTOR, disturbance_limit, s->p, 1)
LAYOUT_DECLARE(model_numbers, MODEL_FIELDS, estimator_sizes)

/* View of a model record: its sizes, its numbers, and its flow. */
typedef struct {
    estimator_sizes s;
    flow design_flow;
    MODEL_FIELDS(LAYOUT_POINTER, unused)
} model;

/* Bind a view to a model record of so many numbers, which is only read. Return 0, or -1 if its
 * sizes do not belong to a record of this length, or a number in it leads beyond its memory. */
int model_view(double *memory, size_t length, model *view);

/* Copy the numbers of a state onto another state's; those of no hypothesis are not touched. */
void copy_state(const model *m, const double *from, double *to);

/* Return whether the counts of a state that serve as places are within its fields. */
int state_is_sound(const model *m, const state *at);

/* Return what is remembered of an output, and a hypothesis. */
static inline sensor sensor_of(const model *m, const state *at, long output)
{
    sensor found;
    sensor_bind(&found, &m->s, at->sensors + (size_t)output * sensor_size(&m->s));
    return found;
}

static inline hypothesis hypothesis_of(const model *m, const state *at, long place)
{
    hypothesis found;
    hypothesis_bind(&found, &m->s, at->hypotheses + (size_t)place * hypothesis_size(&m->s));
    return found;
}

/* Accept the inputs of a measurement, or hold those before; the state is predicted to the
 * measurement's stamp, and not corrected yet. */
void take_torque(const model *m, state *at, const double *u);

/* Hold inputs from now on, whatever they are. */
void hold_inputs(const model *m, state *at, const double *u);

/* Use one measurement, NaN of an output that is missing. */
void correct(const model *m, state *at, const double *y, correction *effect);

/* Predict over a time of at least 0 [s] with held inputs. between_samples: whether the time ends
 * before the next sample and the result is only read. */
void predict(const model *m, state *at, double duration, int between_samples, work *scratch);

/* Write the estimate and its bounds; return whether all are finite. */
int read_out(const model *m, const state *at, const estimate *said, work *scratch);

#endif
