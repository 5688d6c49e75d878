/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The extension module `tsobs_ros.core.native`: the C library for Python, arrays by buffer.
 */
#include <string.h>

#include "estimator.h"
#include "python.h"

/* --- Memory: an array whose address is looked up once, as that takes longer than a step --- */

typedef struct {
    PyObject_HEAD
    Py_buffer buffer;
} memory_object;

static PyTypeObject *memory_type;

static PyObject *memory_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    PyObject *array, *self;
    (void)keywords;
    if (!PyArg_ParseTuple(args, "O:Memory", &array)) {
        return NULL;
    }
    self = PyType_GenericAlloc(type, 0);
    if (self != NULL && PyObject_GetBuffer(array, &((memory_object *)self)->buffer,
                                           PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) < 0) {
        Py_CLEAR(self);
    }
    return self;
}

static void memory_free(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    PyBuffer_Release(&((memory_object *)self)->buffer);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

static PyType_Slot memory_slots[] = {
    {Py_tp_new, (void *)memory_new},
    {Py_tp_dealloc, (void *)memory_free},
    {Py_tp_doc, (void *)"An array's address, looked up once; the array must stay as it is."},
    {0, NULL},
};
static PyType_Spec memory_spec = {
    "tsobs_ros.core.native.Memory", sizeof(memory_object), 0, Py_TPFLAGS_DEFAULT, memory_slots,
};

/* --- arguments --- */

PyObject *refuse(const signature *of, const char *why)
{
    return PyErr_Format(PyExc_ValueError, "%s: %s", of->function, why);
}

/* Raise a ValueError about an argument at a place: what was expected, and two numbers. */
static int refuse_argument(
    const signature *of, int place, const char *format, long long expected, long long got)
{
    const char *name = of->names;
    PyObject *what = NULL, *why = PyUnicode_FromFormat(format, expected, got);
    Py_ssize_t length = 0;
    for (; place > 0; place -= *name++ == ' ') {
    }
    while (name[length] != ' ' && name[length] != '\0') {
        length++;
    }
    what = PyUnicode_FromStringAndSize(name, length);
    if (what != NULL && why != NULL) {
        PyErr_Format(PyExc_ValueError, "%s: %U: %U", of->function, what, why);
    }
    Py_XDECREF(what);
    Py_XDECREF(why);
    return 0;
}

int have(const signature *of, const argument *t, int first, const int64_t *least)
{
    for (; *least >= 0; first++, least++) {
        if (t[first].length < *least) {
            return refuse_argument(of, first, "expected at least %lld numbers, got %lld", *least,
                                   t[first].length);
        }
    }
    return 1;
}

int is_size(const signature *of, const argument *t, int place, int64_t least)
{
    return (least <= t[place].is.integer && t[place].is.integer <= MAX_SIZE) ||
           refuse_argument(of, place, "expected a size from %lld on, got %lld", least,
                           t[place].is.integer);
}

/* Read an array; return whether it is one. */
static int take_array(const signature *of, int place, PyObject *given, argument *taken)
{
    const char kind = of->format[place];
    const Py_buffer *buffer = &taken->buffer;
    const Py_ssize_t unit = kind == 'b' ? 1 : 8;
    if (Py_TYPE(given) == memory_type) {
        buffer = &((memory_object *)given)->buffer;
    } else {
        const int flags = PyBUF_C_CONTIGUOUS | (kind == 'D' ? PyBUF_WRITABLE : 0);
        if (PyObject_GetBuffer(given, &taken->buffer, flags) < 0) {
            return 0;
        }
        taken->held = 1;
    }
    taken->is.bytes = buffer->buf;
    taken->length = buffer->len / unit;
    return (buffer->len % unit == 0 && (uintptr_t)buffer->buf % (size_t)unit == 0) ||
           refuse_argument(of, place, "expected aligned %lld-byte numbers", unit, 0);
}

/* Read an argument; return whether it is of its kind. */
static int take(const signature *of, int place, PyObject *given, argument *taken)
{
    switch (of->format[place]) {
    case 'f':
        taken->is.number = PyFloat_AsDouble(given);
        return taken->is.number != -1.0 || PyErr_Occurred() == NULL;
    case 'i':
        taken->is.integer = PyLong_AsLongLong(given);
        return taken->is.integer != -1 || PyErr_Occurred() == NULL;
    case 's':
        taken->is.text = PyUnicode_AsUTF8AndSize(given, NULL);
        return taken->is.text != NULL;
    default:
        return take_array(of, place, given, taken);
    }
}

PyObject *call_bound(
    const signature *of, bound_body body, PyObject *const *given, Py_ssize_t count)
{
    argument taken[MAX_ARGUMENTS];
    const Py_ssize_t expected = (Py_ssize_t)strlen(of->format);
    PyObject *result = NULL;
    int place = 0;
    if (count != expected) {
        return PyErr_Format(PyExc_TypeError, "%s: expected %zd arguments, got %zd", of->function,
                            expected, count);
    }
    for (int is_right = 1; is_right && place < count; place++) {
        taken[place].held = 0;
        is_right = take(of, place, given[place], &taken[place]);
    }
    if (PyErr_Occurred() == NULL) {
        result = body(of, taken);
    }
    while (place-- > 0) {
        if (taken[place].held) {
            PyBuffer_Release(&taken[place].buffer);
        }
    }
    return result;
}

/* --- the module --- */

/* Numbers of the core that Python needs, too. */
static const struct {
    const char *name;
    long value;
} constants[] = {
    {"KIND_ARM", KIND_ARM},
    {"KIND_SYSTEM", KIND_SYSTEM},
    {"KIND_INTEGRATED", KIND_INTEGRATED},
    {"GAIN_RICCATI", GAIN_RICCATI},
    {"GAIN_CERTIFIED", GAIN_CERTIFIED},
    {"HYPOTHESES", STANDING + FORKS},
};

/* Digest of the sources that setup.py built. */
#ifndef SOURCES
#define SOURCES ""
#endif

static int module_exec(PyObject *module)
{
    PyMethodDef *const tables[] = {
        estimator_methods, faults_methods, history_methods, model_methods,
    };
    memory_type = (PyTypeObject *)PyType_FromSpec(&memory_spec);
    int failed = memory_type == NULL ||
                 PyModule_AddObjectRef(module, "Memory", (PyObject *)memory_type) < 0 ||
                 PyModule_AddStringConstant(module, "SOURCES", SOURCES) < 0;
    for (size_t i = 0; !failed && i < sizeof constants / sizeof constants[0]; i++) {
        failed = PyModule_AddIntConstant(module, constants[i].name, constants[i].value) < 0;
    }
    for (size_t i = 0; !failed && i < sizeof tables / sizeof tables[0]; i++) {
        failed = PyModule_AddFunctions(module, tables[i]) < 0;
    }
    return failed ? -1 : 0;
}

static PyModuleDef_Slot module_slots[] = {
    {Py_mod_exec, (void *)module_exec},
    {0, NULL},
};
static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "native", "The compiled core of tsobs_ros; see tsobs.h.", 0, NULL,
    module_slots, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit_native(void)
{
    return PyModuleDef_Init(&definition);
}
