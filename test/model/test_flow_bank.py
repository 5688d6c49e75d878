# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Arms side by side: each row is, to the last bit, what the arm gives alone."""

from collections.abc import Sequence

import numpy as np
import pytest

from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.disturbance import bias, clean, sinusoid
from tsobs_ros.model.flow import ArmFlow, ProcessNoise
from tsobs_ros.model.flow_bank import FlowBank
from tsobs_ros.model.linear_flow import LinearFlow
from tsobs_ros.model.products import mapped, product, transposed

PERIOD = 0.005
DISTURBANCES = {"bias": bias(), "clean": clean(), "tone": bias() + sinusoid(3.0)}


def flow_of(stiffness: float, disturbance: str = "bias") -> ArmFlow:
    arm = ElasticJointArm(stiffness=stiffness)
    return ArmFlow(arm, DISTURBANCES[disturbance], ProcessNoise(), PERIOD)


def agree(flows: Sequence[ArmFlow], duration: float) -> None:
    rng = np.random.default_rng(len(flows))
    k, n = len(flows), flows[0].state_count
    x, u, roots = (rng.standard_normal(shape) for shape in ((k, n), (k, 1), (k, n, n)))
    covariance = roots @ transposed(roots)
    bank = FlowBank(flows)
    moved = bank.predict(x, u, duration)
    both = bank.predict_with_covariance(x, covariance, u, duration)
    for i, flow in enumerate(flows):
        assert (moved[i] == flow.predict(x[i], u[i], duration)).all()
        alone = flow.predict_with_covariance(x[i], covariance[i], u[i], duration)
        assert all((one[i] == other).all() for one, other in zip(both, alone, strict=True))
        assert (bank.to_physical(x)[i] == flow.to_physical(x[i])).all()


@pytest.mark.parametrize("disturbance", DISTURBANCES)
@pytest.mark.parametrize("periods", [0.3, 1.0, 1.02, 3.7])
@pytest.mark.parametrize("count", [1, 2, 7, 16])
def test_arms_of_their_own_and_shared_ones(disturbance: str, periods: float, count: int) -> None:
    agree([flow_of(8.0 + j, disturbance) for j in range(count)], periods * PERIOD)
    agree([flow_of(10.0, disturbance)] * count, periods * PERIOD)


def test_arms_whose_series_differ_are_stacked_all_the_same() -> None:
    flows = [flow_of(10.0), flow_of(1e7)]
    assert LinearFlow.stack([flow.linear for flow in flows]) is None
    agree(flows, 0.004)


@pytest.mark.parametrize("n", [1, 2, 5, 8, 13])
def test_rows_of_a_product_do_not_depend_on_their_neighbours(n: int) -> None:
    rng = np.random.default_rng(n)
    for k in range(1, 17):
        left, right = rng.standard_normal((k, 3, n)), rng.standard_normal((k, n, 2))
        x = rng.standard_normal((k, n))
        stacked = (
            mapped(left, x),
            product(left, right),
            product(transposed(right), transposed(left)),
        )
        for i in range(k):
            assert (stacked[0][i] == mapped(left[i], x[i])).all()
            assert (stacked[1][i] == product(left[i], right[i])).all()
            assert (stacked[2][i] == product(right[i].T, left[i].T)).all()
