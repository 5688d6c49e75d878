# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Import it first, and TSOBS_NATIVE, if set, is the compiled core in place of the installed one.

TSOBS_NATIVE=build/sanitize/native.so PYTHONPATH=test/core pytest -p other_build
"""

import os
import sys
from importlib.util import module_from_spec, spec_from_file_location

NAME = "tsobs_ros.core.native"

if "TSOBS_NATIVE" in os.environ:
    assert NAME not in sys.modules, f"{NAME} is loaded already"
    spec = spec_from_file_location(NAME, os.environ["TSOBS_NATIVE"])
    assert spec is not None
    assert spec.loader is not None
    sys.modules[NAME] = module_from_spec(spec)
    spec.loader.exec_module(sys.modules[NAME])
