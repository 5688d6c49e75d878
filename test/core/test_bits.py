# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every number is the same to the last bit on any CPU, whatever compiler built the core.

Libraries choose other loops for other CPUs, and other last bits come of them. Environments here
have them choose as they would there, each in a process of its own. Compilers order and join
operations in other ways; builds here are those of each at several levels.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tsobs_ros as ts

pytestmark = pytest.mark.xdist_group("bits")  # its fixtures take seconds

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import other_build
import hashlib, os, sys
from dataclasses import replace
from pathlib import Path
import numpy as np
import tsobs_ros as ts
from tsobs_ros.estimation.estimator import certified_estimator
from tsobs_ros.estimation.state import numbers_of
from tsobs_ros.methods import METHODS, make_estimator
from tsobs_ros.model.arm import TorquePath

from tsobs_ros.core import native

assert os.environ.get("TSOBS_NATIVE", native.__file__) == native.__file__
folder = Path(sys.argv[1])

def show(name, record):
    values = [record] if isinstance(record, np.ndarray) else vars(record).values()
    digest = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray):
            digest.update(np.ascontiguousarray(value).tobytes())
    print(name, digest.hexdigest()[:16])

for file in ("elastic_joint_fixed.design.yaml", "elastic_joint.design.yaml"):
    design = ts.load_design(folder / file)
    request, X = design.request, design.covariance_bound
    show(f"design {file}", X)
    settled = certified_estimator(
        request.flow, request.measurement_covariance, X, design.K, X,
        settle_time=0.0, uncertainty=request.uncertainty_model,
    )
    _, angle, torque = np.load(folder / "arrays.npy")[:, :100, np.newaxis]
    state, rows, work = settled.initial(), [], numbers_of(settled.new_record("work"))
    for y, u in zip(angle, torque):
        state, _ = settled.correct(state, y)
        rows.append(settled.readout(state))
        # `predict` refuses the infinite torque, but a program in C may have it.
        records = numbers_of(settled.model), numbers_of(state)
        native.estimator_predict(*records, u, settled.period, False, work)
    found = np.stack(rows).view(np.recarray)
    # Where θ is learnt, its bounds are not the certificate's.
    assert (found.basis == 0.0).any() == (settled.shape.k == 0)  # certified
    numbers = np.concatenate([found.state, found.state_bound, found.disturbance], axis=1)
    assert np.isnan(numbers[91:]).any()  # after an infinite torque, and not all of one sign
    show("settled", np.where(np.isnan(numbers), np.nan, numbers))
    for method in METHODS if settled.shape.k else ["certified"]:
        settings = ts.ObserverSettings(method=method, settle_time=0.2)
        show(f"model {method}", make_estimator(design, settings).model)
        found = ts.estimate(design, *np.load(folder / "arrays.npy"), settings=settings)
        show(f"arrays {method}", found)
        (found,) = ts.estimate_bag(folder / "bag", design, settings=settings).joints.values()
        show(f"bag {method}", found)
late = replace(design, request=replace(request, torque=TorquePath(0.9, 0.5, 0.0117)))
show("late torque", ts.estimate(late, *np.load(folder / "arrays.npy")))
show("simulated late torque", ts.simulate(late, duration=0.5, seed=3))
disturbed = {"mismatch": {"stiffness": 0.2}, "disturbance": "bias_step+sinusoid"}
show("simulation", ts.simulate(duration=0.5, seed=3, **disturbed))
"""
CORES: tuple[str, ...] = ("Prescott", "Haswell", "Nehalem")
if "TSOBS_OTHER_CPU" in os.environ:
    CORES = (*CORES, "SkylakeX", "Zen", "Sandybridge")
ENVIRONMENTS: dict[str, dict[str, str]] = {
    core: {"OPENBLAS_CORETYPE": core, "OPENBLAS_NUM_THREADS": str(1 + number % 2)}
    for number, core in enumerate(CORES)
}
ENVIRONMENTS["Prescott"]["NPY_DISABLE_CPU_FEATURES"] = "FEATURES"
ENVIRONMENTS["Nehalem"]["GLIBC_TUNABLES"] = "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F,-FMA4"
CONFIG = ROOT / "config"
COMPILERS = tuple(filter(shutil.which, ("gcc", "clang")))
# As setup.py has them, but for the level; and no warning is left.
FLAGS = (
    *("-std=c99", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden"),
    *("-Wall", "-Wextra", "-Werror", "-DPy_LIMITED_API=0x030B0000", "-fPIC", "-shared"),
)


def has_avx2() -> bool:
    """Return whether the CPU has the instructions of -march=haswell."""
    path = Path("/proc/cpuinfo")
    return path.exists() and {"avx2", "fma", "bmi2"} <= set(path.read_text("ascii").split())


LEVELS = ["-O0", "-O2", *(["-O3 -march=haswell"] if has_avx2() else [])]
BUILDS = [f"{compiler} {level}" for compiler in COMPILERS for level in LEVELS]


def all_but_first_slow(names: Iterable[str]) -> list[Any]:
    return [
        pytest.param(name, marks=pytest.mark.slow if place else (), id=name)
        for place, name in enumerate(names)
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag and arrays with jitter, late and lost samples, an outlier, a gap and a jump."""
    folder = tmp_path_factory.mktemp("bits")
    for name in ("elastic_joint_fixed.design.yaml", "elastic_joint.design.yaml"):
        (folder / name).write_bytes((CONFIG / name).read_bytes())
    run = ts.simulate(duration=3.0, seed=5, mismatch={"stiffness": 0.2})
    keep = np.r_[0:120, 480:600]
    time, angle, torque = run.time[keep] + 10.0, run.angle[keep], run.torque[keep]
    time = np.round(time + 1e-3 * np.sin(17.0 * np.arange(len(keep))), 6)
    angle[60] += 1.0
    angle[170:] += 0.3
    torque[[40, 90]] += 30.0, np.inf
    torque[100:110] -= 5.0
    rows = np.column_stack([time, angle, torque])
    np.savetxt(folder / "log.csv", rows, delimiter=",", header="time,angle,torque", comments="")
    ts.estimate_bag(
        folder / "log.csv", str(folder / "elastic_joint.design.yaml"), rate=150.0,
        output=folder / "bag",
    )  # fmt: skip
    order = np.arange(len(keep))
    order[[20, 30]], order[[130, 131]], angle[200] = order[[30, 20]], order[[131, 130]], np.nan
    np.save(folder / "arrays.npy", np.array([time, angle, torque])[:, order])
    return folder


def numbers_of(folder: Path, environment: dict[str, str]) -> str:
    if "NPY_DISABLE_CPU_FEATURES" in environment:
        features = np.show_config(mode="dicts")["SIMD Extensions"]["found"]
        environment = {**environment, "NPY_DISABLE_CPU_FEATURES": " ".join(features)}
    paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", PROGRAM, folder],
        env={**os.environ, "PYTHONPATH": paths.strip(os.pathsep), **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def reference(folder: Path) -> str:
    """What the installed core computes here."""
    numbers = numbers_of(folder, {})
    assert len(set(numbers.split()[2::3])) > 8
    return numbers


def differing(numbers: str, reference: str) -> list[str]:
    return sorted(set(numbers.splitlines()) ^ set(reference.splitlines()))


@pytest.mark.parametrize("cpu", all_but_first_slow(ENVIRONMENTS))
def test_all_numbers_are_the_same_bits_whatever_the_cpu(
    cpu: str, folder: Path, reference: str
) -> None:
    assert differing(numbers_of(folder, ENVIRONMENTS[cpu]), reference) == []


@pytest.mark.parametrize("build", all_but_first_slow(BUILDS))
def test_all_numbers_are_the_same_bits_whatever_the_compiler(
    build: str, folder: Path, reference: str, tmp_path: Path
) -> None:
    library, sources = tmp_path / "native.so", (ROOT / "tsobs_ros" / "core").glob("*.c")
    include = f"-I{sysconfig.get_path('include')}"
    command = [*build.split(), *FLAGS, include, *sorted(map(str, sources)), "-lm", "-o", library]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert differing(numbers_of(folder, {"TSOBS_NATIVE": str(library)}), reference) == []
