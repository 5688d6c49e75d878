# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a sample of the unscented Kalman filter: ours, and bayesian-filters' with the same model.

Both take turns on the same samples. The library's state function is ours, compiled.
"""

import time

import numpy as np
from bayesian_filters.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from common import at_least, design_of, parser, show, use_one_thread

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.methods import make_ekf
from tsobs_ros.model.trigonometry import sine
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

_TURN = 200


@compiled
def _moved(x: Array, phi: Array, drive: Array, half_kick: float) -> Array:
    """Return a state one step later: half a kick by gravity, the linear flow, half a kick."""
    n, kicked, moved = len(x), x.copy(), drive.copy()
    kicked[1] -= half_kick * sine(x[0])
    for i in range(n):
        for j in range(n):
            moved[i] += phi[i, j] * kicked[j]
    moved[1] -= half_kick * sine(moved[0])
    return moved


def _costs(design: Design, seconds: float) -> dict[str, float]:
    """Return the median times of a sample [µs]."""
    flow, runs = design.arm_request.flow, simulate(SCENARIOS["noise"], [1], seconds)
    y, u, step = runs.measurements[0], runs.torques[0], flow.nominal
    n, period = flow.state_count, flow.period
    stamps = NANOSECONDS + np.round(runs.times * NANOSECONDS).astype(np.int64)
    library = UnscentedKalmanFilter(
        n,
        1,
        period,
        lambda x: flow.output_matrix @ x,
        None,
        MerweScaledSigmaPoints(n, 1.0, 2.0, 0.0),
    )
    library.P, library.Q = design.request.initial_covariance.copy(), step.noise
    library.R = design.request.measurement_covariance
    ours = make_ekf(design, unscented=True)
    ours.follow(stamps[:_TURN], y[:_TURN], u[:_TURN])
    _moved(library.x, step.phi, library.x, step.half_kick)
    times: dict[str, list[float]] = {"ours": [], "bayesian-filters": []}
    for begin in range(0, len(y) - _TURN + 1, _TURN):
        part = slice(begin, begin + _TURN)
        start = time.perf_counter()
        ours.follow(stamps[part], y[part], u[part])
        times["ours"].append((time.perf_counter() - start) / _TURN)
        start = time.perf_counter()
        for sample in range(part.start, part.stop):
            library.update(y[sample])
            drive = step.gamma @ u[sample]
            library.predict(fx=lambda x, _, d=drive: _moved(x, step.phi, d, step.half_kick))
        times["bayesian-filters"].append((time.perf_counter() - start) / _TURN)
    return {name: 1e6 * float(np.median(each)) for name, each in times.items()}


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__)
    arguments.add_argument("--seconds", type=at_least(2.0), default=20.0, help="of data")
    options = arguments.parse_args()
    use_one_thread()
    found = _costs(design_of(options), options.seconds)
    lines = [f"{name}: {cost:.1f} µs a sample" for name, cost in found.items()]
    lines.append(f"ratio: {found['bayesian-filters'] / found['ours']:.0f}")
    show(found, "\n".join(lines), options.json)


if __name__ == "__main__":
    main()
