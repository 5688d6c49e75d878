# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sine, cosine, exponential, logarithm: as near to the true as the system's, everywhere alike."""

import hashlib
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tsobs_ros.checks import Array
from tsobs_ros.core.functions import evaluate

DIGEST = "a3f4288d51aed99f"
"""Of the values at ten thousand angles; independent of machine and C library."""


SYSTEM = {
    "sine": math.sin,
    "cosine": math.cos,
    "exponential": math.exp,
    "logarithm": math.log,
}


def check(function: str, values: Array) -> None:
    """Compare within two units in the last place."""
    system = np.array([SYSTEM[function](x) for x in values.tolist()])
    error = np.abs(evaluate(function, values) - system)
    assert (error <= 2.0 * np.spacing(np.abs(system))).all()


@pytest.mark.parametrize("reach", [1e-3, 0.7, 4.0, 1e3, 1e6])
@pytest.mark.parametrize("function", ["sine", "cosine"])
def test_angles_within_two_units_in_the_last_place(function: str, reach: float) -> None:
    quarters = 0.5 * math.pi * np.arange(-60, 61) * (reach > 1.0)
    drawn = np.random.default_rng(3).uniform(-reach, reach, 20_000)
    check(function, np.concatenate([quarters, drawn]))


def test_exponential_and_logarithm_are_within_two_units_in_the_last_place() -> None:
    check("exponential", np.append(-np.geomspace(1e-17, 745.0, 20_000), 0.0))
    check("logarithm", np.geomspace(1e-320, 1e308, 20_000))
    check("logarithm", 1.0 + np.linspace(-0.3, 0.3, 10_001))
    assert evaluate("exponential", [-800.0, -math.inf]).tolist() == [0.0, 0.0]
    assert np.isnan(evaluate("exponential", math.nan))
    assert np.isnan(evaluate("logarithm", [0.0, -1.0, math.inf, math.nan])).all()


@pytest.mark.parametrize(
    "setting",
    [
        {},
        {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2"},
    ],
    ids=["this CPU", "CPU without fused operations"],
)
def test_the_same_bits_everywhere(setting: dict[str, str]) -> None:
    printed = subprocess.run(
        [sys.executable, __file__],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), **setting},
        check=True,
        capture_output=True,
        text=True,
    )
    assert printed.stdout.strip() == DIGEST


if __name__ == "__main__":
    angles = np.array([math.ldexp(n * (n % 7 + 1), -10) for n in range(-5_000, 5_000)])
    exponentials = evaluate("exponential", -np.abs(angles))
    values = np.stack([evaluate("sine", angles), evaluate("cosine", angles), exponentials], 1)
    print(hashlib.sha256(values.tobytes()).hexdigest()[:16])
