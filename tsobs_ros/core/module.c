/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The extension module `tsobs_ros.core.native`: the C library for Python, arrays by buffer.
 */
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
    PyObject *array;
    memory_object *self;
    (void)keywords;
    if (!PyArg_ParseTuple(args, "O:Memory", &array)) {
        return NULL;
    }
    self = (memory_object *)PyType_GenericAlloc(type, 0);
    if (self == NULL) {
        return NULL;
    }
    if (PyObject_GetBuffer(array, &self->buffer, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) < 0) {
        Py_DECREF(self);
        return NULL;
    }
    return (PyObject *)self;
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

static int take_array(const char *function, Py_ssize_t place, int writable, PyObject *given,
                      argument *taken)
{
    const Py_buffer *buffer = &taken->buffer;
    if (Py_TYPE(given) == memory_type) {
        buffer = &((memory_object *)given)->buffer;
    } else {
        const int flags = PyBUF_C_CONTIGUOUS | (writable ? PyBUF_WRITABLE : 0);
        if (PyObject_GetBuffer(given, &taken->buffer, flags) < 0) {
            return -1;
        }
        taken->held = 1;
    }
    if (buffer->len % 8 != 0 || ((uintptr_t)buffer->buf) % 8 != 0) {
        PyErr_Format(PyExc_ValueError, "%s: argument %zd: expected aligned 8-byte numbers",
                     function, place + 1);
        return -1;
    }
    taken->is.doubles = (double *)buffer->buf;
    taken->length = buffer->len / 8;
    return 0;
}

int take_arguments(const char *function, const char *format, PyObject *const *given,
                   Py_ssize_t count, argument *taken)
{
    Py_ssize_t expected = 0, i;
    while (format[expected] != '\0') {
        taken[expected++].held = 0;
    }
    if (count != expected) {
        PyErr_Format(PyExc_TypeError, "%s: expected %zd arguments, got %zd", function, expected,
                     count);
        return -1;
    }
    for (i = 0; i < count; i++) {
        if (format[i] == 'f') {
            taken[i].is.number = PyFloat_AsDouble(given[i]);
        } else if (format[i] == 'i') {
            taken[i].is.integer = PyLong_AsLongLong(given[i]);
        } else if (take_array(function, i, format[i] == 'D', given[i], &taken[i]) < 0) {
            release_arguments(format, taken);
            return -1;
        }
        if ((format[i] == 'f' || format[i] == 'i') && PyErr_Occurred()) {
            release_arguments(format, taken);
            return -1;
        }
    }
    return 0;
}

void release_arguments(const char *format, argument *taken)
{
    Py_ssize_t i;
    for (i = 0; format[i] != '\0'; i++) {
        if (taken[i].held) {
            PyBuffer_Release(&taken[i].buffer);
            taken[i].held = 0;
        }
    }
}

int require_length(const char *function, const char *name, const argument *array, size_t least)
{
    if ((size_t)array->length >= least) {
        return 0;
    }
    PyErr_Format(PyExc_ValueError, "%s: %s: expected at least %zu numbers, got %zd", function,
                 name, least, array->length);
    return -1;
}

PyObject *fields_as_list(const layout_field *fields, size_t count)
{
    size_t i;
    PyObject *list = PyList_New(0);
    for (i = 0; list != NULL && i < count; i++) {
        PyObject *row = Py_BuildValue("(ssll)", fields[i].name, fields[i].kind, fields[i].rows,
                                      fields[i].columns);
        if (row == NULL || PyList_Append(list, row) < 0) {
            Py_CLEAR(list);
        }
        Py_XDECREF(row);
    }
    return list;
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
        flow_methods,
        matrices_methods,
        messages_methods,
        faults_methods,
        scores_methods,
        estimator_methods,
        simulate_methods,
        history_methods,
        exported_methods,
    };
    size_t i;
    memory_type = (PyTypeObject *)PyType_FromSpec(&memory_spec);
    if (memory_type == NULL || PyModule_AddObjectRef(module, "Memory", (PyObject *)memory_type) < 0) {
        return -1;
    }
    if (PyModule_AddStringConstant(module, "SOURCES", SOURCES) < 0) {
        return -1;
    }
    for (i = 0; i < sizeof constants / sizeof constants[0]; i++) {
        if (PyModule_AddIntConstant(module, constants[i].name, constants[i].value) < 0) {
            return -1;
        }
    }
    for (i = 0; i < sizeof tables / sizeof tables[0]; i++) {
        if (PyModule_AddFunctions(module, tables[i]) < 0) {
            return -1;
        }
    }
    return 0;
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
