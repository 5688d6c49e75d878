# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joints side by side: to the last bit what each one's tracker gives alone."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.estimation import comparison
from tsobs_ros.estimation.adaptive import AdaptationOptions, AdaptiveObserver
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.joints import JointTrackers
from tsobs_ros.estimation.observer import CertifiedGain, GainMode, TSObserver
from tsobs_ros.estimation.output_model import OutputModel
from tsobs_ros.estimation.records import Estimate, Measurement, RejectReason
from tsobs_ros.estimation.supervised import SupervisedObserver
from tsobs_ros.estimation.supervision import SupervisionOptions
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.model.disturbance import DisturbanceModel, bias, clean, gauss_markov, sinusoid
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.uncertainty import arm_uncertainty
from tsobs_ros.resources import SHIPPED_ADAPTIVE_DESIGN, SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

DESIGN = load_design(config_path(SHIPPED_DESIGN))
ADAPTIVE = load_design(config_path(SHIPPED_ADAPTIVE_DESIGN))
JOINTS = 16
RUN = simulate(SCENARIOS["bias_step"], list(range(JOINTS)), 3.0)
PERIOD, BEGIN, END = 5_000_000, 10**11, 10**18
R = np.array([[1e-4]])


def observer_of(
    stiffness: float, disturbance: DisturbanceModel, gain_mode: GainMode = GainMode.CERTIFIED
) -> TSObserver:
    """Return an observer of another arm, with the steady Kalman gain in a bound of twice that."""
    arm = replace(DESIGN.request.arm, stiffness=stiffness)
    flow = ArmFlow(arm, disturbance, DESIGN.request.process_noise, PERIOD * 1e-9)
    n = flow.state_count
    output, X = OutputModel.of(flow, R), 0.1 * np.eye(n)
    for _ in range(3000):
        K = output.gain(X)[1]
        _, X = flow.predict_with_covariance(
            np.zeros(n), output.joseph(X, K), np.zeros(1), flow.period
        )
    bound = 2.0 * X
    certified = CertifiedGain(output.gain(bound)[1], bound)
    rate = 0.0 if gain_mode is GainMode.RICCATI else 1.0
    return TSObserver(flow, R, X, certified, 0.05, gain_mode, torque_rate=rate)


def settled(design: Design) -> TSObserver:
    """Return a design's observer in which the certified gain takes over soon."""
    request, certified = design.request, design.observer().certified
    start = design.covariance_bound
    return TSObserver(
        request.flow, request.measurement_covariance, start, certified, 0.05, torque_rate=1.0
    )


def learning(observer: TSObserver) -> AdaptiveObserver:
    assert isinstance(observer.flow, ArmFlow)
    uncertainty = arm_uncertainty(observer.flow.arm, {"stiffness": 0.3, "gravity": 0.3})
    return AdaptiveObserver(observer, uncertainty, AdaptationOptions(start=0.05))


TONE = bias() + sinusoid(3.0)
OBSERVERS: dict[str, Callable[[], Any]] = {
    "shipped": lambda: settled(DESIGN),
    "starting": DESIGN.observer,
    "soft": lambda: observer_of(9.0, bias()),
    "stiff": lambda: observer_of(11.0, gauss_markov()),
    "tone": lambda: observer_of(10.0, TONE),
    "clean": lambda: observer_of(10.0, clean()),
    "riccati": lambda: observer_of(10.5, bias(), GainMode.RICCATI),
    "adaptive": lambda: AdaptiveObserver(
        settled(ADAPTIVE), ADAPTIVE.request.uncertainty_model, AdaptationOptions(start=0.05)
    ),
    "soft adaptive": lambda: learning(observer("soft")),
    "tone adaptive": lambda: learning(observer("tone")),
}
KINDS = [*OBSERVERS, "high gain"]


@cache
def observer(kind: str) -> Any:
    """Return the one observer of a kind: to find its steady covariance takes a while."""
    return OBSERVERS[kind]()


def estimator(kind: str) -> Estimator[Any]:
    if kind == "high gain":
        arm = DESIGN.request.arm
        return comparison.high_gain(arm, 2.5, PERIOD * 1e-9, 0.01)
    return SupervisedObserver(observer(kind), SupervisionOptions(jump_quiet=0.2))


def pair(kinds: Sequence[str], **options: Any) -> tuple[JointTrackers, list[Tracker[Any]]]:
    """Return joints as a batch, and the same joints each alone."""

    def trackers() -> list[Tracker[Any]]:
        chosen = TrackerOptions(x_max=0.75, **options)
        return [Tracker(estimator(kind), chosen) for kind in kinds]

    return JointTrackers(trackers()), trackers()


def sample(joint: int, index: int, stamp: int | None = None, offset: float = 0.0) -> Measurement:
    stamp = BEGIN + index * PERIOD if stamp is None else stamp
    return Measurement(stamp, RUN.measurements[joint, index] + offset, RUN.torques[joint, index])


def bits(record: Any) -> Any:
    """Return a record with its arrays as bytes, so that equal means equal to the last bit."""
    if record is None or isinstance(record, RejectReason):
        return record
    return tuple(item.tobytes() if isinstance(item, np.ndarray) else item for item in record)


def books(tracker: Tracker[Any]) -> list[Any]:
    names = ("used", "rejected", "rewinds", "restarts", "failures", "events", "newest")
    return [getattr(tracker, name) for name in names]


def compared(
    joints: JointTrackers,
    alone: list[Tracker[Any]],
    rows: Iterator[Sequence[Measurement | None]],
    after: Sequence[int] = (PERIOD // 3,),
) -> list[Estimate | None]:
    """Feed both, estimate so long after each row; hold each joint to the last bit.

    Returns the last estimates.
    """
    estimates: list[Estimate | None] = []
    for row in rows:
        expected = [m and t.offer(m, END) for t, m in zip(alone, row, strict=True)]
        assert list(map(bits, joints.offer(row, END))) == list(map(bits, expected))
        newest = max([BEGIN, *(m.stamp for m in row if m is not None and m.stamp < END)])
        for later in after:
            estimates = [t.estimate(newest + later) for t in alone]
            assert list(map(bits, joints.estimate(newest + later))) == list(map(bits, estimates))
    assert [books(t) for t in joints.trackers] == [books(t) for t in alone]
    return estimates


@pytest.mark.parametrize("count", range(1, JOINTS + 1))
@pytest.mark.parametrize("kind", ["shipped", "riccati", "adaptive"])
def test_rows_of_a_batch_do_not_depend_on_its_size(kind: str, count: int) -> None:
    joints, alone = pair([kind] * count)
    rows = ([sample(j, k) for j in range(count)] for k in range(40))
    estimates = compared(joints, alone, rows)
    certified = [estimate is not None and estimate.certified for estimate in estimates]
    assert certified == [kind == "shipped"] * count
    assert bool(joints._banks) == (count >= 4)


def test_each_joint_has_its_own_design() -> None:
    kinds = (2 * KINDS)[:JOINTS]
    joints, alone = pair(kinds)
    rows = ([sample(j, k) for j in range(len(kinds))] for k in range(100))
    compared(joints, alone, rows)


def trouble(
    rng: np.random.Generator, joints: int, ticks: int, rate: float, jitter: int
) -> Iterator[list[Measurement | None]]:
    """Yield what messages bring: some joints missing, late, wrong, out of order, jumped, stuck."""
    stamps = BEGIN + PERIOD * np.arange(ticks) + rng.integers(-jitter, jitter + 1, ticks)
    shift, stuck = np.zeros(joints), np.zeros(joints, dtype=int)
    held: list[list[Measurement]] = [[] for _ in range(joints)]
    for k in range(ticks):
        row: list[Measurement | None] = []
        for j in range(joints):
            chance = rng.random() / rate
            if chance < 0.1:
                shift[j] += 0.3
            if chance < 0.2 and not stuck[j]:
                stuck[j] = 20
            index = k - 20 + int(stuck[j]) if stuck[j] and k >= 20 else k
            stuck[j] = max(0, stuck[j] - 1)
            m = sample(j, index, int(stamps[k]), float(shift[j]))
            if chance > 1.0:
                row.append(held[j].pop() if held[j] and rng.random() < 0.3 else m)
            elif chance > 0.7:
                held[j].append(m)
                row.append(None)
            elif chance > 0.6:
                row.append(m._replace(y=m.y + rng.choice([0.2, -1.0, 100.0, np.nan, 1e200])))
            elif chance > 0.5:
                row.append(m._replace(stamp=int(rng.choice([0, -5, 2 * END, BEGIN - PERIOD]))))
            else:
                row.append(m)
        yield row


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=3),
    rate=st.sampled_from([1e-9, 0.02, 0.2]),
    jitter=st.sampled_from([0, 100_000, 1_500_000]),
)
def test_whatever_the_messages_bring_each_joint_is_its_tracker_alone(
    seed: int, kinds: list[str], rate: float, jitter: int
) -> None:
    # A design often has company: that is what makes a batch.
    joints, alone = pair(4 * kinds, history=0.1, max_steps=15)
    rows = trouble(np.random.default_rng(seed), len(alone), 120, rate, jitter)
    with np.errstate(all="ignore"):
        compared(joints, alone, rows)


def test_a_gap_of_all_joints_is_bridged_and_a_long_one_begins_afresh() -> None:
    joints, alone = pair(["shipped", "adaptive"] * 4, restart_after=0.5)
    gaps = {60: 7, 90: 99, 100: 102}

    def rows() -> Iterator[list[Measurement]]:
        late = 0
        for k in range(130):
            late += gaps.get(k, 0)
            yield [sample(j, k, BEGIN + (k + late) * PERIOD) for j in range(8)]

    compared(joints, alone, rows(), after=[5 * PERIOD])
    assert [t.restarts for t in joints.trackers] == [1] * 8


def test_an_exchanged_estimator_steps_with_its_own_numbers() -> None:
    joints, alone = pair(["shipped"] * 5)
    compared(joints, alone, ([sample(j, k) for j in range(5)] for k in range(5)))
    for tracker in (joints.trackers[1], alone[1]):
        tracker.estimator = estimator("stiff")
    compared(joints, alone, ([sample(j, k) for j in range(5)] for k in range(5, 10)))


def test_reset_forgets_every_joint() -> None:
    joints, _ = pair(["shipped"] * 3)
    joints.offer([sample(j, 0) for j in range(3)], END)
    joints.reset()
    assert joints.estimate(BEGIN) == [None] * 3


def test_only_those_are_estimated_that_are_wanted() -> None:
    joints, _ = pair(["shipped"] * 4)
    joints.offer([sample(j, 0) for j in range(3)] + [None], END)
    some = joints.estimate(BEGIN, [True, False, True, True])
    assert [estimate is not None for estimate in some] == [True, False, True, False]


def test_as_many_measurements_as_joints_are_expected() -> None:
    joints, _ = pair(["shipped"] * 3)
    with pytest.raises(ValueError, match="shorter"):
        joints.offer([sample(0, 0)], END)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ["shipped", "starting", "riccati", "adaptive", "soft adaptive"])
@pytest.mark.parametrize("torque", [1.7e308, -1e300, 1e160])
def test_numbers_beyond_all_bounds_are_their_own_joint_s_business(kind: str, torque: float) -> None:
    """Of six, the third: it restarts, in silence, and the others hear nothing of it."""
    together, alone = pair([kind] * 6, restart_after=1.0)

    def rows() -> Iterator[list[Measurement]]:
        for index in (*range(60), *range(80, 120)):
            samples = [sample(joint, index) for joint in range(6)]
            if index % 30 == 20:
                samples[2] = samples[2]._replace(u=np.array([torque]))
            yield samples

    compared(together, alone, rows(), after=[2_000_000, 7_000_000, 40_000_000])
    assert [one.failures for one in alone if one is not alone[2]] == [0] * 5
    assert (alone[2].failures > 0) == ("adaptive" in kind)
