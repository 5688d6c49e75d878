# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The front door: a light import, names that are there, and arrays in and out of the same core."""

import doctest
import inspect
import re
import subprocess
import sys
import warnings
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.design.record import Design
from tsobs_ros.methods import CERTIFIED, METHODS, warning
from tsobs_ros.report.export import export_bag
from tsobs_ros.resources import config_path

ROOT = Path(__file__).resolve().parents[1]
LOG = ROOT / "docs" / "examples" / "arm_log.csv"
WITH_EXAMPLES = [
    path for path in sorted((ROOT / "tsobs_ros").rglob("*.py")) if ">>> " in path.read_text("utf-8")
]


def test_the_import_is_light() -> None:
    code = "import sys, tsobs_ros, tsobs_ros.stop; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    modules = {name.partition(".")[0] for name in run.stdout.split()}

    assert "tsobs_ros" in modules
    assert modules.isdisjoint({"numpy", "scipy", "yaml", "mcap", "rclpy", "msgspec"})


def test_every_name_is_there_and_explained() -> None:
    assert set(ts.__all__) <= set(dir(ts))
    assert not {"Any", "TYPE_CHECKING", "import_module"} & set(dir(ts))
    for name in ts.__all__:
        assert inspect.getdoc(getattr(ts, name)), name
        assert f"\n    {name} " in (ts.__doc__ or ""), f"help(tsobs_ros) does not explain {name}"
        # An imported module of this name would take the place of the lazy one.
        assert not list((ROOT / "tsobs_ros").glob(f"{name}*/")), f"{name} is a folder, too"
    with pytest.raises(AttributeError, match="no attribute 'observe'"):
        _ = ts.observe


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_in_docstrings_hold(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    module = import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))

    result = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE)

    assert result.attempted
    assert not result.failed


def test_a_simulation_is_reproducible_and_in_physical_units(design: Design) -> None:
    run = ts.simulate(design, duration=1.0, seed=3, noise_std=0.0, torque=2.0)
    again = ts.simulate(design.request.arm, duration=1.0, seed=3, noise_std=0.0, torque=lambda t: 2)

    assert np.array_equal(run.state, again.state)
    assert np.array_equal(run.angle, run.state[:, 0])
    assert run.torque.tolist() == [2.0] * 201
    # Angles and velocities fit: the trapezoidal rule's error at 5 ms is of 1e-4.
    moved = np.cumsum((run.state[1:, 1::2] + run.state[:-1, 1::2]) / 2 * 0.005, axis=0)
    assert moved == pytest.approx(run.state[1:, 0::2] - run.state[0, 0::2], abs=1e-3)

    step = {"bias_step": {"amplitude": 0.2, "start": 0.5}}
    disturbed = ts.simulate(duration=1.0, disturbance=step).disturbance
    assert disturbed.tolist() == [0.0] * 100 + [0.2] * 101


def test_shapes_depend_on_the_design_alone(design: Design) -> None:
    both = ts.load_design(ROOT / "test/estimation/data/both_encoders.design.yaml")
    time = 0.005 * np.arange(1, 20)
    for one, p in ((design, ()), (both, (2,))):
        for angle in (0.0, np.zeros((19, *(p or (1,))))):
            made = ts.estimate(one, time, angle, 0.0)
            assert made.disturbance.shape == made.innovation.shape == (19, *p)


def test_masked_samples_are_missing(design: Design) -> None:
    run = ts.simulate(design, duration=1.0, seed=3)
    masked = np.ma.array(run.angle, mask=np.arange(201) % 3 == 0)
    masked.data[masked.mask] = 9.0
    each = masked, masked.filled(np.nan)
    made, missing = (ts.estimate(design, run.time, angle, run.torque) for angle in each)
    assert made.state.tobytes() == missing.state.tobytes()
    tracker = ts.make_tracker(design)
    tracker.offer(ts.Measurement(5_000_000, y=masked[:1], u=run.torque[:1]), now=5_000_000)
    assert tracker.used == 0


@pytest.fixture(scope="module")
def example_1() -> Design:
    return ts.load_design(config_path("paper_example_1.design.yaml"))


def test_a_time_after_which_every_sample_would_be_a_start_is_refused(example_1: Design) -> None:
    slow = replace(example_1, request=replace(example_1.request, rate=0.2))
    with pytest.raises(
        ts.TsobsError, match=r"stale_after: .* period, 5 s, got 5 s, with which every"
    ):
        ts.make_tracker(slow)
    assert ts.make_tracker(slow, ts.ObserverSettings(stale_after=6.0)).used == 0


@pytest.mark.parametrize("method", METHODS)
def test_a_system_is_observed_by_the_methods_that_fit(method: str, example_1: Design) -> None:
    """At rest with a disturbance on the second output; the others see no state move."""
    settings = ts.ObserverSettings(method=method)
    if method not in (*CERTIFIED, "ekf", "paper"):
        with pytest.raises(ts.TsobsError, match=f"method {method}: expected a design for an arm"):
            ts.make_tracker(example_1, settings)
        return
    time = np.arange(0.0, 4.0, example_1.request.period)
    y = np.zeros((len(time), 3))
    y[:, 1] = 0.2
    estimates = ts.estimate(example_1, time, y, np.zeros((len(time), 2)), settings=settings)
    assert np.abs(estimates.state[-1]).max() < 0.02
    np.testing.assert_allclose(estimates.disturbance[-1], [0.0, 0.2, 0.0], atol=0.02)
    assert estimates.in_domain.all()
    assert np.isnan(estimates.state_bound).all() == (method == "paper")
    assert ("open-loop simulation" in warning(example_1, method)) == (method == "paper")


def test_a_ts_system_is_simulated_and_estimated_by_its_design(example_1: Design) -> None:
    design = example_1
    run = ts.simulate(
        design, duration=3.0, seed=1, mismatch={"delta": 0.5}, initial_state=[0.5, 0.7, 0.5]
    )

    assert run.angle.shape == run.state.shape == (751, 3)
    # The second signal is scheduled, and the first output as it is measured.
    np.testing.assert_allclose(run.torque[:, 0], np.sin(run.time), atol=1e-12)
    assert run.torque[:, 1].tobytes() == run.angle[:, 0].tobytes()
    estimates = ts.estimate(design, run.time, run.angle, run.torque)
    errors = np.abs(estimates.state - run.state)[250:]
    assert (errors < 3.0 * estimates.state_bound[250:]).mean() > 0.97
    with pytest.raises(ts.TsobsError, match="expected none for a T-S system"):
        ts.simulate(design, payload={"mass": 1.0})


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"disturbance": "bias"}, "disturbance kind: expected none or a sum of"),
        ({"disturbance": {"ramp": {"slope": 1.0}}}, "'slope': expected one of rate, start"),
        ({"disturbance": [{"kind": "ramp"}]}, "a mapping from kinds to their parameters.*got {"),
        ({"payload": 3.0}, "expected a mapping from .*mass.*, got 3.0"),
        ({"mismatch": {"mass": 0.1}}, "mismatch: expected some of link_inertia"),
        ({"torque": [1.0, 2.0]}, r"torque: expected shape \(201,\) or \(201, 1\).*got \(2,\)"),
        ({"torque": np.full(201, 1e308)}, "simulate: the state is not finite from 0.0"),
        ({"torque_disturbance": {"elbow": "ramp"}}, "torque_disturbance: expected some of motor"),
        ({"rate": 1e-9}, "rate: expected a finite number of at least 0.01 Hz, got 1e-09"),
        ({"duration": "long"}, "duration: expected a finite number"),
        ({"arm": 3}, "arm: expected a Design .* or the path of its file, got int"),
        ({"duration": 1e300}, "duration: expected at most 100,000,000 samples"),
        ({"time": 1.0}, r"time: expected shape \(n,\) with n > 0, got \(\)"),
        ({"time": [0.0, np.nan]}, r"time\[1\]: expected finite seconds"),
        ({"time": [0.0, 5e9]}, r"time\[1\]: .* got 5000000000.0; divide nanoseconds by 1e9"),
        ({"time": [], "angle": []}, r"time: expected shape \(n,\) with n > 0, got \(0,\)"),
        ({"angle": [0, 0, 0]}, r"angle: expected shape .* there are 2 times, got \(3,\)"),
        ({"angle": ["a", "b"]}, "angle: expected real numbers"),
        ({"angle": np.zeros(2, complex)}, "angle: expected real numbers"),
    ],
)
def test_what_makes_no_sense_is_refused(design: Design, options, match) -> None:
    def call() -> None:
        if {"time", "angle"}.isdisjoint(options):
            ts.simulate(**{"duration": 1.0, **options})
        ts.estimate(design, **{"time": [0.0, 0.1], "angle": [0, 0], "torque": 0, **options})

    with pytest.raises(ts.TsobsError, match=match):
        call()


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: ts.make_tracker("a.yaml"), "design: expected a Design .*, got 'a.yaml'"),
        (lambda: ts.export_c(3, "a.c"), "design: expected a Design .*, got 3"),
        (lambda: ts.save_design("a.yaml", "b.yaml"), "design: expected Design, got 'a.yaml'"),
        (lambda: ts.synthesise("a.yaml"), "request: expected a request, .* got 'a.yaml'"),
        (lambda: ts.excite(LOG), "request: expected an ArmRequest, .* got .*Path"),
        (lambda: ts.estimate_bag(LOG, settings=3), "settings: expected an ObserverSettings, got 3"),
        (lambda: ts.make_tracker(ts.load_design(), 3), "settings: expected an .*, got 3"),
        (lambda: ts.load_design().observer(gain_mode="best"), "gain_mode: expected .*riccati, got"),
        (lambda: ts.ArmRequest(certify_uncertainty="no"), "expected True or False, got 'no'"),
        (lambda: ts.ArmRequest(disturbance="bias"), "^disturbance: expected a list of .*'bias'"),
        (lambda: ts.ArmRequest(disturbance=[{"kind": "bias"}]), "disturbance: expected a list of"),
        (
            lambda: ts.ArmRequest(outputs=["link_angle"]),
            r"outputs\[0\]: expected Output, got 'link",
        ),
        (lambda: ts.ArmRequest(uncertainty=None), "uncertainty: expected Mapping, got None"),
        (lambda: ts.ArmRequest(None), "arm: expected ElasticJointArm, got None"),
        (lambda: ts.fit(ts.ArmRequest(), LOG, topic="/a"), "--topic is for bags"),
        (lambda: ts.simulate(rate=0), "rate: expected a finite number of at least 0.01 Hz, got 0"),
    ],
)
def test_arguments_of_other_types_are_named(call, match: str) -> None:
    with pytest.raises(ts.TsobsError, match=match):
        call()


def test_text_is_no_setting_of_another_type() -> None:
    with pytest.raises(ts.TsobsError, match="parameter 'adapt': expected true or false, got"):
        ts.ObserverSettings(adapt="false")  # type: ignore[arg-type]


def test_estimates_from_arrays_are_those_of_a_tracker(design: Design) -> None:
    run = ts.simulate(design, duration=2.0, seed=2)

    estimates = ts.estimate(design, run.time + 5.0, run.angle.tolist(), run.torque)

    tracker = ts.make_tracker(design)
    for row in range(401):
        stamp = 5_000_000_000 + row * 5_000_000
        sample = ts.Measurement(stamp, run.angle[row, np.newaxis], run.torque[row, np.newaxis])
        tracker.offer(sample, stamp)
        one = tracker.estimate(stamp)
        for name in ("state", "state_bound", "disturbance", "disturbance_bound", "parameters"):
            assert np.array_equal(np.ravel(getattr(estimates, name)[row]), getattr(one, name)), name
        assert estimates.certified[row] == (one.basis.name == "CERTIFIED")
    assert (estimates.used, estimates.rejected) == (401, {})
    assert np.isfinite(estimates.innovation).all()
    assert np.array_equal(estimates.innovation_time, run.time + 5.0)


def test_a_log_is_estimated_as_its_arrays_are(design: Design) -> None:
    time, angle, torque = np.loadtxt(LOG, delimiter=",", skiprows=1).T

    (whole,) = ts.estimate_bag(LOG, design).joints.values()
    arrays = ts.estimate(design, time, angle * (np.pi / 180), torque)

    for name in ("time", "state", "state_bound", "disturbance", "innovation", "certified"):
        assert np.array_equal(getattr(whole, name), getattr(arrays, name)), name


@pytest.mark.parametrize(
    ("shuffled", "time_unit", "angle_unit", "texts"),
    [
        (False, 1.0, 1.0, []),
        (True, 1.0, 1.0, [r"time\[3\] is earlier than .* 0.5 s: .*; sort them by time", "too old"]),
        (False, 1e3, 1.0, ["at 0.2 Hz, the design is for 200 Hz: .*, or is the time in"]),
        (False, 1.0, 57.3, ["innovations are .* times as large"]),
        (False, 1.0, 1e300, [r"100 % of the measurements were rejected \(most: gated\): .* rad"]),
    ],
)
def test_measurements_of_another_kind_cause_a_warning(
    design: Design, shuffled: bool, time_unit: float, angle_unit: float, texts: list[str]
) -> None:
    # Milliseconds read as seconds make each step a gap of seconds, which takes long to predict.
    duration = 8.0 if time_unit == 1.0 else 2.0
    run = ts.simulate(design, duration=duration, seed=1, disturbance="bias_step")
    count = len(run.time)
    order = np.random.default_rng(0).permutation(count) if shuffled else np.arange(count)
    time, angle = run.time[order] * time_unit, run.angle[order] * angle_unit

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ts.estimate(design, time, angle, run.torque[order])

    assert len(caught) == len(texts)
    for one, text in zip(caught, texts, strict=True):
        assert re.search(text, str(one.message))
        assert one.filename == __file__


def test_bad_measurements_are_rejected_and_counted(design: Design) -> None:
    run = ts.simulate(design, duration=2.0)
    time, angle = run.time.copy(), run.angle.copy()
    angle[50] = np.nan
    time[100], time[200] = time[99], time[201]
    time[300] = 0.0

    with pytest.warns(UserWarning, match=r"time\[300\] is earlier .*: 1 of 401 samples are not"):
        estimates = ts.estimate(design, time, angle, run.torque)

    with pytest.warns(UserWarning, match="no estimate was made; rejected: non-finite"):
        ts.estimate(design, run.time, run.angle * np.nan, run.torque)
    assert estimates.rejected == {"non-finite": 1, "duplicate stamp": 2, "too old": 1}
    assert estimates.used == 397
    used = np.ones(401, bool)
    used[[50, 100, 201, 300]] = False
    assert np.array_equal(estimates.innovation_time, time[used])
    # The row of a lost measurement is a prediction.
    assert np.isfinite(estimates.state[50]).all()


def test_paths_may_be_text(tmp_path: Path, design: Design) -> None:
    design_file, bag = str(tmp_path / "x.yaml"), str(tmp_path / "bag")
    ts.save_design(design, design_file)
    assert ts.load_design(design_file).request == design.request
    assert ts.estimate(design_file, [0.0], [0.1], 0.0).used == 1
    assert len(ts.simulate(design_file, duration="0.5").time) == 101  # type: ignore[arg-type]
    assert ts.load_request(str(config_path("elastic_joint.request.yaml"))) == design.request

    ts.estimate_bag(str(LOG), design_file, output=bag)
    assert len(ts.compare(bag, design_file, methods=["certified", "ekf"])) == 2
    assert ts.BagReader(bag).topics
    ts.BagWriter(str(tmp_path / "new")).close()
    (exported,) = export_bag(bag, str(tmp_path / "csv"), topics=["/joint_measurements"])
    assert exported.path.is_file()
