/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of exported designs.
 */
#include "python.h"
#include "tsobs.h"

static const layout_field head_layout[] = {EXPORTED_FIELDS(LAYOUT_ROW, unused)};

static PyObject *layout(PyObject *module, PyObject *unused)
{
    (void)module, (void)unused;
    return fields_as_list(head_layout, sizeof head_layout / sizeof head_layout[0]);
}

static PyObject *seal(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "exported_seal", *const format = "D";
    argument taken[1];
    PyObject *result = NULL;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    if (require_length(name, "words", &taken[0], exported_head_size(NULL)) == 0) {
        exported_seal(taken[0].is.doubles, (size_t)taken[0].length * 8);
        result = Py_NewRef(Py_None);
    }
    release_arguments(format, taken);
    return result;
}

static PyObject *open_exported(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    static const char *const name = "exported_open", *const format = "d";
    argument taken[1];
    PyObject *result = NULL;
    exported design;
    const char *wrong;
    (void)module;
    if (take_arguments(name, format, given, count, taken) < 0) {
        return NULL;
    }
    wrong = exported_open(&design, taken[0].is.doubles, (size_t)taken[0].length * 8);
    if (wrong != NULL) {
        PyErr_Format(PyExc_ValueError, "%s: %s", name, wrong);
    } else {
        result = Py_BuildValue(
            "(nnnnn)", (Py_ssize_t)design.model_length, (Py_ssize_t)design.memory_length,
            (Py_ssize_t)design.ring_length, (Py_ssize_t)design.scratch_length,
            (Py_ssize_t)design.row);
    }
    release_arguments(format, taken);
    return result;
}

PyMethodDef exported_methods[] = {
    {"exported_layout", layout, METH_NOARGS, "Return the fields of an exported design's head."},
    BINDING("exported_seal", seal, "Complete the head of an exported design."),
    BINDING("exported_open", open_exported, "Return the lengths of a tracker's memories."),
    {NULL, NULL, 0, NULL},
};
