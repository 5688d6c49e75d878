# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What `tsobs design` and `tsobs verify` say about a design."""

from typing import Any


def summary(result: Any) -> dict[str, Any]:
    """Return the design's certificate, gain and bounds as plain data."""
    certificate = result.certificate
    return {
        "holds": certificate.holds,
        "inequalities": [
            {**inequality._asdict(), "holds": inequality.holds}
            for inequality in certificate.inequalities
        ],
        "contraction_rate": certificate.contraction_rate,
        "gain": result.K[:, 0].tolist(),
        "bound_std": result.bound_std.tolist() if certificate.holds else None,
        "disturbance": result.request.disturbance_model.label,
        "x_max": result.request.x_max,
        "rate": result.request.rate,
        "solver": f"{result.solver.name} {result.solver.version}",
        "solver_status": result.solver.status,
    }


def summary_text(result: Any) -> str:
    """Return the same for people to read."""
    request, certificate = result.request, result.certificate
    lines = [
        f"disturbance {request.disturbance_model.label}, |q1| <= {request.x_max:.4g} rad, "
        f"{request.rate:g} Hz; {result.solver.name} {result.solver.version}: "
        f"{result.solver.status}",
        *(f"  {inequality}" for inequality in certificate.inequalities),
    ]
    if certificate.holds:
        names = ["link angle [rad]", "link velocity [rad/s]", "motor angle [rad]"]
        names += ["motor velocity [rad/s]"]
        names += [f"disturbance state {i + 1}" for i in range(result.K.shape[0] - 4)]
        lines.append("certified 1-sigma bounds before a sample:")
        lines += [
            f"  {name:<24}{bound:.5f}" for name, bound in zip(names, result.bound_std, strict=True)
        ]
    return "\n".join(lines)
