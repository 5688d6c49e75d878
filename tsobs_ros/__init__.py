# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""State and sensor-disturbance estimation for a robot arm with an elastic joint.

    import tsobs_ros as ts

    design = ts.load_design()  # the shipped one; or ts.load_design("my_arm.design.yaml")
    run = ts.simulate(design, duration=10.0, disturbance="bias_step")
    estimates = ts.estimate(design, run.time, run.angle, run.torque)  # arrays in, arrays out
    # or step by step, to the same bits: initial, correct, predict, readout
    observer = design.observer(adapt=True, supervision=ts.SupervisionOptions())

Models and designs:
    ElasticJointArm   physical parameters of the arm
    TSModel           any Takagi-Sugeno system, by its matrices and memberships
    ArmRequest        the arm, its sensor and disturbance, and the domain to certify
    load_request      a request from a YAML file
    excite            a torque motion that reveals a request's numbers (needs scipy)
    fit               a request's numbers from recordings (needs scipy)
    Fit               result of fit: numbers, how well they are known, what the model lacks
    synthesise        a certified gain for a request (needs cvxpy)
    Design            a gain with its proof; makes observers
    load_design       a design from its file, with its certificate checked again
    save_design       a design into a file
    export_c          a design's estimator into a file for C and C++ programs

Estimates:
    simulate          measurements and truth of an arm, as arrays
    estimate          estimates from arrays, as the observer node makes them
    Estimates         result of estimate: states, bounds, disturbance, innovations, counts
    ObserverSettings  method, gates and timeouts, with the node's defaults
    SupervisionOptions rules for leaving samples out, for a design's observer
    make_tracker      estimates at any time from stamped measurements in any order
    Tracker           class of the object that make_tracker returns
    Measurement       one stamped sample for a tracker
    step_joints       estimates of several joints from one sample of each, in one call

Bags and logs:
    estimate_bag      estimates of a bag or a CSV log
    compare           all observers on the same bag or log
    BagReader         the messages of an MCAP bag, without ROS
    BagWriter         a new bag that every rosbag2 tool reads

    TsobsError        root of all errors that are raised on purpose

Importing tsobs_ros loads none of this; each name is imported when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tsobs_ros.api import Estimates as Estimates
    from tsobs_ros.api import compare as compare
    from tsobs_ros.api import estimate as estimate
    from tsobs_ros.api import estimate_bag as estimate_bag
    from tsobs_ros.api import simulate as simulate
    from tsobs_ros.bag.reader import BagReader as BagReader
    from tsobs_ros.bag.writer import BagWriter as BagWriter
    from tsobs_ros.design.file import load_design as load_design
    from tsobs_ros.design.file import load_request as load_request
    from tsobs_ros.design.file import save_design as save_design
    from tsobs_ros.design.record import Design as Design
    from tsobs_ros.design.request import ArmRequest as ArmRequest
    from tsobs_ros.design.synthesis import synthesise as synthesise
    from tsobs_ros.errors import TsobsError as TsobsError
    from tsobs_ros.estimation.estimator import SupervisionOptions as SupervisionOptions
    from tsobs_ros.estimation.records import Measurement as Measurement
    from tsobs_ros.estimation.tracker import Tracker as Tracker
    from tsobs_ros.estimation.tracker import step_joints as step_joints
    from tsobs_ros.identification.excitation import excite as excite
    from tsobs_ros.identification.fit import fit as fit
    from tsobs_ros.identification.result import Fit as Fit
    from tsobs_ros.methods import ObserverSettings as ObserverSettings
    from tsobs_ros.methods import export_c as export_c
    from tsobs_ros.methods import make_tracker as make_tracker
    from tsobs_ros.model.arm import ElasticJointArm as ElasticJointArm
    from tsobs_ros.model.ts_model import TSModel as TSModel

__version__ = "0.7.0"

# By name only, as signals must be caught before the heavy modules load (see executables.py).
_NAMES = {
    "api": ("Estimates", "compare", "estimate", "estimate_bag", "simulate"),
    "bag.reader": ("BagReader",),
    "bag.writer": ("BagWriter",),
    "design.file": ("load_design", "load_request", "save_design"),
    "design.record": ("Design",),
    "design.request": ("ArmRequest",),
    "design.synthesis": ("synthesise",),
    "errors": ("TsobsError",),
    "estimation.estimator": ("SupervisionOptions",),
    "estimation.records": ("Measurement",),
    "estimation.tracker": ("Tracker", "step_joints"),
    "identification.excitation": ("excite",),
    "identification.fit": ("fit",),
    "identification.result": ("Fit",),
    "methods": ("ObserverSettings", "export_c", "make_tracker"),
    "model.arm": ("ElasticJointArm",),
    "model.ts_model": ("TSModel",),
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    except ModuleNotFoundError as error:
        from tsobs_ros.errors import missing_library

        error.msg = missing_library(error.name) or error.msg
        raise
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__} - {"Any", "TYPE_CHECKING", "import_module"})
