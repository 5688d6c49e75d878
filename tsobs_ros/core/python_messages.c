/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of messages in the records of an MCAP chunk.
 */
#include "messages.h"
#include "python.h"

static PyObject *split(PyObject *module, PyObject *args)
{
    Py_buffer data, found;
    PyObject *result = NULL;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*w*:messages_split", &data, &found)) {
        return NULL;
    }
    if (found.len % (8 * MESSAGE_FIELDS) != 0 || ((uintptr_t)found.buf) % 8 != 0) {
        PyErr_SetString(PyExc_ValueError, "messages_split: found: expected 5 rows of numbers");
    } else {
        const size_t room = (size_t)found.len / (8 * MESSAGE_FIELDS);
        int64_t count;
        Py_BEGIN_ALLOW_THREADS
        count = messages_split(data.buf, (size_t)data.len, found.buf, room);
        Py_END_ALLOW_THREADS
        result = PyLong_FromLongLong(count);
    }
    PyBuffer_Release(&data);
    PyBuffer_Release(&found);
    return result;
}

PyMethodDef messages_methods[] = {
    {"messages_split", split, METH_VARARGS,
     "Write the fields of each message in some records, and return their number or -1."},
    {NULL, NULL, 0, NULL},
};
