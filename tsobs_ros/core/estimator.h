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
 * Fields of n states have rows of `width` numbers: the design's states, and behind them the
 * auxiliary ones: the unknown torque, then parts of the sensors' disturbance, or FORCE's
 * acceleration of a link. Flags are 0 or 1.
 */
#ifndef TSOBS_ESTIMATOR_H
#define TSOBS_ESTIMATOR_H

#include "flow.h"

/* Gains: none, as the observer is integrated, that of Riccati, or the certified one. */
enum { GAIN_OPEN, GAIN_RICCATI, GAIN_CERTIFIED };

/* What the bounds rest on, as `estimation.records.Basis`. */
enum {
    BASIS_CERTIFIED, BASIS_LEARNT, BASIS_COVARIANCE, BASIS_STARTING, BASIS_GAP, BASIS_JUMP,
    BASIS_CONTRADICTED, BASIS_HYPOTHESIS, BASIS_OUTSIDE
};

/* What the learning of parameters does. */
enum { LEARNING_NONE, LEARNING_ACTIVE = 2 };

/* What a hypothesis takes the arm and its sensors for. The standing ones, in this order, are
 * followed by room for forks. */
enum {
    AS_DESIGNED,
    FORCE,          /* an unknown torque, or part of a T-S system's first input */
    IMPERFECT,      /* a model that is wrong in unknown ways */
    LOUD,           /* white noise that is larger than designed */
    COLOURED_NOISE, /* noise that is correlated in time */
    DRIFT,          /* sensors that move away */
    TONE,           /* a sensor that oscillates, at one frequency or two, */
    TONE_RESET,     /* the same, of which nothing is known of the arm before; its kind is TONE */
    STANDING,
    FORKS = 6
};

/* What a fork supposes: an event at its first sample, or otherwise, another kind or other
 * parameters than the best hypothesis has. HIT to STUCK are undecided at first. */
enum { NO_FORK, WRONG_TORQUE, JUMPED, HIT, MOVED, STUCK, OTHERWISE };

/* Outcomes of measurements, in the order of `estimation.records.RejectReason`. */
enum {
    USED,
    NON_FINITE,         /* no output is; the inputs may have been used */
    WRONG_JOINT,
    DUPLICATE,
    TOO_OLD,
    FROM_FUTURE,
    GATED,
    ZERO_STAMP,
    IMPLAUSIBLE_TORQUE, /* of which the outputs were used */
    MISSING_INPUT,      /* of a message that lacks one */
    UNKNOWN_INPUT,      /* one is NaN; the outputs were used */
    OUTCOMES
};

/* The constants of the bank: name, value, and what it is. All others are the design's, or options.
 * docs/estimator.md gives the reason for each, and what half and twice of it do. */
#define BANK_CONSTANTS(C)                                                                      \
    C(FLOOR, 12.0, "how far a standing hypothesis may fall behind the best [nat]")             \
    C(OUTLIER_PRICE, 7.0, "how unlikely an outlier is, by the likeliest sample [nat]")          \
    C(FORK_PRICE, 10.0, "prior of a jump or a hit at an unlikely sample [nat]")                \
    C(LOST_PRICE, 14.0, "prior of an arm that is elsewhere at an unlikely sample [nat]")       \
    C(TORQUE_PRICE, 1.5, "prior of a wrong torque where one stands out [nat]")                 \
    C(SUDDEN, 3.5, "innovation at which sensor or arm may have jumped, motion that a torque "  \
                   "makes when it may be wrong [sigma]")                                       \
    C(TRIAL, 1.0, "age at which the best fork takes its parent's place, and interval of "      \
                  "those without an event [s]")                                                \
    C(NOISE_FACTOR, 16.0, "variance of loud noise, by the design's")                           \
    C(IMPERFECTION, 100.0, "process noise of an imperfect model, by the design's")             \
    C(FORCE_SHARE, 0.02, "1 sigma of the unknown torque, by the reference torque")             \
    C(FORCE_TIME, 1.0, "its correlation time [s]")                                             \
    C(COLOUR_TIME, 0.05, "correlation time of coloured noise [s]")                             \
    C(COLOUR_SIZE, 1.5, "1 sigma of coloured noise, by the sensor's white noise")              \
    C(DRIFT_SIZE, 2.0, "1 sigma of a drift, by the sensor's noise")                           \
    C(DRIFT_TIME, 10.0, "its correlation time [s]")                                            \
    C(TONE_TIME, 200.0, "time in which a tone's size and frequency change [s]")                \
    C(TONE_SIGN, 50.0, "power of an innovation's tone, by white noise's, that proposes one")   \
    C(TONE_RATIO, 1.12, "ratio of neighbouring ones")                                          \
    C(LEAST_SCALE, 0.5, "least measured noise, by the design's; 1 is used then")               \
    C(REJECTING, 0.54, "share of used samples below which a lone filter opens its covariance")  \
    C(PATIENCE, 0.5, "time over which that share is averaged [s]")                             \
    C(SLOW_PRICE, 0.005, "what a sample costs, with slow innovations up to SIGN_SLOW [nat]") \
    C(SIGN_SLOW, 0.7, "power of slow innovations, by white noise's, that wakes the bank")      \
    C(AWAKE, 5.0, "time from the last sign to sleep, and memory of tones [s]")                  \
    C(SLOW_TIME, 0.4, "time constant of slow innovations [s]")                                 \
    C(POWER_TIME, 2.5, "time constant of their power [s]")                                     \
    C(CURVED, 0.5, "share of a learnt distance by which regressors are wrong")                 \
    C(SPRING, 0.2, "1 sigma of a stiffness that nothing shows, by the design's")               \
    C(QUIET, 0.22, "slow power that white noise leaves, by that of all innovations")           \
    C(VOID, 4.0, "power of innovations, by that expected, from which on nothing is claimed")

#define BANK_CONSTANT_NAME(name, value, what) name,
enum { BANK_CONSTANTS(BANK_CONSTANT_NAME) CONSTANTS };

enum { TONES = 26 }; /* frequencies at which tones are looked for */

/* Sizes of an estimator, the first numbers of its model record. */
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
enum { ESTIMATOR_SIZES = sizeof(estimator_sizes) / sizeof(int64_t) };

/* Return whether some numbers are sizes that belong together. */
int sizes_are_sound(const int64_t *numbers);

/* What is remembered of one output. */
#define SENSOR_FIELDS(F, s)                                                               \
    F(NUMBER, noise_scale, 1, 1) /* size of the white noise, by the design's */           \
    F(NUMBER, scale_age, 1, 1)   /* time it has been learnt for [s] */                    \
    F(NUMBER, previous, 1, 1)    /* the innovation before, */                             \
    F(COUNT, paired, 1, 1)       /* and its kind */                                       \
    F(NUMBER, since, 1, 1)       /* time since the last sample [s] */                     \
    F(MATRIX, tones, TONES, 2)   /* the innovations' cosine and sine of each frequency, */ \
    F(NUMBER, recent, 1, 1)      /* less the sum of the newest ones, */                   \
    F(NUMBER, recent_time, 1, 1) /* the time of these [s], */                             \
    F(NUMBER, recent_counted, 1, 1) /* and how much of it counts [s] */                   \
    F(NUMBER, value, 1, 1)       /* latest sample, NaN before the first */                \
    F(NUMBER, motion, 1, 1)      /* less the value before, */                             \
    F(NUMBER, step, 1, 1)        /* step of the sensor, 0 before the first, */            \
    F(NUMBER, rough, 1, 1)       /* and of its innovations' differences */                \
    F(NUMBER, before, 1, 1)      /* innovation of the sample before */                    \
    F(NUMBER, nearest, 1, 1)     /* least size of an innovation of the value */           \
    F(COUNT, repeats, 1, 1)      /* repetitions of the value that count */                \
    F(COUNT, gated, 1, 1)        /* counts of samples that were not used, */              \
    F(COUNT, missing, 1, 1)      /* and of samples without this output */
LAYOUT_DECLARE(sensor, SENSOR_FIELDS, estimator_sizes)

/* A hypothesis: a filter and a weight. Of innovations, squares are in sigmas. */
#define HYPOTHESIS_FIELDS(F, s)                                                       \
    F(COUNT, live, 1, 1)         /* whether it is considered */                       \
    F(COUNT, kind, 1, 1)         /* what it takes arm and sensors for, */             \
    F(COUNT, fork, 1, 1)         /* and what it supposes to have happened */          \
    F(NUMBER, score, 1, 1)       /* logarithm of its weight, by the best one's */     \
    F(NUMBER, age, 1, 1)         /* time since it began [s] */                        \
    F(NUMBER, settling, 1, 1)    /* least time with Riccati gains left [s] */         \
    F(COUNT, certified, 1, 1)    /* whether the certificate's gain and bound serve */ \
    F(COUNT, cause, 1, 1)        /* basis of the bounds while they do not */          \
    F(COUNT, corrected, 1, 1)    /* whether a sample was used since a prediction */   \
    F(VECTOR, x, s->width, 1)    /* estimate in design coordinates */                 \
    F(MATRIX, covariance, s->width, s->width) /* of its error */                      \
    F(NUMBER, inlier, 1, 1)      /* average of whether samples are used */            \
    F(VECTOR, previous, s->p, 1) /* the innovations before */                         \
    F(NUMBER, nis, 1, 1)         /* average of innovations' squares */                \
    F(NUMBER, colour, 1, 1)      /* average of products of neighbouring ones */       \
    F(VECTOR, slow, s->p, 1)     /* innovations, low-passed, */                       \
    F(NUMBER, slow_power, 1, 1)  /* their power, by white noise's, over seconds, */   \
    F(NUMBER, lasting, 1, 1)     /* and over longer, without its peaks */             \
    F(VECTOR, theta, s->k, 1)    /* parameters */                                     \
    F(MATRIX, gamma, s->k, s->k) /* covariance of their errors */                     \
    F(MATRIX, sensitivity, s->k, s->width) /* dx/dtheta, by rows */                   \
    F(MATRIX, gram, s->k, s->k)  /* measure of excitation */                          \
    F(NUMBER, noise_share, 1, 1) /* 1 sigma of what noise made of them, by the first */ \
    F(VECTOR, pending, s->k, 1)  /* change of theta that is not used yet */           \
    F(COUNT, significant, 1, 1)  /* whether changes are used at once */               \
    F(VECTOR, anchor, s->k, 1)   /* theta when the present pass began, */             \
    F(NUMBER, pass_age, 1, 1)    /* and time since then [s] */                        \
    F(NUMBER, size, 1, 1)        /* 1 sigma of a tone, or a drift's by the noise's, */ \
    F(COUNT, output, 1, 1)       /* and the output with the tone */
LAYOUT_DECLARE(hypothesis, HYPOTHESIS_FIELDS, estimator_sizes)

/* All that an estimator remembers. A torque that is late at an arm's motor is held only then. */
#define STATE_FIELDS(F, s)                                                                     \
    F(COUNT, stamp, 1, 1)          /* of the newest sample [ns] */                             \
    F(VECTOR, y, s->p, 1)          /* outputs in it, NaN if missing */                         \
    F(VECTOR, sample, s->p, 1)     /* newest sample of each output */                          \
    F(VECTOR, u, s->m, 1)          /* inputs in it */                                          \
    F(VECTOR, held, s->m, 1)       /* inputs in use, plausible ones */                         \
    F(MATRIX, past, s->past, 2)    /* torques on their way and their ages [s], newest first */ \
    F(NUMBER, torque_before, 1, 1) /* held before those in use */                              \
    F(NUMBER, torque_quiet, 1, 1)  /* time since one stood out from both its neighbours [s] */ \
    F(NUMBER, torque_age, 1, 1)    /* since the newest plausible torque [s] */                 \
    F(COUNT, torque_unknown, 1, 1) /* whether that is not the newest sample's */               \
    F(COUNT, late, 1, 1)           /* whether the next sample was due when this is read */     \
    F(COUNT, in_gap, 1, 1)         /* whether the torque is an auxiliary state */              \
    F(COUNT, best, 1, 1)           /* place of the likeliest hypothesis */                     \
    F(NUMBER, awake, 1, 1)         /* time for which all are considered [s] */                 \
    F(MATRIX, sensors, s->p, sensor_size(s)) /* of the outputs */                              \
    F(NUMBER, noise_scale, 1, 1)   /* largest of theirs */                                     \
    F(NUMBER, since, 1, 1)         /* time since the last sample [s] */                        \
    F(NUMBER, age, 1, 1)           /* time since the start [s] */                              \
    F(VECTOR, centre, s->plant, 1) /* mean of the plant's states over some seconds */          \
    F(VECTOR, spread, s->plant, 1) /* their variance */                                        \
    F(VECTOR, noise, s->plant, 1)  /* and that of the estimate's noise in it */                \
    F(NUMBER, stillness, 1, 1)     /* least noise / spread of a state, 1 at rest */            \
    F(COUNT, outliers, 1, 1)       /* counts of what was found */                              \
    F(COUNT, jumps, 1, 1)                                                                      \
    F(COUNT, hits, 1, 1)                                                                       \
    F(COUNT, losses, 1, 1)                                                                     \
    F(COUNT, wrong_torques, 1, 1)                                                              \
    F(COUNTS, judged, OUTCOMES, 1) /* counts of samples by outcome, of those judged here */    \
    F(COUNT, restarts, 1, 1)       /* counts of new starts after gaps and failures */          \
    F(COUNT, failures, 1, 1)       /* counts of numbers that were not finite */                \
    F(MATRIX, hypotheses, s->hypotheses, hypothesis_size(s)) /* zeros where there is none */
LAYOUT_DECLARE(state, STATE_FIELDS, estimator_sizes)

/* An output's sample as a hypothesis expects it: the innovation, the variance of what the filter
 * knows of it and, by the parameters, of all, the logarithm of the likelihood, and whether it is
 * used, as it is there, no outlier's, and no stuck sensor's. */
typedef struct {
    double innovation, known, variance, likelihood;
    int64_t used;
} outlook;
enum { OUTLOOK_SIZE = sizeof(outlook) / sizeof(double) };

/* A sample as the likeliest hypothesis expects it; and as scratch of the step that one after the
 * other does, at the end the likeliest. */
#define CORRECTION_FIELDS(F, s)                                                           \
    F(VECTOR, innovation, s->p, 1)                                                        \
    F(MATRIX, innovation_covariance, s->p, s->p)                                          \
    F(COUNTS, present, s->p, 1) /* whether a sample is there, and no stuck sensor's */      \
    F(MATRIX, outlooks, s->p, OUTLOOK_SIZE)                                               \
    F(MATRIX, crossed, s->p, s->width) /* covariance of innovations with the states */    \
    F(VECTOR, row, s->width, 1)  /* an output, by the states, */                          \
    F(VECTOR, gain, s->width, 1) /* and its gain */                                       \
    F(MATRIX, omega, s->p, s->k) /* dy/dtheta */                                          \
    F(VECTOR, cross, s->k, 1)                                                             \
    F(VECTOR, scaled, s->k, 1)                                                            \
    F(MATRIX, root, s->k, s->k)
LAYOUT_DECLARE(correction, CORRECTION_FIELDS, estimator_sizes)

/* An estimate in physical units, a row of doubles. Bounds are 1 sigma. */
#define ESTIMATE_FIELDS(F, s)                                                           \
    F(VECTOR, state, s->plant, 1)                                                       \
    F(VECTOR, state_bound, s->plant, 1)                                                 \
    F(VECTOR, disturbance, s->p, 1) /* of each output */                                \
    F(VECTOR, disturbance_rate, s->p, 1)                                                \
    F(VECTOR, disturbance_bound, s->p, 1)                                               \
    F(VECTOR, parameters, s->k, 1)                                                      \
    F(VECTOR, parameter_bound, s->k, 1)                                                 \
    F(VECTOR, torque_disturbance, s->t, 1)                                              \
    F(VECTOR, torque_disturbance_bound, s->t, 1)                                        \
    F(NUMBER, basis, 1, 1)          /* BASIS_... */                                     \
    F(NUMBER, claimed, 1, 1)        /* whether the bounds are claimed to hold */        \
    F(NUMBER, parameters_valid, 1, 1) /* whether the motion was rich enough for them */ \
    F(NUMBER, noise_scale, 1, 1)    /* of the sensors, by the design's */               \
    F(NUMBER, coloured_power, 1, 1) /* of neighbouring innovations */                   \
    F(NUMBER, learning, 1, 1)       /* LEARNING_... */                                  \
    F(NUMBER, hypothesis, 1, 1)     /* AS_DESIGNED, FORCE and so on */                  \
    F(NUMBER, in_domain, 1, 1)      /* of the certificate; 1 if none is known */        \
    F(NUMBER, age, 1, 1)            /* time since the newest sample before it [s] */
LAYOUT_DECLARE(estimate, ESTIMATE_FIELDS, estimator_sizes)

/* Scratch of a prediction or a readout. */
#define WORK_FIELDS(F, s)                            \
    F(VECTOR, flow, s->scratch, 1)                   \
    F(MATRIX, map, s->width, s->width)               \
    F(VECTOR, added, s->width, 1)                    \
    F(MATRIX, half, s->width, s->width)              \
    F(VECTOR, moved, s->width, 1)                    \
    F(VECTOR, inputs, s->m + 2 * s->p, 1)            \
    F(MATRIX, small, s->k, s->k)                     \
    F(VECTOR, functional, s->width, 1)               \
    F(COUNTS, places, s->hypotheses, 1)              \
    F(VECTOR, weights, s->hypotheses, 1)             \
    F(VECTOR, decided, s->hypotheses, 1)             \
    F(MATRIX, growth, s->hypotheses, 2)
LAYOUT_DECLARE(work, WORK_FIELDS, estimator_sizes)

/* A model; from `scale` on in physical units. */
#define MODEL_FIELDS(F, s)                                                                        \
    F(COUNTS, sizes, ESTIMATOR_SIZES, 1) /* estimator_sizes */                                    \
    F(VECTOR, flow, s->flow_size, 1) /* prediction model */                                       \
    F(VECTOR, initial, state_size(s), 1) /* state before any sample */                            \
    F(VECTOR, constants, CONSTANTS, 1) /* of the bank */                                          \
    F(NUMBER, period, 1, 1)          /* nominal time between samples [s], */                      \
    F(NUMBER, shortest, 1, 1)        /* and of a regular step, least */                           \
    F(NUMBER, longest, 1, 1)         /* and most */                                               \
    F(NUMBER, late_factor, 1, 1)     /* of the certified bound for a period more */               \
    F(NUMBER, torque_rate, 1, 1)     /* 1 sigma of an unknown torque's [N m/s], 0: it is held */  \
    F(NUMBER, torque_limit, 1, 1)    /* of plausible torques [N m] */                             \
    F(NUMBER, torque_rate_limit, 1, 1) /* of theirs [N m/s] */                                    \
    F(NUMBER, torque_spread, 1, 1)   /* 1 sigma of a torque of which nothing is known */          \
    F(NUMBER, torque_gain, 1, 1)     /* of the torque at an arm's motor, */                       \
    F(NUMBER, torque_offset, 1, 1)   /* gain u(t - delay) + offset [N m], */                      \
    F(NUMBER, torque_delay, 1, 1)    /* [s] */                                                    \
    F(NUMBER, force, 1, 1)           /* 1 sigma of an unknown one [N m], 0: none is considered, */ \
    F(COUNT, at_link, 1, 1)          /* unless at an arm's link, as an acceleration [rad/s^2] */  \
    F(VECTOR, modes, 2, 1)           /* frequencies of an arm's own motion [rad/s] */             \
    F(COUNT, gain_mode, 1, 1)        /* GAIN_... */                                               \
    F(MATRIX, C, s->p, s->width)     /* states to outputs */                                      \
    F(MATRIX, D, s->p, s->p)         /* samples to expected outputs */                            \
    F(MATRIX, R, s->p, s->p)         /* covariance of a sample */                                 \
    F(MATRIX, K, s->width, s->p)     /* certified gain */                                         \
    F(MATRIX, X, s->width, s->width) /* its bound before a sample, */                             \
    F(MATRIX, P, s->width, s->width) /* the inverse of that, */                                   \
    F(MATRIX, posterior, s->width, s->width) /* and the bound after a sample */                   \
    F(MATRIX, innovation_covariance, s->p, s->p)                                                  \
    F(VECTOR, scale, s->plant, 1)    /* physical units of the plant's states */                   \
    F(MATRIX, disturbance_map, s->p, s->width) /* states to disturbances, */                      \
    F(MATRIX, disturbance_direct, s->p, s->p) /* and samples to these */                          \
    F(MATRIX, rate_map, s->p, s->width) /* states to rates of disturbances */                     \
    F(MATRIX, torque_map, s->t, s->width) /* states to unknown torques */                         \
    F(COUNTS, disturbed, s->p, 1)    /* whether outputs have a disturbance */                     \
    F(VECTOR, state_std, s->width, 1) /* certified 1 sigma */                                     \
    F(VECTOR, disturbance_std, s->p, 1)                                                           \
    F(VECTOR, torque_std, s->t, 1)                                                                \
    F(VECTOR, domain, s->plant, 1)   /* 1 sigma where nothing is known */                         \
    F(COUNTS, hidden, s->plant, 1)   /* whether states of an arm are shown by its spring only */  \
    F(VECTOR, limits, s->k, 1)       /* of the parameters */                                      \
    F(VECTOR, theta_deviation, s->k, 1) /* 1 sigma of them beforehand */                          \
    F(NUMBER, random_walk, 1, 1)     /* growth of their variance [1/s] */                         \
    F(NUMBER, significance, 1, 1)    /* square from which on a change is used */                  \
    F(NUMBER, pass_time, 1, 1)       /* after which a pass is over [s] */                         \
    F(NUMBER, memory, 1, 1)          /* time constant of excitation [s] */                        \
    F(NUMBER, excitation, 1, 1)      /* from which on parameters count */                         \
    F(COUNT, covered, 1, 1)          /* whether the certificate covers them */                    \
    F(COUNT, supervised, 1, 1)       /* whether there are other hypotheses */                     \
    F(NUMBER, gate, 1, 1)            /* sigmas of an outlier */                                   \
    F(COUNT, stuck_samples, 1, 1)    /* repetitions of a stuck sensor */                          \
    F(VECTOR, disturbance_limit, s->p, 1) /* beyond which no jump is supposed */
LAYOUT_DECLARE(model_numbers, MODEL_FIELDS, estimator_sizes)

/* View of a model record: its sizes, its numbers, and its flow. */
typedef struct {
    estimator_sizes s;
    flow design_flow;
    MODEL_FIELDS(LAYOUT_POINTER, unused)
} model;

/* Bind a view to a model record of so many numbers, which is only read. Return NULL, or what is
 * wrong with its sizes. */
const char *model_view(double *memory, size_t length, model *view);

/* Copy the numbers of a state onto another state's; those of no hypothesis are not touched. */
void copy_state(const model *m, const double *from, double *to);

/* Return how the hypothesis at hand expects an output. */
static inline outlook *outlook_of(const correction *effect, long output)
{
    return (outlook *)(void *)effect->outlooks + output;
}

/* Return what is remembered of an output, and a hypothesis. */
static inline sensor sensor_of(const model *m, const state *at, long output)
{
    return sensor_view(&m->s, at->sensors + (size_t)output * sensor_size(&m->s));
}

static inline hypothesis hypothesis_of(const model *m, const state *at, long place)
{
    return hypothesis_view(&m->s, at->hypotheses + (size_t)place * hypothesis_size(&m->s));
}

/* Find the first live hypothesis from a place on, and move the place there; return whether there is
 * one. */
static inline int find_live(const model *m, const state *at, long *place, hypothesis *h)
{
    while (*place < m->s.hypotheses && *hypothesis_of(m, at, *place).live == 0) {
        *place += 1;
    }
    if (*place < m->s.hypotheses) {
        *h = hypothesis_of(m, at, *place);
    }
    return *place < m->s.hypotheses;
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
int read_out(const model *m, const state *at, const estimate *row, work *scratch);

/* A log of samples: time from each to the next [s], negative where the next one starts, (n,);
 * outputs, NaN if missing, (n, p); and inputs held until the next sample, (n, m). */
typedef struct {
    int64_t count;
    const double *durations, *y, *u;
} sample_log;

/* What a plain Kalman filter knows beside the model: Coulomb friction as the deceleration of link
 * and motor, in design coordinates [1/s^2], and the sigmas beyond which an output is left out. */
typedef struct {
    double link_friction, motor_friction, gate;
} filter_options;

/* Filter a log in the memory of a state, without supervision: the likelihood of its innovations is
 * that of the model, which identification maximises. Write y - C x of each output given those
 * before it, and its variance, NaN of an output that is missing, (n, p) each; and the states before
 * each sample, (n, n). From `corrected_until` on the filter runs free, and innovations are those of
 * a simulation. */
void write_innovations(
    const model *m, state *at, const sample_log *log, const filter_options *options,
    int64_t corrected_until, double *innovations, double *variances, double *states,
    correction *effect, work *scratch);

#endif
