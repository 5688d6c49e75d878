# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joints and their statuses without a node, and the meter of ticks; no test looks at real time."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from staging.stage import BEGIN, MS, PERIOD, Arm

from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.estimation.records import Basis, Estimate, Hypothesis
from tsobs_ros.nodes.observer.joints import ObservedJoint, observed_joints
from tsobs_ros.nodes.observer.parameters import ObserverParameters
from tsobs_ros.nodes.observer.statuses import TickMeter, statuses_of
from tsobs_ros.replay.samples import WRONG
from tsobs_ros.resources import FIXED_DESIGN, config_path
from tsobs_ros.series import NANOSECONDS

FIXED = str(config_path(FIXED_DESIGN))
ARM = Arm(BEGIN)


def joints_of(**parameters: Any) -> list[ObservedJoint]:
    return observed_joints(ObserverParameters(**parameters))


def feed(joints: Iterable[ObservedJoint], count: int, first: int = 0) -> int:
    """Offer samples of the arm and make an estimate of each; return the last one's stamp [ns]."""
    for stamp in range(BEGIN + first * PERIOD, BEGIN + (first + count) * PERIOD, PERIOD):
        for joint in joints:
            offer(joint, stamp)
            joint.estimate(stamp)
    return stamp


def offer(joint: ObservedJoint, stamp: int) -> None:
    _, y, u = ARM.measurement(stamp)
    joint.offer(np.array([stamp]), np.array([y]), np.array([u]), np.zeros(1, int), stamp)


def reject(joint: ObservedJoint, count: int) -> None:
    nothing = np.full((count, 1), np.nan)
    joint.offer(np.zeros(count, int), nothing, nothing, np.full(count, WRONG), BEGIN)


def statuses(joints: list[ObservedJoint], now: int) -> dict[str, Status]:
    for joint in joints:
        joint.count()
    timing = TickMeter(200.0).status()
    found = statuses_of(joints, timing, now, resets=3, enabled=True)
    return {each.name: each for each in found}


def test_a_joint_waits_tracks_coasts_and_is_stale() -> None:
    joints = joints_of(coast_after=0.1, stale_after=1.0)
    waiting = statuses(joints, BEGIN)
    assert waiting["state"][1:3] == (Level.WARN, "WAITING")
    assert waiting["premise domain"].message == "no estimate yet"
    assert not any("nan" in value for each in waiting.values() for value in each.values.values())
    last = feed(joints, 60)
    found = statuses(joints, last)
    assert {name for name, each in found.items() if each.level == Level.OK} == {
        "state", "measurements", "premise domain", "innovation", "sensor fault", "hypothesis",
        "parameters", "certificate",
    }  # fmt: skip
    assert found["timing"].message == "no ticks"
    for age, phase, level in (
        (100 * MS, "TRACKING", Level.OK),
        (101 * MS, "COASTING", Level.WARN),
        (NANOSECONDS, "COASTING", Level.WARN),
        (NANOSECONDS + 1, "STALE", Level.ERROR),
    ):
        state = statuses(joints, last + age)["state"]
        assert (state.level, state.message) == (level, phase)
        assert state.values["measurement age [s]"] == f"{age * 1e-9:.4f}"
        assert (joints[0].estimate(last + age) is None) == (phase == "STALE")
    found = statuses(joints, last + age)
    assert found["innovation"][1:3] == (Level.STALE, "at last: as large as designed")
    assert found["measurements"].level == Level.OK


def test_the_node_is_as_bad_as_its_worst_joint() -> None:
    joints = joints_of(joints=("hip", "knee"), joint_designs=(FIXED, ""))
    feed(joints, 20)
    now = feed(joints[:1], 1200, first=20)
    found = statuses(joints, now)
    assert found["hip: state"].message == "TRACKING"
    assert found["knee: state"].message == "STALE"
    assert found["state"][1:3] == (Level.ERROR, "STALE")
    assert found["state"].values["resets"] == "3"
    assert found["hip: measurements"].values["received"] == "1220"
    assert found["hip: certificate"].values["design"] == FIXED
    assert "hip: parameters" not in found
    assert set(found["knee: parameters"].values) == {"stiffness", "gravity"}


def test_rejections_warn_for_a_minute_and_name_the_main_reason() -> None:
    """However long the node has run before: not hidden by ten good hours, nor for ever after."""
    joints = joints_of()
    (joint,) = joints
    now = feed(joints, 20)
    joint.received += 36_000 * 200  # ten good hours, which would take too long here
    assert all(statuses(joints, now)["measurements"].level == Level.OK for _ in range(61))
    joint.received += 100
    reject(joint, 4)
    for _ in range(8):
        offer(joint, now)
    most = "rejected in the last minute: 12 of 112, most: duplicate stamp"
    for second in range(61):
        status = statuses(joints, now)["measurements"]
        quiet = (Level.OK, "none rejected in the last minute")
        assert (status.level, status.message) == (quiet if second == 60 else (Level.WARN, most))
        assert status.values["rejected: duplicate stamp"] == "8"
    assert status.values["last minute: received"] == "0"


def test_another_rate_than_the_designs_is_told_once_and_when_it_is_over() -> None:
    rate, text = 100.0, "at 100 Hz, the design is for 200 Hz: the bound may never be certified"
    (joint,) = joints_of()
    chance, told = np.random.default_rng(3), []
    stamp = float(BEGIN)
    for second in range(20):
        now = rate if second < 10 else 200.0
        # Some jitter, and a burst of losses each second.
        for sample in range(round(now)):
            stamp += NANOSECONDS / now
            if sample > 20:
                offer(joint, round(stamp + chance.normal(0.0, 0.02 * MS)))
        told.append(joint.count())
    news = {second: each[0] for second, each in enumerate(told) if each}
    assert list(news) == [3, 13]
    assert news[3].level == Level.WARN
    assert news[3].text.startswith(f"measurements come {text}; set `rate` of its request")
    assert news[13][2:] == (Level.OK, "measurements come at 200 Hz, the design is for that")
    measured = statuses([joint], round(stamp))["certificate"].values["measured rate [Hz]"]
    assert float(measured) == pytest.approx(200.0, rel=0.01)


@pytest.mark.parametrize(
    ("concern", "changes", "text"),
    [
        ("certificate", {"basis": Basis.CONTRADICTED}, "the bound is void: the measurements"),
        ("premise domain", {"in_domain": False}, "outside: the bound is not certified"),
        ("premise domain", {"in_domain": False, "claimed": False}, "outside: the bound is void"),
        ("innovation", {"noise_scale": 1.8}, "the noise is 1.8 times the design's"),
        ("hypothesis", {"hypothesis": Hypothesis.FORCE}, "something pushes"),
    ],
)
def test_what_an_estimate_is_not_worth_is_a_warning_with_its_reason(
    concern: str, changes: dict[str, Any], text: str
) -> None:
    joints = joints_of()
    now = feed(joints, 300)
    (joint,) = joints
    assert joint.latest is not None
    before = statuses(joints, now)
    good = joint.latest
    for tick in range(60):
        stamp = now + (tick - 59) * 100 * MS
        joint.events.update(good._replace(stamp=stamp, **(changes if tick >= 20 else {})))
    joint.latest = joint.latest._replace(**changes)
    found = statuses(joints, now)
    assert {name for name, each in found.items() if each.level != before[name].level} == {concern}
    assert found[concern].level == Level.WARN
    assert found[concern].message.startswith(text)
    if concern in ("certificate", "hypothesis"):
        assert found[concern].values["since"] == "for 3.9 s"


def test_a_torque_at_the_link_warns_at_once_and_until_it_has_been_small_for_a_while(
    both_design: Path,
) -> None:
    joints = joints_of(design=str(both_design), torque_warn=(2.0,))
    (joint,) = joints
    assert statuses(joints, BEGIN)["torque disturbance"].message == "no estimate yet"
    one, changes = np.ones(1), []
    known = Estimate(BEGIN, state=np.zeros(4), parameters=one, parameter_bound=one)
    # The second is beyond the level, but not beyond three bounds.
    links = [(0.1, 0.5), (-2.1, 0.8), (-2.1, 0.5), (0.2, 0.5), (3.0, 0.5), *[(0.3, 0.5)] * 6]
    for tick, (link, bound) in enumerate(links):
        joint.latest = known._replace(
            stamp=BEGIN + tick * 100 * MS,
            torque_disturbance=link * one,
            torque_disturbance_bound=bound * one,
        )
        for event in joint.news(joint.latest.stamp, joint.latest, due=False):
            changes.append((tick, event.level))
            assert f"{link:g} N m (1 sigma 0.5) at the link" in event.text
    assert changes == [(2, Level.WARN), (10, Level.OK)]
    assert "at the link, beyond 2 N m: a contact" in joint.torque_text(joint.latest, beyond=True)
    joint.torque_sides = ("motor",)
    assert "at the motor, beyond 2 N m: friction" in joint.torque_text(joint.latest, beyond=True)
    # It is over, but since the last status it has been.
    levels = [statuses(joints, BEGIN)["torque disturbance"].level for _ in range(2)]
    assert levels == [Level.WARN, Level.OK]


@pytest.mark.parametrize(
    ("rate", "times", "missed", "level", "achieved"),
    [
        # A late tick that the next one makes good is not missed.
        (1000.0, (0.0, 1.7, 2.0, 3.9, 4.0, 5.0), 0, Level.OK, "1000.0"),
        (1000.0, (0.0, 1.0, 3.2, 4.0), 1, Level.WARN, "750.0"),
        # A clock that is ahead at once has jumped.
        (100.0, (1000.0, 1010.0, 61010.0, 61020.0), 0, Level.OK, "100.0"),
    ],
)
def test_periods_without_a_tick_are_missed(
    rate: float, times: tuple[float, ...], missed: int, level: Level, achieved: str
) -> None:
    meter = TickMeter(rate)
    for now in times:
        meter.begin(round(now * 1e6))
        meter.end()
    status = meter.status()
    assert (status.level, status.message) == (level, f"ticks missed in the last minute: {missed}")
    assert status.values["missed ticks"] == str(missed)
    assert status.values["achieved rate [Hz]"] == achieved
