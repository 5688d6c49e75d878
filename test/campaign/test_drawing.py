# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What runs of a campaign go through, and which premises of the bound that keeps."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsobs_ros.campaign.definition import Campaign, CampaignEntries, load_campaign
from tsobs_ros.campaign.drawing import Drawn, check, draw_group, violated
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design, SolverReport
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.errors import TsobsError
from tsobs_ros.model.arm import ElasticJointArm


def campaign_of(scenario: dict[str, Any], design: Path | None = None, **entries: Any) -> Campaign:
    known = load_design(design)
    return Campaign(CampaignEntries(scenarios={"only": scenario}, **entries), known)


def draw(campaign: Campaign, run: int) -> Drawn:
    return draw_group(campaign, run, run + 1)[0]


def test_a_run_is_drawn_by_its_number_alone(short: Campaign) -> None:
    forwards = [draw(short, run) for run in range(20)]
    backwards = [draw(short.with_runs(20), run) for run in reversed(range(20))]
    assert forwards == backwards[::-1]
    assert len({one.seed for one in forwards}) == 20
    names = Counter(one.name for one in forwards)
    assert names == {"as_designed": 9, "bias": 5, "dropouts": 3, "contact": 3}
    # Three runs each share what is drawn, but for the seed.
    assert [forwards[run]._replace(run=0, seed=0) for run in (0, 1)] == [
        forwards[2]._replace(run=0, seed=0)
    ] * 2
    assert forwards[2].theta != forwards[3].theta
    assert draw(Campaign(replace(short.entries, seed=4), short.design), 0) != forwards[0]


def test_numbers_fill_their_ranges_and_the_designs_bounds(short: Campaign) -> None:
    drawn = [draw(short, run) for run in range(0, 1500, 3)]
    theta = np.array([[one.theta["stiffness"], one.theta["gravity"]] for one in drawn])
    true = [one.scenario.true_arm for one in drawn]
    found = np.array([[arm.stiffness, arm.gravity_torque] for arm in true])
    np.testing.assert_allclose(found, 10.0 * (1.0 + theta))
    starts = np.array([one.scenario.initial_state[0] for one in drawn])
    steps = np.array([one.numbers["disturbance[0].start"] for one in drawn if one.name == "bias"])
    for values, least, most in ((theta, -0.4, 0.4), (starts, -0.3, 0.3), (steps, 0.2, 0.8)):
        margin = 0.03 * (most - least)
        assert least <= values.min() < least + margin
        assert most - margin < values.max() <= most
    biases = [one.scenario.outputs[0].disturbance[0] for one in drawn if one.name == "as_designed"]
    assert np.std([one.amplitude for one in biases]) == pytest.approx(0.3, rel=0.15)


def test_damping_inertia_and_gain_are_those_that_a_design_calls_uncertain() -> None:
    request = ArmRequest(
        arm=ElasticJointArm(link_damping=0.2),
        uncertainty={
            "link_damping": 0.5,
            "motor_damping": 0.5,
            "link_inverse_inertia": 0.5,
            "torque_gain": 0.5,
        },
    )
    design = load_design()
    asked = Campaign(CampaignEntries(), replace(design, request=request))
    for run in range(30):
        one = draw(asked, run)
        arm, friction = one.scenario.true_arm, one.scenario.friction
        assert arm.link_damping + friction.link_viscous == pytest.approx(
            0.2 + one.theta["link_damping"]
        )
        assert friction.motor_viscous == pytest.approx(one.theta["motor_damping"])
        assert 1.0 / arm.link_inertia == pytest.approx(1.0 + one.theta["link_inverse_inertia"])
        assert one.theta["motor_damping"] >= 0.0
        assert one.scenario.true_torque.gain == pytest.approx(1.0 + one.theta["torque_gain"])
        assert violated(one.scenario, request) == ()


def test_two_encoders_and_a_contact_have_what_their_design_says(both_encoders: Path) -> None:
    scenario = {
        "as_designed": True,
        "noise": 2.0,
        "outputs": {"motor_angle": {"sensor": {"latency": 0.01}}},
    }
    one = draw(campaign_of(scenario, both_encoders), 0)
    link, motor = one.scenario.outputs
    assert (link.measures, link.sensor.noise_std, link.sensor.latency) == ("link_angle", 0.01, 0.0)
    assert (motor.measures, motor.sensor.noise_std) == ("motor_angle", 0.004)
    assert motor.sensor.latency == 0.01
    assert [each.kind for each in link.disturbance] == ["bias_step", "gauss_markov"]
    assert motor.disturbance == ()
    (contact,) = one.scenario.torque_disturbance.link
    assert (contact.kind, contact.std, contact.time_constant) == ("gauss_markov", 2.0, 1.0)
    request = load_design(both_encoders).arm_request
    assert violated(one.scenario, request) == ("latency", "noise")


@pytest.mark.parametrize(
    ("scenario", "expected"),
    [
        ({"as_designed": True}, ""),
        ({"sensor": {"dropout_interval": 3.0}}, ""),
        ({"noise": 1.1}, "noise"),
        ({"process_noise": 1.1}, "process noise"),
        ({"disturbance": [{"kind": "bias_step"}]}, ""),
        ({"disturbance": [{"kind": "bias_step", "start": 1.0}]}, "disturbance"),
        ({"disturbance": [{"kind": "sinusoid"}]}, "disturbance"),
        ({"disturbance": [{"kind": "stuck"}]}, "disturbance"),
        ({"sensor": {"noise_degrees": 3}}, "heavy tails"),
        ({"friction": {"motor_coulomb": 0.1}}, "friction"),
        ({"payload": {"mass": 1.0, "distance": 0.1}}, "payload"),
        ({"torque_error": [{"kind": "pulses"}]}, "torque error"),
        ({"motor_torque": [{"kind": "ramp"}]}, "torque disturbance"),
        ({"mismatch": {"link_inertia": 0.1}}, "parameters"),
        ({"mismatch": {"stiffness": 0.41}, "uncertainty": 0.0}, "parameters"),
    ],
)
def test_premises_of_the_bound(scenario: dict[str, Any], expected: str) -> None:
    asked = campaign_of(scenario)
    drawn = draw(asked, 0)
    assert ", ".join(violated(drawn.scenario, asked.design.arm_request)) == expected


def test_disturbances_with_a_model_in_the_design_are_foreseen() -> None:
    request = ArmRequest(
        disturbance=[
            DisturbanceTerm("ramp"),
            DisturbanceTerm("sinusoid", {"frequency": 3.0}),
            DisturbanceTerm("gauss_markov", {"std": 0.1, "time_constant": 5.0}),
        ]
    )
    n = request.flow.state_count
    design = Design(request, np.eye(n), np.zeros((n, 1)), SolverReport())
    for scenario, expected in (
        ({"as_designed": True}, ()),
        ({"as_designed": True, "disturbance": [{"kind": "sinusoid", "frequency": 3.0}]}, ()),
        ({"disturbance": [{"kind": "sinusoid", "frequency": 3.1}]}, ("disturbance",)),
        (
            {"as_designed": True, "disturbance": [{"kind": "gauss_markov", "time_constant": 5.0}]},
            ("disturbance",),
        ),
        ({"disturbance": [{"kind": "ramp"}]}, ()),
    ):
        asked = Campaign(CampaignEntries(scenarios={"only": scenario}), design)
        assert violated(draw(asked, 0).scenario, request) == expected


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"run": 3}, r"campaign: unknown entry 'run', expected some of design, observer, runs"),
        ({"runs": 0}, "runs: expected at least 1, got 0"),
        ({"duration": 0.3}, "duration: expected more than settle_time = 0.3 s"),
        ({"design": "paper_example_1.design.yaml"}, "expected one for an arm"),
        ({"observer": {"gate": 3.0}}, "parameter 'gate': expected one of method"),
        ({"scenarios": {"a": {"weight": 0}}}, "scenarios.a.weight: expected a whole number"),
        ({"scenarios": {"a": {"weight": 10**9}}}, "scenarios.a.weight: .* to 10000, got 10000000"),
        ({"excitation": {"kind": "foo"}}, "scenarios.as_designed.excitation.kind: expected"),
        (
            {"scenarios": {"a": {"disturbance": [{"kind": "ramp", "slope": 1}]}}},
            r"scenarios.a.disturbance\[0\].* unknown entry 'slope'",
        ),
        ({"scenarios": {"a": {"noise": [1, -1]}}}, r"scenarios.a.*noise: expected a range"),
        (
            {"scenarios": {"a": {"sensor": {"nois": 1}}}},
            "scenarios.a.sensor.* unknown entry 'nois'",
        ),
        ({"scenarios": {"a": {"outputs": {"x": {}}}}}, "outputs: expected some of link_angle"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_before_anything_runs(
    write: Callable[..., Path], entries: dict[str, Any], message: str
) -> None:
    path = write(**entries)
    with pytest.raises(TsobsError, match=message):
        check(load_campaign(path))
