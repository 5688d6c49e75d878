/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Bindings of prediction models.
 */
#include "python.h"

PyMethodDef flow_methods[] = {
    {NULL, NULL, 0, NULL},
};
