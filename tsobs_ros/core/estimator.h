/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The estimator: a bank of hypotheses, each with a filter and a weight.
 *
 *     correct:  x <- x + K (y - C x)        predict:  x <- flow(x, u, T)
 *
 * The same code steps all hypotheses; only their numbers differ. The weights follow Bayes' rule,
 * and the published estimate is the weighted mixture. docs/estimator.md explains the theory.
 *
 * A row of states has `width` numbers: the design's n states, then the auxiliary states. The first
 * auxiliary state is the unknown torque. The others are parts of the sensors' disturbance or,
 * for FORCE at a link, the link's acceleration. Flags are 0 or 1.
 */
#ifndef TSOBS_ESTIMATOR_H
#define TSOBS_ESTIMATOR_H

#include "flow.h"

/* Gain of the correction. OPEN: none, as the flow is itself an observer, with samples as inputs. */
enum { GAIN_OPEN, GAIN_RICCATI, GAIN_CERTIFIED };

/* Basis of the bounds, in the order of `estimation.records.Basis`. */
enum {
    BASIS_CERTIFIED, BASIS_LEARNT, BASIS_COVARIANCE, BASIS_STARTING, BASIS_GAP, BASIS_JUMP,
    BASIS_CONTRADICTED, BASIS_HYPOTHESIS, BASIS_OUTSIDE
};

/* State of the parameter learning, as in `estimation.records.Learning`. */
enum { LEARNING_NONE, LEARNING_ACTIVE = 2 };

/* Kinds of hypothesis: assumptions about the arm and its sensors. The standing hypotheses have
 * places in this order, followed by FORKS places for forks. */
enum {
    AS_DESIGNED,
    FORCE,          /* an unknown torque, or an unknown part of a T-S system's first input */
    IMPERFECT,      /* a model that is wrong in unknown ways */
    LOUD,           /* white noise that is larger than designed */
    COLOURED_NOISE, /* noise that is correlated in time */
    DRIFT,          /* sensors that drift away */
    TONE,           /* a sensor that oscillates at one or two frequencies */
    TONE_RESET,     /* a second TONE, which forgets what was learnt since the bank woke; forks of
                     * both take the place of TONE */
    STANDING,
    FORKS = 6
};

/* Assumption of a fork: an event at its first sample or, if OTHERWISE, a kind or parameters that
 * differ from those of the best hypothesis. Forks from HIT to STUCK are undecided at first. */
enum { NO_FORK, WRONG_TORQUE, JUMPED, HIT, MOVED, STUCK, OTHERWISE };

/* Outcomes of measurements, in the order of `estimation.records.RejectReason`. */
enum {
    USED,
    NON_FINITE,         /* no output is finite; the inputs may have been used */
    WRONG_JOINT,
    DUPLICATE,
    TOO_OLD,
    FROM_FUTURE,
    GATED,
    ZERO_STAMP,
    IMPLAUSIBLE_TORQUE, /* only the outputs were used */
    MISSING_INPUT,      /* the message lacks an input */
    UNKNOWN_INPUT,      /* an input is NaN; the outputs were used */
    OUTCOMES
};

/* The constants of the bank: name, value and meaning. Other numbers are the design's, or options.
 * docs/estimator.md gives the reason for each constant, and what half and twice its value do. */
#define BANK_CONSTANTS(C)                                                                         \
    C(FLOOR, 12.0, "how far a standing hypothesis may fall behind the best [nat]")                \
    C(OUTLIER_PRICE, 7.0, "how much less likely an outlier is than the likeliest sample [nat]")   \
    C(FORK_PRICE, 10.0, "prior of a jump or a hit at an unlikely sample [nat]")                   \
    C(LOST_PRICE, 14.0, "prior of an arm that is elsewhere at an unlikely sample [nat]")          \
    C(TORQUE_PRICE, 1.5, "prior of a wrong torque where one stands out [nat]")                    \
    C(SUDDEN, 3.5, "innovation from which a sensor or arm may have jumped, or motion from which " \
                   "a torque may be wrong [sigma]")                                               \
    C(TRIAL, 1.0, "age at which the best fork takes its parent's place, and interval between "    \
                  "forks without an event [s]")                                                   \
    C(NOISE_FACTOR, 16.0, "variance of loud noise, relative to the design's")                     \
    C(IMPERFECTION, 100.0, "process noise of an imperfect model, relative to the design's")       \
    C(FORCE_SHARE, 0.02, "1 sigma of the unknown torque, relative to the reference torque")       \
    C(FORCE_TIME, 1.0, "correlation time of the unknown torque [s]")                              \
    C(COLOUR_TIME, 0.05, "correlation time of coloured noise [s]")                                \
    C(COLOUR_SIZE, 1.5, "first 1 sigma of coloured noise, relative to white noise")               \
    C(DRIFT_SIZE, 2.0, "1 sigma of a drift, relative to the sensor's noise")                      \
    C(DRIFT_TIME, 10.0, "correlation time of a drift [s]")                                        \
    C(TONE_TIME, 200.0, "time in which a tone's size and frequency change [s]")                   \
    C(TONE_SIGN, 50.0, "power of a tone that proposes it, relative to white noise's")             \
    C(TONE_RATIO, 1.12, "ratio of neighbouring frequencies at which tones are looked for")        \
    C(LEAST_SCALE, 0.5, "least measured noise, relative to the design's; filters use at least 1") \
    C(REJECTING, 0.54, "share of used samples below which a lone filter opens its covariance, "   \
                       "and a rival of the best hypothesis begins again")                         \
    C(PATIENCE, 0.5, "averaging time of the share of used samples [s]")                           \
    C(SLOW_PRICE, 0.005, "price of a sample while slow innovations are below SIGN_SLOW [nat]")    \
    C(SIGN_SLOW, 0.7, "power of slow innovations that wakes the bank, relative to white noise's") \
    C(AWAKE, 5.0, "time from the last sign until the bank sleeps, and memory of tones [s]")       \
    C(SLOW_TIME, 0.4, "time constant of slow innovations [s]")                                    \
    C(POWER_TIME, 2.5, "time constant of the power of slow innovations [s]")                      \
    C(CURVED, 0.5, "error of a learnt change of a parameter, relative to the change")             \
    C(SPRING, 0.2, "1 sigma of a stiffness that nothing shows, relative to the design's")         \
    C(QUIET, 0.22, "slow power that white noise leaves, relative to that of all innovations")     \
    C(VOID, 4.0, "multiple of the innovations' expected power above which no bound is claimed")

#define BANK_CONSTANT_NAME(name, value, what) name,
enum { BANK_CONSTANTS(BANK_CONSTANT_NAME) CONSTANTS };

enum { TONES = 26 }; /* number of frequencies at which tones are looked for */

/* Sizes of an estimator, the first numbers of its model record. */
typedef struct {
    int64_t n;          /* augmented states of the design */
    int64_t width;      /* design's and auxiliary states: length of a row of states */
    int64_t plant;      /* the plant's own states, which come first */
    int64_t p;          /* outputs */
    int64_t m;          /* inputs and scheduled signals */
    int64_t k;          /* learnt parameters */
    int64_t t;          /* estimated torques */
    int64_t hypotheses; /* places for hypotheses: 1, or STANDING + FORKS */
    int64_t past;       /* remembered torques, 0 if torques reach the motor at once */
    int64_t flow_size;  /* numbers of the flow */
    int64_t scratch;    /* numbers of the flow's scratch */
} estimator_sizes;
enum { ESTIMATOR_SIZES = sizeof(estimator_sizes) / sizeof(int64_t) };

/* Return whether ESTIMATOR_SIZES numbers are a consistent set of sizes. */
int sizes_are_sound(const int64_t *numbers);

/* Memory of one output. */
#define SENSOR_FIELDS(F, s)                                                                    \
    F(NUMBER, noise_scale, 1, 1)   /* size of the white noise, relative to the design's */     \
    F(NUMBER, scale_age, 1, 1)     /* time for which noise_scale has been learnt [s] */        \
    F(NUMBER, previous, 1, 1)      /* previous innovation, from which noise_scale is learnt */ \
    F(COUNT, paired, 1, 1)         /* kind of `previous`: REGULAR, OUTLIER, or 0 for none */   \
    F(NUMBER, since, 1, 1)         /* time since the output's last sample [s] */               \
    F(NUMBER, interval, 1, 1)      /* time between its last two samples while awake [s] */     \
    F(MATRIX, tones, TONES, 4)     /* phasors of innovations and motion at each frequency */   \
    F(VECTOR, recent, 2, 1)        /* sums of the newest of both, not in `tones` yet */        \
    F(NUMBER, recent_time, 1, 1)   /* time that `recent` spans [s] */                          \
    F(NUMBER, recent_counted, 1, 1) /* part of recent_time that counts in averages [s] */      \
    F(NUMBER, value, 1, 1)         /* latest sample, NaN before the first */                   \
    F(NUMBER, motion, 1, 1)        /* last change of `value` */                                \
    F(NUMBER, step, 1, 1)          /* quantisation step of the sensor, 0 until it is learnt */ \
    F(NUMBER, rough, 1, 1)         /* median difference of successive innovations */           \
    F(NUMBER, before, 1, 1)        /* previous innovation, from which `rough` is learnt */     \
    F(NUMBER, nearest, 1, 1)       /* least size of an innovation since `value` appeared */    \
    F(COUNT, repeats, 1, 1)        /* repetitions of `value` that suggest a stuck sensor */    \
    F(COUNT, gated, 1, 1)          /* number of samples that were not used */                  \
    F(COUNT, missing, 1, 1)        /* number of samples without this output */
LAYOUT_DECLARE(sensor, SENSOR_FIELDS, estimator_sizes)

/* A hypothesis: a filter and a weight. Averages are of innovations divided by their 1 sigma. */
#define HYPOTHESIS_FIELDS(F, s)                                                                    \
    F(COUNT, live, 1, 1)          /* whether there is a hypothesis in this place */                \
    F(COUNT, kind, 1, 1)          /* assumption about arm and sensors: AS_DESIGNED, ... */         \
    F(COUNT, fork, 1, 1)          /* event that it assumes: NO_FORK, WRONG_TORQUE, ... */          \
    F(NUMBER, score, 1, 1)        /* logarithm of its weight, relative to the best one's */        \
    F(NUMBER, age, 1, 1)          /* time since it began [s] */                                    \
    F(NUMBER, settling, 1, 1)     /* least remaining time with Riccati gains [s] */                \
    F(COUNT, certified, 1, 1)     /* whether the certified gain and bound are in use */            \
    F(COUNT, cause, 1, 1)         /* basis of the bounds while not certified: BASIS_... */         \
    F(COUNT, corrected, 1, 1)     /* whether a sample was used since the last prediction */        \
    F(VECTOR, x, s->width, 1)     /* estimate in design coordinates */                             \
    F(MATRIX, covariance, s->width, s->width) /* covariance of the error of x */                   \
    F(NUMBER, inlier, 1, 1)       /* average share of used samples */                              \
    F(VECTOR, previous, s->p, 1)  /* previous innovations */                                       \
    F(NUMBER, nis, 1, 1)          /* average square of innovations */                              \
    F(NUMBER, colour, 1, 1)       /* average product of neighbouring innovations */                \
    F(VECTOR, slow, s->p, 1)      /* low-passed innovations */                                     \
    F(NUMBER, slow_power, 1, 1)   /* power of `slow` over seconds, relative to white noise's */    \
    F(NUMBER, lasting, 1, 1)      /* power of `slow` over longer, with its peaks clipped */        \
    F(VECTOR, theta, s->k, 1)     /* estimate of the parameters */                                 \
    F(MATRIX, gamma, s->k, s->k)  /* covariance of the parameters' errors */                       \
    F(MATRIX, sensitivity, s->k, s->width) /* regressors dx/dtheta, by rows */                     \
    F(MATRIX, gram, s->k, s->k)   /* Gram matrix of dy/dtheta, the measure of excitation */        \
    F(NUMBER, noise_share, 1, 1)  /* 1 sigma of theta's error by noise, relative to the prior's */ \
    F(VECTOR, pending, s->k, 1)   /* change of theta that is not used yet */                       \
    F(COUNT, significant, 1, 1)   /* whether changes of theta are used at once */                  \
    F(VECTOR, anchor, s->k, 1)    /* theta when the present pass of learning began */              \
    F(NUMBER, pass_age, 1, 1)     /* time since the present pass began [s] */                      \
    F(NUMBER, size, 1, 1)         /* 1 sigma: of a tone; of a drift or coloured noise, relative */ \
                                  /* to white noise; of FORCE, relative to the model's `force` */  \
    F(COUNT, output, 1, 1)        /* output that has the tone */
LAYOUT_DECLARE(hypothesis, HYPOTHESIS_FIELDS, estimator_sizes)

/* Memory of an estimator. A torque that reaches an arm's motor late is held only from then on. */
#define STATE_FIELDS(F, s)                                                                         \
    F(COUNT, stamp, 1, 1)           /* stamp of the newest sample [ns] */                          \
    F(VECTOR, y, s->p, 1)           /* outputs of the newest sample, NaN if missing */             \
    F(VECTOR, sample, s->p, 1)      /* newest value of each output */                              \
    F(VECTOR, u, s->m, 1)           /* inputs of the newest sample */                              \
    F(VECTOR, held, s->m, 1)        /* plausible inputs, which predictions use */                  \
    F(MATRIX, past, s->past, 2)     /* torques on their way and their ages [s], newest first */    \
    F(NUMBER, torque_before, 1, 1)  /* torque held before the present one */                       \
    F(NUMBER, torque_quiet, 1, 1)   /* time since a torque stood out from its neighbours [s] */    \
    F(NUMBER, torque_age, 1, 1)     /* time since the newest plausible torque [s] */               \
    F(COUNT, torque_unknown, 1, 1)  /* whether the newest sample's torque was not plausible */     \
    F(COUNT, late, 1, 1)            /* whether the state is read after the next sample was due */  \
    F(COUNT, in_gap, 1, 1)          /* whether an auxiliary state has the torque's unknown part */ \
    F(COUNT, best, 1, 1)            /* place of the likeliest hypothesis */                        \
    F(NUMBER, awake, 1, 1)          /* time until all but the design may sleep [s] */              \
    F(VECTOR, settled_theta, s->k, 1) /* the design's parameters when the bank woke last */        \
    F(MATRIX, settled_gamma, s->k, s->k) /* covariance of the errors of settled_theta */           \
    F(MATRIX, sensors, s->p, sensor_size(s)) /* memory of each output */                           \
    F(NUMBER, since, 1, 1)          /* time since the last sample [s] */                           \
    F(NUMBER, age, 1, 1)            /* time since the start [s] */                                 \
    F(VECTOR, centre, s->plant, 1)  /* mean of the plant's states over some seconds */             \
    F(VECTOR, spread, s->plant, 1)  /* variance of the plant's states over some seconds */         \
    F(VECTOR, noise, s->plant, 1)   /* mean variance of the plant's errors over some seconds */    \
    F(NUMBER, stillness, 1, 1)      /* least noise / spread of a state, 1 at rest */               \
    F(COUNT, outliers, 1, 1)        /* number of samples with outliers */                          \
    F(COUNTS, won, OTHERWISE + 1, 1) /* number of forks that took a place, by their assumption */  \
    F(COUNTS, judged, OUTCOMES, 1)  /* number of samples by outcome, neither USED nor refused */   \
    F(COUNT, restarts, 1, 1)        /* number of new starts after gaps and failures */             \
    F(COUNT, failures, 1, 1)        /* number of new starts after numbers that were not finite */  \
    F(MATRIX, hypotheses, s->hypotheses, hypothesis_size(s)) /* zeros in free places */
LAYOUT_DECLARE(state, STATE_FIELDS, estimator_sizes)

/* One output of a sample, judged by a hypothesis: the innovation; its variance if the parameters
 * are exact (known) or uncertain (variance); the log-likelihood; and whether the output is used. A
 * missing output, an outlier and a stuck sensor's value are not used. */
typedef struct {
    double innovation, known, variance, likelihood;
    int64_t used;
} outlook;
enum { OUTLOOK_SIZE = sizeof(outlook) / sizeof(double) };

/* A sample's innovation by the likeliest hypothesis, and scratch of a correction. All hypotheses
 * use the same scratch in turn, the likeliest one last. */
#define CORRECTION_FIELDS(F, s)                                                              \
    F(VECTOR, innovation, s->p, 1)                                                           \
    F(VECTOR, innovation_variance, s->p, 1)                                                  \
    F(COUNTS, present, s->p, 1)   /* whether an output is there, and its sensor not stuck */ \
    F(MATRIX, outlooks, s->p, OUTLOOK_SIZE) /* an `outlook` of each output */                \
    F(MATRIX, crossed, s->p, s->width) /* covariance of innovations with the states */       \
    F(VECTOR, row, s->width, 1)   /* derivative of an output by the states */                \
    F(VECTOR, gain, s->width, 1)  /* gain of an output */                                    \
    F(MATRIX, omega, s->p, s->k)  /* dy/dtheta */                                            \
    F(VECTOR, cross, s->k, 1)     /* covariance of an innovation with theta */               \
    F(MATRIX, root, s->k, s->k)
LAYOUT_DECLARE(correction, CORRECTION_FIELDS, estimator_sizes)

/* An estimate in physical units, a row of doubles. Bounds are 1 sigma. */
#define ESTIMATE_FIELDS(F, s)                                                                     \
    F(VECTOR, state, s->plant, 1)                                                                 \
    F(VECTOR, state_bound, s->plant, 1)                                                           \
    F(VECTOR, disturbance, s->p, 1)  /* disturbance of each output */                             \
    F(VECTOR, disturbance_rate, s->p, 1)                                                          \
    F(VECTOR, disturbance_bound, s->p, 1)                                                         \
    F(VECTOR, parameters, s->k, 1)                                                                \
    F(VECTOR, parameter_bound, s->k, 1)                                                           \
    F(VECTOR, torque_disturbance, s->t, 1)                                                        \
    F(VECTOR, torque_disturbance_bound, s->t, 1)                                                  \
    F(NUMBER, basis, 1, 1)           /* BASIS_... */                                              \
    F(NUMBER, claimed, 1, 1)         /* whether the bounds are claimed to hold */                 \
    F(NUMBER, parameters_valid, 1, 1) /* whether the motion was rich enough for the parameters */ \
    F(NUMBER, noise_scale, 1, 1)     /* the sensors' noise, relative to the design's */           \
    F(NUMBER, coloured_power, 1, 1)  /* average product of neighbouring innovations */            \
    F(NUMBER, learning, 1, 1)        /* LEARNING_... */                                           \
    F(NUMBER, hypothesis, 1, 1)      /* AS_DESIGNED, FORCE and so on */                           \
    F(NUMBER, in_domain, 1, 1)       /* whether in the certificate's domain, 1 if unknown */      \
    F(NUMBER, age, 1, 1)             /* time since the newest sample before the estimate [s] */
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

/* A model. States are in design coordinates; outputs and torques in physical units. */
#define MODEL_FIELDS(F, s)                                                                        \
    F(COUNTS, sizes, ESTIMATOR_SIZES, 1) /* estimator_sizes */                                    \
    F(VECTOR, flow_record, s->flow_size, 1) /* of the prediction model */                         \
    F(VECTOR, initial, state_size(s), 1) /* state before any sample */                            \
    F(VECTOR, constants, CONSTANTS, 1) /* constants of the bank */                                \
    F(NUMBER, period, 1, 1)          /* nominal time between samples [s] */                       \
    F(NUMBER, shortest, 1, 1)        /* shortest regular step [s] */                              \
    F(NUMBER, longest, 1, 1)         /* longest regular step [s] */                               \
    F(NUMBER, late_factor, 1, 1)     /* factor of the certified bound for one more period */      \
    F(NUMBER, torque_rate, 1, 1)     /* 1 sigma of an unknown torque's rate [N m/s], 0: held */   \
    F(NUMBER, torque_limit, 1, 1)    /* largest plausible torque [N m], 0: any is plausible */    \
    F(NUMBER, torque_rate_limit, 1, 1) /* largest plausible rate of the torque [N m/s] */         \
    F(NUMBER, torque_spread, 1, 1)   /* 1 sigma of an entirely unknown torque [N m] */            \
    F(NUMBER, torque_gain, 1, 1)     /* gain in: motor torque = gain u(t - delay) + the flow's */ \
    F(NUMBER, torque_delay, 1, 1)    /* delay of the torque at the motor [s] */                   \
    F(VECTOR, force, 2, 1)           /* 1 sigma of FORCE: input [N m], arm's link [rad/s^2] */    \
    F(COUNT, explains_motor, 1, 1)   /* whether the design has one at the motor only */           \
    F(VECTOR, modes, 2, 1)           /* natural frequencies of an arm [rad/s] */                  \
    F(COUNT, gain_mode, 1, 1)        /* GAIN_... */                                               \
    F(MATRIX, C, s->p, s->width)     /* map from states to outputs */                             \
    F(MATRIX, D, s->p, s->p)         /* map from samples to expected outputs */                   \
    F(MATRIX, R, s->p, s->p)         /* covariance of a sample's noise */                         \
    F(MATRIX, K, s->width, s->p)     /* certified gain */                                         \
    F(MATRIX, X, s->width, s->width) /* certified bound before a sample */                        \
    F(MATRIX, P, s->width, s->width) /* inverse of X */                                           \
    F(MATRIX, posterior, s->width, s->width) /* certified bound after a sample */                 \
    F(VECTOR, innovation_variance, s->p, 1) /* certified variances of innovations */              \
    F(VECTOR, scale, s->plant, 1)    /* factors from the plant's states to physical units */      \
    F(MATRIX, disturbance_map, s->p, s->width) /* map from states to disturbances */              \
    F(MATRIX, disturbance_direct, s->p, s->p) /* map from samples to disturbances */              \
    F(MATRIX, rate_map, s->p, s->width) /* map from states to rates of disturbances */            \
    F(MATRIX, torque_map, s->t, s->width) /* map from states to unknown torques */                \
    F(COUNTS, disturbed, s->p, 1)    /* whether an output's disturbance can stay after a jump */  \
    F(COUNT, is_clean, 1, 1)         /* whether that of some output cannot */                     \
    F(VECTOR, disturbance_std, s->p, 1) /* certified 1 sigma of the disturbances */               \
    F(VECTOR, torque_std, s->t, 1)   /* certified 1 sigma of the unknown torques */               \
    F(VECTOR, domain, s->plant, 1)   /* 1 sigma of the plant's states if nothing is known */      \
    F(COUNTS, hidden, s->plant, 1)   /* whether only an arm's spring shows a state */             \
    F(VECTOR, limits, s->k, 1)       /* largest sizes of the parameters */                        \
    F(VECTOR, theta_deviation, s->k, 1) /* prior 1 sigma of the parameters */                     \
    F(NUMBER, random_walk, 1, 1)     /* growth of the parameters' variance [1/s] */               \
    F(NUMBER, significance, 1, 1)    /* squared sigmas from which a change of theta is used */    \
    F(NUMBER, pass_time, 1, 1)       /* duration of a pass of learning [s] */                     \
    F(NUMBER, memory, 1, 1)          /* time constant of the measure of excitation [s] */         \
    F(NUMBER, excitation, 1, 1)      /* least eigenvalue of `gram` for parameters to be valid */  \
    F(COUNT, covered, 1, 1)          /* whether the certificate covers the parameters */          \
    F(COUNT, supervised, 1, 1)       /* whether hypotheses other than the design are used */      \
    F(NUMBER, gate, 1, 1)            /* innovation beyond which a sample is an outlier [sigma] */ \
    F(COUNT, stuck_samples, 1, 1)    /* repetitions from which a sensor is stuck, 0: never */     \
    F(VECTOR, disturbance_limit, s->p, 1) /* largest disturbance that a jump may lead to */
LAYOUT_DECLARE(model_numbers, MODEL_FIELDS, estimator_sizes)

/* View of a model record: its sizes, its numbers, and its flow. */
typedef struct {
    estimator_sizes s;
    flow design_flow;
    MODEL_FIELDS(LAYOUT_POINTER, unused)
} model;

/* Bind a view to a model record of `length` numbers, which is only read. Return NULL, or what is
 * wrong with the record. */
const char *model_view(double *memory, size_t length, model *view);

/* Copy a state's numbers onto another's; places without a hypothesis in both are not touched. */
void copy_state(const model *m, const double *from, double *to);

/* Return the outlook of an output by the hypothesis that is being corrected. */
static inline outlook *outlook_of(const correction *effect, long output)
{
    return (outlook *)(void *)effect->outlooks + output;
}

/* Return a view of an output's memory, and of a hypothesis. */
static inline sensor sensor_of(const model *m, const state *at, long output)
{
    return sensor_view(&m->s, at->sensors + (size_t)output * sensor_size(&m->s));
}

static inline hypothesis hypothesis_of(const model *m, const state *at, long place)
{
    return hypothesis_view(&m->s, at->hypotheses + (size_t)place * hypothesis_size(&m->s));
}

/* Find the first live hypothesis from a place on, and move the place there. Return whether
 * one was found. */
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

/* Accept the inputs of a measurement or, if its torque is not plausible, go on with the held ones.
 * The state has been predicted to the measurement's stamp, but not corrected. */
void take_torque(const model *m, state *at, const double *u);

/* Hold inputs from now on, without judging them. */
void hold_inputs(const model *m, state *at, const double *u);

/* Correct by one measurement; y is NaN if an output is missing. */
void correct(const model *m, state *at, const double *y, correction *effect);

/* Predict over a duration of at least 0 [s] with held inputs. between_samples: whether the duration
 * ends before the next sample and the result is only read. */
void predict(const model *m, state *at, double duration, int between_samples, work *scratch);

/* Write the estimate and its bounds; return whether all are finite. */
int read_out(const model *m, const state *at, const estimate *row, work *scratch);

/* A log of samples: time from each to the next [s], negative if the filter starts again there,
 * (n,); outputs, NaN if missing, (n, p); and inputs held until the next sample, (n, m). */
typedef struct {
    int64_t count;
    const double *durations, *y, *u;
} sample_log;

/* Settings of a plain Kalman filter beside the model: Coulomb friction as the deceleration of link
 * and motor, in design coordinates [1/s^2], and the sigmas beyond which an output is left out. */
typedef struct {
    double link_friction, motor_friction, gate;
} filter_options;

/* Filter a log in the memory of a state, without supervision. The likelihood of the innovations is
 * the model's, which identification maximises. Write y - C x of each output given those before it,
 * and its variance, (n, p) each, NaN if the output is missing; and the states before each sample,
 * (n, states). From sample `corrected_until` on the filter runs free: innovations are those of a
 * simulation, and variances are NaN. */
void write_innovations(
    const model *m, state *at, const sample_log *log, const filter_options *options,
    int64_t corrected_until, double *innovations, double *variances, double *states,
    correction *effect, work *scratch);

#endif
