# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Certificates that cover bounded errors of the arm's parameters."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tsobs_ros.design.certificate import check_certificate
from tsobs_ros.design.exact import verify_exactly
from tsobs_ros.design.file import load_design, load_request, parse_design, save_design
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.errors import CertificateError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.uncertainty import ARM_DIRECTIONS, SINE, arm_uncertainty
from tsobs_ros.model.vertices import kick_corners

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=100)
CASES: dict[str, dict[str, float]] = {
    "stiffness": {"stiffness": 0.2},
    "gravity": {"gravity": 0.1},
    "several": {"gravity": 0.05, "link_inverse_inertia": 0.05, "motor_damping": 0.2},
}


@pytest.fixture(scope="module")
def designs() -> Mapping[str, Design]:
    return {
        name: synthesise(ArmRequest(uncertainty=bounds, certify_uncertainty=True))
        for name, bounds in CASES.items()
    }


def kick(request: ArmRequest, slope: float, theta: Array) -> Array:
    """Return the Jacobian of half a kick, from the derivative of the accelerations."""
    arm, half = request.arm, 0.5 / request.rate
    uncertainty = arm_uncertainty(arm, request.uncertainty)
    matrix = np.eye(request.flow.state_count)
    change = np.tensordot(theta, uncertainty.directions[:, 0], 1)
    matrix[:4, :4] += half * change[:, :4]
    matrix[:4, 0] += half * change[:, SINE] * slope
    matrix[1, 0] -= half * arm.gravity_gain * slope
    return matrix


def decrease(design: Design, slopes: Array, thetas: Array) -> float:
    """Return the smallest eigenvalue of X less the covariance after a step from X, per second."""
    request, X, K = design.request, design.covariance_bound, design.K
    before, after = (kick(request, *pair) for pair in zip(slopes, thetas, strict=True))
    closed = np.eye(len(X)) - K @ request.flow.output_matrix
    posterior = closed @ X @ closed.T + K @ request.measurement_covariance @ K.T
    step, T = request.flow.nominal, np.linalg.cholesky(X)
    A = after @ step.phi @ before
    inverse = np.linalg.inv(T)
    gap = inverse @ (X - A @ posterior @ A.T - after @ step.noise @ after.T) @ inverse.T
    return float(np.linalg.eigvalsh(gap)[0]) * request.rate


@PROPERTY
@given(st.data(), st.sampled_from(list(CASES)))
def test_the_bound_decreases_for_every_parameter_within_its_bounds(
    designs: Mapping[str, Design], data: st.DataObject, name: str
) -> None:
    """The parameters of the two half kicks may even differ."""
    design = designs[name]
    lowest, highest = design.request.slope_range
    limits = list(CASES[name].values())
    slopes = np.array([data.draw(st.floats(lowest, highest)) for _ in range(2)])
    thetas = np.array([[data.draw(st.floats(-b, b)) for b in limits] for _ in range(2)])
    assert decrease(design, slopes, thetas) > 0.5e-4


@pytest.mark.parametrize("name", list(CASES))
def test_every_corner_is_reached(designs: Mapping[str, Design], name: str) -> None:
    """The smallest margin of the report is that of a corner of slopes and parameters."""
    design = designs[name]
    limits = list(CASES[name].values())
    signs = list(itertools.product((-1.0, 1.0), repeat=len(limits)))
    smallest = min(
        decrease(design, np.array(slopes), np.array(thetas) * limits)
        for slopes in itertools.product(design.request.slope_range, repeat=2)
        for thetas in itertools.product(signs, repeat=2)
    )
    margins = [each.margin for each in design.certificate.inequalities[1:]]
    assert min(margins) == pytest.approx(smallest, rel=1e-4)


@pytest.mark.parametrize(("name", "vertices"), [("stiffness", 16), ("gravity", 4), ("several", 64)])
def test_vertices_on_one_line_are_left_out(
    designs: Mapping[str, Design], name: str, vertices: int
) -> None:
    request = designs[name].request
    assert len(request.vertices()) == vertices
    assert len(request.vertices(0.5)) == vertices


def test_uncertain_gravity_widens_the_slopes_to_either_side() -> None:
    uncertainty = arm_uncertainty(ElasticJointArm(), {"gravity": 0.25})
    for lowest, expected in ((0.5, (0.375, 1.25)), (-1.0, (-1.25, 1.25)), (0.0, (0.0, 1.25))):
        corners = kick_corners((lowest, 1.0), uncertainty, [0.25])
        assert tuple(corner.slope for corner in corners) == expected
        exact = kick_corners((Fraction(lowest), Fraction(1)), uncertainty, [Fraction(1, 4)])
        assert tuple(float(corner.slope) for corner in exact) == expected


@PROPERTY
@given(st.data(), st.floats(0.05, math.pi))
def test_a_kick_is_a_convex_combination_of_its_corners(data: st.DataObject, x_max: float) -> None:
    """Solved for entry by entry: the kick's entries lie within those of the corners around it."""
    names = data.draw(st.lists(st.sampled_from(list(ARM_DIRECTIONS)), max_size=3, unique=True))
    request = ArmRequest(
        uncertainty=dict.fromkeys(names, 0.3), certify_uncertainty=bool(names), x_max=x_max
    )
    slope = data.draw(st.floats(math.cos(x_max), 1.0))
    theta = np.array([data.draw(st.floats(-0.3, 0.3)) for _ in names])
    inside = kick(request, slope, theta)[[1, 3], :4]
    covered = request.uncertainty_model if names else None
    corners = np.array(
        [
            request.flow._kick_matrix(corner, covered)[[1, 3], :4]
            for corner in kick_corners(request.slope_range, covered, [0.3] * len(names))
        ]
    )
    # In every direction of the space of matrices, some corner is at least as far out.
    rng = np.random.default_rng(len(names))
    for direction in rng.standard_normal((40, 2, 4)):
        reach = np.tensordot(corners, direction, 2)
        assert reach.min() - 1e-12 <= np.sum(inside * direction) <= reach.max() + 1e-12


def test_certified_uncertainty_costs_some_of_the_bound(
    designs: Mapping[str, Design], shipped: Design
) -> None:
    for design in designs.values():
        assert (design.bound_std > shipped.bound_std).all()
        assert (design.bound_std < 3.0 * shipped.bound_std).all()


@pytest.mark.parametrize("name", list(CASES))
def test_it_is_proved_exactly(designs: Mapping[str, Design], name: str) -> None:
    assert verify_exactly(designs[name]).holds


def test_the_proof_of_one_uncertainty_is_none_of_a_larger_one(
    designs: Mapping[str, Design], shipped: Design
) -> None:
    design = designs["stiffness"]
    for bounds in ({"stiffness": 0.22}, {"stiffness": 0.2, "gravity": 0.02}):
        request = replace(design.request, uncertainty=bounds)
        report = check_certificate(request, design.P, design.K)
        assert not report.holds
        assert "stiffness (" in report.worst.where
    asked = replace(shipped.request, uncertainty={"stiffness": 0.05}, certify_uncertainty=True)
    assert not check_certificate(asked, shipped.P, shipped.K).holds
    # Bounds alone ask for no proof.
    silent = replace(shipped.request, uncertainty={"stiffness": 0.05})
    assert check_certificate(silent, shipped.P, shipped.K).holds


def test_a_design_keeps_its_uncertainty_in_its_file(
    designs: Mapping[str, Design], tmp_path: Path
) -> None:
    design, path = designs["stiffness"], tmp_path / "my.yaml"
    save_design(design, path)
    assert load_design(path).request == design.request
    path.write_text(path.read_text().replace("{stiffness: 0.2}", "{stiffness: 0.25}"))
    assert not parse_design(path).certificate.holds
    with pytest.raises(CertificateError, match=r"slopes \(.*\), stiffness \(.*DOES NOT HOLD"):
        load_design(path)


def test_a_request_file_may_ask_for_it(tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    path.write_text("uncertainty: {stiffness: 0.2, gravity: 1e-1}\ncertify_uncertainty: true\n")
    expected = ArmRequest(uncertainty={"stiffness": 0.2, "gravity": 0.1}, certify_uncertainty=True)
    assert load_request(path) == expected
