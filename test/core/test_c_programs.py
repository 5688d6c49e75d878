# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The program of examples/c steps exported designs to the bits of Python, whatever the compiler."""

import os
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.checks import Array
from tsobs_ros.cli.main import main
from tsobs_ros.core import native
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output
from tsobs_ros.estimation.records import Measurement
from tsobs_ros.model.arm import TorquePath
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path

pytestmark = pytest.mark.xdist_group("c program")  # its fixtures take seconds

ROOT = Path(__file__).resolve().parents[2]
CORE = ROOT / "tsobs_ros" / "core"
PROGRAM = ROOT / "examples" / "c" / "step_log.c"
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")


def run(*command: Any, **options: Any) -> "subprocess.CompletedProcess[str]":
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, **options)
    assert (done.returncode, done.stderr) == (0, "")
    return done


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program, built by the instruction in it and on its page."""

    def lines(text: str) -> str:
        found = re.search(r"cc -std=c99 .*?-o step_log", text.replace(" * ", " "), re.DOTALL)
        assert found is not None
        return re.sub(r"\s*\\\n\s*", " ", found[0])

    command, built = lines(PROGRAM.read_text("utf-8")), tmp_path_factory.mktemp("c") / "step_log"
    assert lines((ROOT / "docs" / "c_programs.md").read_text("utf-8")) == command
    if shutil.which("cc") is None:
        pytest.skip("no compiler")
    command = command.replace("-o step_log", f"-o {built}")
    run("sh", "-c", command, cwd=ROOT, env={**os.environ, "CORE": str(CORE)})
    return built


@pytest.mark.parametrize(
    "compiler", [("gcc", "-std=c99"), ("g++", "-x", "c++"), ("clang", "-std=c99")]
)
def test_the_program_is_c_and_cplusplus_without_a_warning(
    compiler: tuple[str, ...], tmp_path: Path
) -> None:
    if shutil.which(compiler[0]) is None:
        pytest.skip("not installed")
    run(*compiler, *WARNINGS, f"-I{CORE}", "-c", PROGRAM, "-o", tmp_path / "program.o")


@pytest.mark.slow
def test_the_library_of_the_page_shows_only_the_functions_of_its_header(tmp_path: Path) -> None:
    if shutil.which("cmake") is None:
        pytest.skip("not installed")
    page = (ROOT / "docs" / "c_programs.md").read_text("utf-8")
    (listed,) = re.findall(r"```cmake\n(.*?)```", page, re.DOTALL)
    head = "cmake_minimum_required(VERSION 3.16)\nproject(page C)\n"
    (tmp_path / "CMakeLists.txt").write_text(head + listed, "utf-8")
    run("cmake", "-S", tmp_path, "-B", tmp_path / "build", f"-DCORE={CORE}")
    run("cmake", "--build", tmp_path / "build")
    shown = run("nm", "-D", "--defined-only", tmp_path / "build" / "libtsobs.so").stdout
    names, header = set(re.findall(r" T (\w+)", shown)), (CORE / "tsobs.h").read_text("utf-8")
    assert {"tsobs_exported_open", "tsobs_offer"} <= names
    assert [name for name in names if not (name.startswith("tsobs_") and name in header)] == []


def two_outputs() -> Design:
    pytest.importorskip("cvxpy")
    outputs = (
        Output("link_angle", 0.005, (DisturbanceTerm("bias"),)),
        Output("motor_angle", 0.002),
    )
    return ts.synthesise(ArmRequest(outputs=outputs))


def late_torque() -> Design:
    design = ts.load_design(config_path(SHIPPED_DESIGN))
    return replace(design, request=replace(design.arm_request, torque=TorquePath(0.9, 0.5, 0.0117)))


DESIGNS: dict[str, Callable[[], Design]] = {
    "late torque": late_torque,
    "adaptive": lambda: ts.load_design(config_path(SHIPPED_DESIGN)),
    "fixed": lambda: ts.load_design(config_path(FIXED_DESIGN)),
    "two outputs": two_outputs,
}


@pytest.fixture(scope="module", params=DESIGNS)
def design(request: pytest.FixtureRequest) -> Design:
    return DESIGNS[request.param]()


def log_of(design: Design) -> tuple[Array, Array, Array]:
    """Return a log with jitter, a gap, a jump, outliers, and late, lost and doubled samples."""
    run_ = ts.simulate(design, duration=8.0, seed=7, mismatch={"stiffness": 0.1})
    keep = np.r_[0:700, 900:1500]
    time = np.round(run_.time[keep] + 2.0 + 1e-4 * np.sin(17.0 * np.arange(len(keep))), 6)
    angle = run_.angle[keep].reshape(len(keep), -1).copy()
    torque = run_.torque[keep].copy()
    angle[300, 0] += 1.0
    angle[500:, 0] += 0.2
    angle[[310, 311]] = np.nan
    torque[[40, 90]] += 30.0, np.inf
    torque[800:900] -= 15.0
    order = np.arange(len(keep))
    order[[20, 30]], order[[430, 431]], order[50] = order[[30, 20]], order[[431, 430]], 49
    return time[order], angle[order], torque[order]


def of_python(
    design: Design, settings: ts.ObserverSettings, time: Array, angle: Array, torque: Array
) -> Array:
    tracker = ts.make_tracker(design, settings)
    rows = np.full((len(time), tracker.estimator.row_type.itemsize // 8), np.nan)
    now = 0
    for at, y, u, row in zip(time.tolist(), angle, torque.tolist(), rows, strict=True):
        stamp = round(at * 1e9)
        now = max(now, stamp)
        tracker.offer(Measurement(stamp, y, np.array([u])), now)
        if (estimate := tracker.estimate(stamp)) is not None:
            row[:] = np.hstack([np.asarray(each, np.float64) for each in estimate[1:]])
    return rows


@pytest.mark.parametrize("method", ["certified", "ekf"])
def test_every_bit_is_that_of_python(
    design: Design, program: Path, tmp_path: Path, method: str
) -> None:
    settings = ts.ObserverSettings(method=method)
    time, angle, torque = log_of(design)
    table = np.column_stack([time, angle, torque])
    lines = [",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in table]
    log, file = tmp_path / "log.csv", tmp_path / "my_arm.tsobs"
    log.write_text("\n".join(["time,outputs,torque", *lines[:9], "", *lines[9:], ""]), "ascii")
    ts.export_c(design, file, settings)

    done = run(program, file, log)

    names, *printed = [line.split(",") for line in done.stdout.splitlines()]
    expected = of_python(design, settings, time, angle, torque)
    assert len(names) == 1 + expected.shape[1]
    found = np.full_like(expected, np.nan)
    for row, line in zip(found, printed, strict=True):
        if len(line) > 1:
            row[:] = [float(each) for each in line[1:]]
    assert np.isfinite(expected).all(axis=1).mean() > 0.99
    np.testing.assert_array_equal(found, expected)
    assert found.tobytes() == np.where(np.isnan(expected), np.nan, expected).tobytes()
    awake = len(set(found[:, names.index("hypothesis_1") - 1])) > 1
    assert awake == (method == "certified")


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("words") / "x.tsobs"
    ts.export_c(DESIGNS["fixed"](), path, max_steps=4)
    return np.fromfile(path, "<i8")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: w[:2], "no design that `tsobs export-c` wrote"),
        (lambda w: w[:-1], "incomplete or damaged"),
        (lambda w: np.append(w, 0), "incomplete or damaged"),
        (lambda w: w.byteswap(), "no design that `tsobs export-c` wrote, or of another byte order"),
        (lambda w: {0: 0}, "no design that `tsobs export-c` wrote"),
        (lambda w: {1: 1}, "exported by another version of tsobs_ros"),
        (lambda w: {2: 2**62}, "incomplete or damaged"),
        (lambda w: {100: -1}, "incomplete or damaged"),
    ],
)
def test_a_file_that_is_not_whole_or_of_another_version_is_refused(
    change: Callable[[Any], Any], message: str, words: Any
) -> None:
    changed = change(words)
    if isinstance(changed, dict):
        ((place, value),), changed = changed.items(), words.copy()
        changed[place] = value

    with pytest.raises(ValueError, match=f"exported_open: {re.escape(message)}"):
        native.exported_open(changed)


@pytest.mark.parametrize("length", [3, 4, 20])
def test_a_sealed_file_that_is_shorter_than_its_records_is_refused(length: int) -> None:
    words = np.zeros(length, np.int64)
    native.exported_seal(words)

    with pytest.raises(ValueError, match="exported_open: incomplete or damaged"):
        native.exported_open(words)


def test_what_cannot_be_exported_is_said(tmp_path: Path) -> None:
    design, path = DESIGNS["fixed"](), tmp_path / "x.tsobs"
    with pytest.raises(ts.TsobsError, match="method ekf_augmented: the design calls no parameter"):
        ts.export_c(design, path, ts.ObserverSettings(method="ekf_augmented"))
    with pytest.raises(ts.TsobsError, match="max_steps: expected 1 to 1000000, got 0"):
        ts.export_c(design, path, max_steps=0)
    assert not path.exists()


def test_the_command_writes_what_the_settings_say(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.tsobs"
    command = ["export-c", str(config_path(SHIPPED_DESIGN)), "--output", str(path)]
    assert main([*command, "--param", "adapt=false,history=0.0", "--max-steps", "1"]) == 0
    out = capsys.readouterr().out
    assert re.match(rf"{path}: [\d,]+ bytes; a tracker needs [\d,]+ bytes of memory", out)
    settings = replace(ts.ObserverSettings(), adapt=False, history=0.0)
    design = ts.load_design(config_path(SHIPPED_DESIGN))
    ts.export_c(design, again := tmp_path / "again.tsobs", settings, max_steps=1)
    assert path.read_bytes() == again.read_bytes()

    assert main(command) == 1
    assert "exists already; --force replaces it" in capsys.readouterr().err
    assert main([*command, "--force"]) == 0
