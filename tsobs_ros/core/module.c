/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The extension module `tsobs_ros.core.native`: the C library for Python, with arrays as buffers.
 *
 * native.pyi describes the functions. Each reads its arguments by a format string, and checks their
 * lengths before it calls the library.
 */
#define PY_SSIZE_T_CLEAN
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>
#include <string.h>

#include "arithmetic.h"
#include "simulate.h"
#include "tsobs.h"

/* --- arguments --- */

#define MAX_ARGUMENTS 24
#define MAX_SIZE 4096       /* so that no product of sizes overflows */
#define MAX_DURATION 1e12   /* so that its periods can be counted [s] */

/* One argument: an array of numbers, one number, a text, or a tuple. */
typedef struct {
    Py_buffer buffer;
    int held;       /* whether the buffer must be released */
    void *at;       /* the beginning of an array, */
    int64_t length; /* and its length: in 8-byte numbers, of bytes in bytes */
    double number;
    int64_t integer;
    const char *text;
    PyObject *tuple;
} argument;

/* A function: its name, a format with one letter for each argument, and its body. 'd' is an array
 * that is read, 'D' one that is written, both contiguous and of 8-byte numbers; 'b' is bytes, 'f' a
 * float, 'i' an int, 's' a text, 't' a tuple. The body returns a new reference, or raises. */
typedef struct signature {
    const char *name, *format;
    PyObject *(*body)(const struct signature *of, const argument *t);
} signature;

/* Raise a ValueError that begins with the function's name; return NULL. */
static PyObject *refuse(const signature *of, const char *why)
{
    return PyErr_Format(PyExc_ValueError, "%s: %s", of->name, why);
}

/* Read an argument; return whether it is what the format says, else raise. */
static int take(const signature *of, int place, PyObject *given, argument *t)
{
    const char kind = of->format[place];
    const int unit = kind == 'b' ? 1 : 8;
    t->held = 0;
    switch (kind) {
    case 'f':
        t->number = PyFloat_AsDouble(given);
        return PyErr_Occurred() == NULL;
    case 'i':
        t->integer = PyLong_AsLongLong(given);
        return PyErr_Occurred() == NULL;
    case 's':
        t->text = PyUnicode_AsUTF8AndSize(given, NULL);
        return t->text != NULL;
    case 't':
        t->tuple = given;
        return PyTuple_Check(given)
               || PyErr_Format(PyExc_TypeError, "%s: argument %d: expected a tuple", of->name,
                               place + 1) != NULL;
    }
    if (PyObject_GetBuffer(
            given, &t->buffer, PyBUF_C_CONTIGUOUS | (kind == 'D' ? PyBUF_WRITABLE : 0)) < 0) {
        return 0;
    }
    t->held = 1;
    t->at = t->buffer.buf;
    t->length = t->buffer.len / unit;
    if (t->buffer.len % unit != 0 || (uintptr_t)t->at % (uintptr_t)unit != 0) {
        PyErr_Format(PyExc_ValueError, "%s: argument %d: expected aligned 8-byte numbers", of->name,
                     place + 1);
        return 0;
    }
    return 1;
}

/* Release the buffers of arguments. */
static void release(argument *t, int count)
{
    for (; count > 0; count--, t++) {
        if (t->held) {
            PyBuffer_Release(&t->buffer);
        }
        t->held = 0;
    }
}

static PyObject *call(const signature *of, PyObject *const *given, Py_ssize_t count)
{
    argument taken[MAX_ARGUMENTS];
    const Py_ssize_t expected = (Py_ssize_t)strlen(of->format);
    PyObject *result = NULL;
    int place = 0, are_right = 1;
    taken[0].held = 0;
    if (count != expected) {
        return PyErr_Format(PyExc_TypeError, "%s: expected %zd arguments, got %zd", of->name,
                            expected, count);
    }
    for (; place < count && are_right; place++) {
        are_right = take(of, place, given[place], &taken[place]);
    }
    if (are_right) {
        result = of->body(of, taken);
    }
    release(taken, place);
    return result;
}

/* Begin the definition of a function. The body follows in braces; in it, `of` is the function's
 * signature and `t` are the arguments. */
#define BIND(name, format)                                                                 \
    static PyObject *name##_body(const signature *of, const argument *t);                  \
    static PyObject *name##_bound(PyObject *self, PyObject *const *given, Py_ssize_t count) \
    {                                                                                      \
        static const signature of = {#name, format, name##_body};                          \
        (void)self;                                                                        \
        return call(&of, given, count);                                                    \
    }                                                                                      \
    static PyObject *name##_body(const signature *of, const argument *t)

/* Return whether the arguments from a place on have at least these numbers of entries; else raise a
 * ValueError. For use in a body of BIND. */
#define HAVE(first, ...) have(of, t, first, (const int64_t[]){__VA_ARGS__, -1})
static int have(const signature *of, const argument *t, int first, const int64_t *least)
{
    for (; *least >= 0; first++, least++) {
        if (t[first].length < *least) {
            PyErr_Format(PyExc_ValueError,
                         "%s: argument %d: expected at least %lld numbers, got %lld", of->name,
                         first + 1, (long long)*least, (long long)t[first].length);
            return 0;
        }
    }
    return 1;
}

/* Return whether sizes are at least `least` and at most MAX_SIZE; else raise a ValueError. */
static int are_sizes(const signature *of, const int64_t *numbers, int64_t count, int64_t least)
{
    for (int64_t i = 0; i < count; i++) {
        if (numbers[i] < least || numbers[i] > MAX_SIZE) {
            return refuse(of, "expected sizes within their limits") != NULL;
        }
    }
    return 1;
}

/* Return whether an argument is 0 to MAX_DURATION; else raise a ValueError. */
static int is_duration(const signature *of, const argument *t)
{
    return (0.0 <= t->number && t->number <= MAX_DURATION) ||
           refuse(of, "duration: expected a finite number of at least 0") != NULL;
}

/* --- layouts of records --- */

enum { PLANT_SIZES = sizeof(plant_sizes) / 8 };

#define FIELD_FORMAT(kind, name, rows, columns) "(ssll)"
#define FIELD_VALUES(kind, name, rows, columns) , #name, #kind, (long)(rows), (long)(columns)
#define RECORD(name, FIELDS, count, sizes)                                                     \
    if (strcmp(t[0].text, name) == 0 && t[1].length == (count)) {                              \
        const sizes *s = t[1].at;                                                              \
        (void)s;                                                                               \
        return Py_BuildValue("[" FIELDS(FIELD_FORMAT, s) "]" FIELDS(FIELD_VALUES, s));         \
    }

BIND(layout, "sd")
{
    const int64_t count = t[1].length, *numbers = t[1].at;
    if (count == ESTIMATOR_SIZES ? sizes_are_sound(numbers) : are_sizes(of, numbers, count, 0)) {
        RECORD("sensor", SENSOR_FIELDS, ESTIMATOR_SIZES, estimator_sizes)
        RECORD("hypothesis", HYPOTHESIS_FIELDS, ESTIMATOR_SIZES, estimator_sizes)
        RECORD("state", STATE_FIELDS, ESTIMATOR_SIZES, estimator_sizes)
        RECORD("correction", CORRECTION_FIELDS, ESTIMATOR_SIZES, estimator_sizes)
        RECORD("estimate", ESTIMATE_FIELDS, ESTIMATOR_SIZES, estimator_sizes)
        RECORD("work", WORK_FIELDS, ESTIMATOR_SIZES, estimator_sizes)
        RECORD("model", MODEL_FIELDS, ESTIMATOR_SIZES, estimator_sizes)
        RECORD("flow", FLOW_FIELDS, FLOW_SIZES, flow_sizes)
        RECORD("flow_step", STEP_FIELDS, FLOW_SIZES, flow_sizes)
        RECORD("simulated_plant", SIMULATED_PLANT_FIELDS, PLANT_SIZES, plant_sizes)
        RECORD("history", HISTORY_FIELDS, 0, void)
    }
    return PyErr_Occurred() ? NULL : refuse(of, "expected a record and its sizes");
}

/* --- functions, flows and simulated plants --- */

static double cosine(double angle)
{
    double sin, cos;
    sine_and_cosine(angle, &sin, &cos);
    return cos;
}

BIND(elementary, "sD")
{
    static const struct {
        const char *name;
        double (*value)(double);
    } known[] = {
        {"sine", sine}, {"cosine", cosine}, {"exponential", exponential}, {"logarithm", logarithm},
    };
    for (size_t place = 0; place < sizeof known / sizeof known[0]; place++) {
        if (strcmp(known[place].name, t[0].text) == 0) {
            double *numbers = t[1].at;
            for (int64_t i = 0; i < t[1].length; i++) {
                numbers[i] = known[place].value(numbers[i]);
            }
            Py_RETURN_NONE;
        }
    }
    return refuse(of, "function: expected sine, cosine, exponential or logarithm");
}

BIND(weights_of_each, "dddDii")
{
    const int64_t r = t[4].integer, q = t[5].integer;
    if (!are_sizes(of, &r, 1, 1) || !are_sizes(of, &q, 1, 1)) {
        return NULL;
    }
    const int64_t samples = t[2].length / q;
    const double *z = t[2].at;
    double *weights = t[3].at;
    if (!HAVE(0, r * q, 4 * r * q) || !HAVE(3, samples * r)) {
        return NULL;
    }
    for (int64_t k = 0; k < samples; k++) {
        rule_weights(t[0].at, t[1].at, z + k * q, weights + k * r, NULL, (long)r, (long)q);
    }
    Py_RETURN_NONE;
}

BIND(flow_over, "dfD")
{
    if (!flow_is_sound(t[0].at, (size_t)t[0].length)) {
        return refuse(of, "expected a flow's record");
    }
    const flow_sizes s = flow_sizes_of(t[0].at);
    if (!is_duration(of, &t[1]) || !HAVE(2, (int64_t)flow_step_size(&s))) {
        return NULL;
    }
    const flow given = flow_view(&s, t[0].at);
    const flow_step step = flow_step_view(&s, t[2].at);
    other_step(&given, t[1].number, &step);
    Py_RETURN_NONE;
}

BIND(simulate, "dDddDDD")
{
    const plant_sizes *s = t[0].at;
    if (!HAVE(0, PLANT_SIZES) || !are_sizes(of, t[0].at, PLANT_SIZES, 0) ||
        !are_sizes(of, &s->n, 1, 1)) {
        return NULL;
    }
    const int64_t held = s->m + s->scheduled, runs = t[4].length / s->n;
    const int64_t samples = runs > 0 ? t[5].length / (s->n * runs) : 0, all = runs * samples;
    const int64_t size = (int64_t)simulated_plant_size(s);
    const double *kicks = t[3].length > 0 ? t[3].at : NULL;
    if (s->rules == 0 && (s->n != 4 || held != ARM_INPUTS || s->p != 2)) {
        return refuse(of, "expected the sizes of an arm");
    }
    if (!HAVE(1, size, all * held) || !HAVE(6, all * s->p)) {
        return NULL;
    }
    const simulated_plant plant = simulated_plant_view(s, t[1].at);
    if (kicks != NULL && all > 0 && *plant.substeps > t[3].length / (noisy_count(s) * all)) {
        return refuse(of, "expected noise of each substep");
    }
    Py_BEGIN_ALLOW_THREADS
    simulate(
        &plant, s, t[2].at, kicks, t[4].at, t[5].at, t[6].at, (long)runs, (long)samples);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

/* --- estimators: steps of a state --- */

/* Bind a model and a state, the first two arguments; return whether they match, else raise. */
static int take_state(const signature *of, const argument *t, model *m, state *at)
{
    const char *wrong = model_view(t[0].at, (size_t)t[0].length, m);
    if (wrong == NULL && (size_t)t[1].length != state_size(&m->s)) {
        wrong = "expected a state of the model";
    }
    if (wrong == NULL) {
        *at = state_view(&m->s, t[1].at);
    }
    return wrong == NULL || refuse(of, wrong) != NULL;
}

BIND(estimator_correct, "dDdD")
{
    model m;
    state at;
    if (!take_state(of, t, &m, &at) || !HAVE(2, m.s.p, (int64_t)correction_size(&m.s))) {
        return NULL;
    }
    correction effect = correction_view(&m.s, t[3].at);
    correct(&m, &at, t[2].at, &effect);
    Py_RETURN_NONE;
}

BIND(estimator_predict, "dDdfiD")
{
    model m;
    state at;
    if (!take_state(of, t, &m, &at) || !HAVE(2, m.s.m) || !HAVE(5, (int64_t)work_size(&m.s)) ||
        !is_duration(of, &t[3])) {
        return NULL;
    }
    work scratch = work_view(&m.s, t[5].at);
    hold_inputs(&m, &at, t[2].at);
    predict(&m, &at, t[3].number, t[4].integer != 0, &scratch);
    Py_RETURN_NONE;
}

BIND(estimator_read, "ddDD")
{
    model m;
    state at;
    if (!take_state(of, t, &m, &at) ||
        !HAVE(2, (int64_t)estimate_size(&m.s), (int64_t)work_size(&m.s))) {
        return NULL;
    }
    const estimate row = estimate_view(&m.s, t[2].at);
    work scratch = work_view(&m.s, t[3].at);
    read_out(&m, &at, &row, &scratch);
    Py_RETURN_NONE;
}

BIND(estimator_innovations, "dDdddfffiDDDDD")
{
    model m;
    state at;
    const int64_t count = t[2].length;
    if (!take_state(of, t, &m, &at)) {
        return NULL;
    }
    if (m.s.k != 0) {
        return refuse(of, "expected a model without parameters");
    }
    const sample_log log = {count, t[2].at, t[3].at, t[4].at};
    const filter_options options = {t[5].number, t[6].number, t[7].number};
    for (int64_t i = 0; i < count; i++) {
        if (!(log.durations[i] <= MAX_DURATION)) {
            return refuse(of, "durations: expected finite numbers");
        }
    }
    if (!HAVE(3, count * m.s.p, count * m.s.m) ||
        !HAVE(9, count * m.s.p, count * m.s.p, count * m.s.n, (int64_t)correction_size(&m.s),
              (int64_t)work_size(&m.s))) {
        return NULL;
    }
    correction effect = correction_view(&m.s, t[12].at);
    work scratch = work_view(&m.s, t[13].at);
    Py_BEGIN_ALLOW_THREADS
    write_innovations(
        &m, &at, &log, &options, t[8].integer, t[9].at, t[10].at, t[11].at, &effect, &scratch);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

/* --- trackers: their model and their room are the first two arguments --- */

/* Bind a tracker; return whether its model and room are valid, else raise. */
static int take_tracker(const signature *of, const argument *t, tracker *bound)
{
    const char *wrong = tsobs_tracker_bind(
        bound, t[0].at, (size_t)t[0].length, t[1].at, (size_t)t[1].length);
    return wrong == NULL || refuse(of, wrong) != NULL;
}

/* Take stamps, y and u, the arguments after the room, and the outcomes, four arguments from `to`
 * on; return whether their lengths match, else raise. */
static int take_measurements(
    const signature *of, const argument *t, int to, const tracker *by, measurements *given,
    outcomes *written)
{
    const int64_t count = t[2].length, outputs = count * by->m.s.p;
    *given = (measurements){count, t[2].at, t[3].at, t[4].at};
    *written = (outcomes){t[to].at, t[to + 1].at, t[to + 2].at, t[to + 3].at};
    return HAVE(3, outputs, count * by->m.s.m) && HAVE(to, count, outputs, outputs, outputs);
}

BIND(tracker_room, "di")
{
    model m;
    const char *wrong = model_view(t[0].at, (size_t)t[0].length, &m);
    if (wrong != NULL || t[1].integer < 1 || t[1].integer > MOST_STEPS) {
        return refuse(of, wrong != NULL ? wrong : "max_steps: expected 1 to 1000000");
    }
    const room_sizes sizes = {&m.s, t[1].integer + SPARE_SLOTS};
    return PyLong_FromSize_t(tracker_room_size(&sizes));
}

BIND(history_offer, "dD" "dddi" "DDDD")
{
    tracker by;
    measurements given;
    outcomes written;
    if (!take_tracker(of, t, &by) || !take_measurements(of, t, 6, &by, &given, &written)) {
        return NULL;
    }
    tsobs_offer(&by, &given, t[5].integer, &written);
    Py_RETURN_NONE;
}

BIND(history_estimate, "dD" "iD")
{
    tracker by;
    if (!take_tracker(of, t, &by) || !HAVE(3, (int64_t)estimate_size(&by.m.s))) {
        return NULL;
    }
    return PyBool_FromLong(tsobs_estimate_at(&by, t[2].integer, t[3].at));
}

/* Advance one tracker; its model and room are the first two arguments. */
static int advance_one(const signature *of, const argument *t)
{
    tracker by;
    measurements given;
    outcomes written;
    const int64_t count = t[9].length, *known = t[11].at;
    if (!take_tracker(of, t, &by) || !take_measurements(of, t, 5, &by, &given, &written) ||
        !HAVE(10, count, count, count, count, count * (int64_t)estimate_size(&by.m.s))) {
        return 0;
    }
    for (int64_t tick = 0; tick < count; tick++) {
        if (known[tick] < (tick > 0 ? known[tick - 1] : 0) || known[tick] > given.count) {
            return refuse(of, "known: expected numbers of samples that ascend") != NULL;
        }
    }
    const history_ticks ticks = {
        count, t[9].at, t[10].at, known, t[12].at, t[13].at, t[14].at,
    };
    Py_BEGIN_ALLOW_THREADS
    tsobs_advance(&by, &given, &written, &ticks, t[15].integer);
    Py_END_ALLOW_THREADS
    return 1;
}

BIND(history_advance, "t" "ddd" "DDDD" "ddd" "DDD" "i")
{
    enum { SHARED = 14 };
    static const signature records = {"history_advance", "dD", NULL};
    const Py_ssize_t trackers = PyTuple_Size(t[0].tuple) / 2;
    argument own[SHARED + 2] = {{.held = 0}};
    int are_right = 1;
    own[SHARED + 1] = t[SHARED];
    for (Py_ssize_t place = 0; place < trackers && are_right; place++) {
        for (int i = 1; i < SHARED; i++) { /* an equal share of each array */
            own[i + 1].length = t[i].length / trackers;
            own[i + 1].at = (double *)t[i].at + place * own[i + 1].length;
        }
        are_right = take(&records, 0, PyTuple_GetItem(t[0].tuple, 2 * place), &own[0])
                    && take(&records, 1, PyTuple_GetItem(t[0].tuple, 2 * place + 1), &own[1])
                    && advance_one(of, own);
        release(own, 2);
    }
    return are_right ? Py_NewRef(Py_None) : NULL;
}

/* --- exported designs --- */

BIND(exported_seal, "D")
{
    if (!HAVE(0, (int64_t)sizeof(exported_head) / 8)) {
        return NULL;
    }
    tsobs_exported_seal(t[0].at, (size_t)t[0].length * 8);
    Py_RETURN_NONE;
}

BIND(exported_open, "d")
{
    exported design;
    const char *wrong = tsobs_exported_open(&design, t[0].at, (size_t)t[0].length * 8);
    if (wrong != NULL) {
        return refuse(of, wrong);
    }
    return PyLong_FromSize_t(design.room);
}

/* --- messages in the records of an MCAP chunk --- */

enum { RECORD_HEAD = 9, MESSAGE_HEAD = 31, MESSAGE_KIND = 5, MESSAGE_FIELDS = 5 };

/* Return a little-endian number of `size` bytes. */
static uint64_t number_at(const uint8_t *at, int size)
{
    uint64_t value = 0;
    while (size-- > 0) {
        value = value << 8 | at[size];
    }
    return value;
}

/* Write channel, log time, publish time, first byte and size of the data of each message to rows of
 * `room` numbers. Return the number of messages, or -1 if a record is broken or there are more. A
 * record is one byte for its kind, 8 for the length of its content, and the content. Only a loop
 * can find where each record begins, no array operation. */
static int64_t split_messages(const uint8_t *data, size_t size, int64_t *found, size_t room)
{
    size_t at = 0, count = 0, length;
    for (; at < size; at += length) {
        const uint8_t *record = data + at;
        if (size - at < RECORD_HEAD || record[0] == 0 ||
            number_at(record + 1, 8) > size - at - RECORD_HEAD) {
            return -1;
        }
        length = RECORD_HEAD + (size_t)number_at(record + 1, 8);
        if (record[0] != MESSAGE_KIND) {
            continue;
        }
        if (length < MESSAGE_HEAD || count == room) {
            return -1;
        }
        found[count] = (int64_t)number_at(record + 9, 2);
        found[room + count] = (int64_t)number_at(record + 15, 8);
        found[2 * room + count] = (int64_t)number_at(record + 23, 8);
        found[3 * room + count] = (int64_t)(at + MESSAGE_HEAD);
        found[4 * room + count] = (int64_t)(length - MESSAGE_HEAD);
        count++;
    }
    return (int64_t)count;
}

BIND(messages_split, "bD")
{
    int64_t count;
    (void)of;
    Py_BEGIN_ALLOW_THREADS
    count = split_messages(
        t[0].at, (size_t)t[0].length, t[1].at, (size_t)(t[1].length / MESSAGE_FIELDS));
    Py_END_ALLOW_THREADS
    return PyLong_FromLongLong(count);
}

/* --- the module --- */

#define METHOD(name) {#name, (PyCFunction)(void (*)(void))name##_bound, METH_FASTCALL, NULL}
static PyMethodDef methods[] = {
    METHOD(layout),
    METHOD(elementary),
    METHOD(weights_of_each),
    METHOD(flow_over),
    METHOD(simulate),
    METHOD(estimator_correct),
    METHOD(estimator_predict),
    METHOD(estimator_read),
    METHOD(estimator_innovations),
    METHOD(tracker_room),
    METHOD(history_offer),
    METHOD(history_estimate),
    METHOD(history_advance),
    METHOD(exported_seal),
    METHOD(exported_open),
    METHOD(messages_split),
    {NULL, NULL, 0, NULL},
};

/* Digest of the sources from which setup.py builds the module. */
#ifndef SOURCES
#define SOURCES ""
#endif

#define CONSTANT_FORMAT(name, value, what) "(sds)"
#define CONSTANT_VALUES(name, value, what) , #name, value, what

static int add_constants(PyObject *module)
{
    PyObject *bank =
        Py_BuildValue("[" BANK_CONSTANTS(CONSTANT_FORMAT) "]" BANK_CONSTANTS(CONSTANT_VALUES));
    const int failed = PyModule_AddStringConstant(module, "SOURCES", SOURCES) < 0 ||
                       PyModule_AddIntMacro(module, KIND_ARM) < 0 ||
                       PyModule_AddIntMacro(module, KIND_SYSTEM) < 0 ||
                       PyModule_AddIntMacro(module, GAIN_OPEN) < 0 ||
                       PyModule_AddIntMacro(module, GAIN_RICCATI) < 0 ||
                       PyModule_AddIntMacro(module, GAIN_CERTIFIED) < 0 ||
                       PyModule_AddIntMacro(module, WRONG_TORQUE) < 0 ||
                       PyModule_AddIntMacro(module, JUMPED) < 0 ||
                       PyModule_AddIntMacro(module, HIT) < 0 ||
                       PyModule_AddIntMacro(module, MOVED) < 0 ||
                       PyModule_AddIntMacro(module, SERIES_TERMS) < 0 ||
                       PyModule_AddIntMacro(module, MOST_STEPS) < 0 ||
                       PyModule_AddIntConstant(module, "HYPOTHESES", STANDING + FORKS) < 0 ||
                       PyModule_AddObjectRef(module, "BANK_CONSTANTS", bank) < 0;
    Py_XDECREF(bank);
    return failed ? -1 : 0;
}

static PyModuleDef_Slot slots[] = {{Py_mod_exec, (void *)add_constants}, {0, NULL}};
static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "native", "The compiled core of tsobs_ros; see tsobs.h.", 0, methods,
    slots, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit_native(void)
{
    return PyModuleDef_Init(&definition);
}
