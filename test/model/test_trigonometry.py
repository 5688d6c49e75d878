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

from tsobs_ros.core.native import cosine, exponential, logarithm, sine, unbranched_sine

DIGEST = "a3f4288d51aed99f"
"""Of the values at ten thousand angles; independent of machine and C library."""


@pytest.mark.parametrize("reach", [1e-3, 0.7, 4.0, 1e3, 1e6])
def test_within_two_units_in_the_last_place(reach: float) -> None:
    quarters = 0.5 * math.pi * np.arange(-60, 61) * (abs(reach) > 1.0)
    drawn = np.random.default_rng(3).uniform(-reach, reach, 20_000)
    for angle in [*quarters.tolist(), *drawn.tolist()]:
        for ours, system in ((sine(angle), math.sin(angle)), (cosine(angle), math.cos(angle))):
            assert abs(ours - system) <= 2.0 * math.ulp(system)
        assert unbranched_sine(angle) == sine(angle)


def test_the_exponential_is_within_two_units_in_the_last_place() -> None:
    for x in [0.0, *(-np.geomspace(1e-17, 745.0, 20_000)).tolist()]:
        assert abs(exponential(x) - math.exp(x)) <= 2.0 * math.ulp(math.exp(x))
    assert exponential(-800.0) == exponential(-math.inf) == 0.0
    assert math.isnan(exponential(math.nan))


def test_the_logarithm_is_within_two_units_in_the_last_place() -> None:
    near_one = 1.0 + np.linspace(-0.3, 0.3, 10_001)
    for x in [*near_one.tolist(), *np.geomspace(1e-320, 1e308, 20_000).tolist()]:
        assert abs(logarithm(x) - math.log(x)) <= 2.0 * math.ulp(math.log(x))
    for x in (0.0, -1.0, math.inf, math.nan):
        assert math.isnan(logarithm(x))


def test_of_huge_angles_as_exact_as_the_angle_and_of_infinite_ones_nan() -> None:
    for angle in (1e7, -1e9, 1e12):
        assert math.isnan(unbranched_sine(angle))
        assert sine(angle) == pytest.approx(math.sin(angle), abs=math.ulp(angle))
        assert cosine(angle) == pytest.approx(math.cos(angle), abs=math.ulp(angle))
    assert abs(sine(1e300)) <= 1.0
    for angle in (math.inf, -math.inf, math.nan):
        assert math.isnan(sine(angle))
        assert math.isnan(unbranched_sine(angle))
        assert math.isnan(cosine(angle))


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
    angles = [math.ldexp(n * (n % 7 + 1), -10) for n in range(-5_000, 5_000)]
    values = np.array([[sine(x), cosine(x), exponential(-abs(x))] for x in angles])
    print(hashlib.sha256(values.tobytes()).hexdigest()[:16])
