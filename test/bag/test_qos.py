# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""QoS profiles survive the YAML form rosbag2 gives them."""

import math

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2.metadata import parse_qos

from tsobs_ros.bag.qos import (
    INFINITE,
    POLICIES,
    QosProfile,
    QosTime,
    profiles_from_yaml,
    profiles_to_yaml,
)

times = st.builds(QosTime, st.integers(0, 9223372036), st.integers(0, 10**9 - 1))
profiles = st.builds(
    QosProfile,
    depth=st.integers(0, 10**6),
    deadline=times,
    lifespan=times,
    liveliness_lease_duration=times,
    avoid_ros_namespace_conventions=st.booleans(),
    **{policy: st.sampled_from(names) for policy, names in POLICIES.items()},
)


@given(st.lists(profiles, max_size=3))
def test_profiles_survive_yaml(offers: list[QosProfile]) -> None:
    assert profiles_from_yaml(profiles_to_yaml(offers)) == tuple(offers)


def test_the_yaml_is_the_one_jazzy_writes() -> None:
    assert yaml.safe_load(profiles_to_yaml([QosProfile()])) == [
        {
            "history": "unknown",
            "depth": 0,
            "reliability": "reliable",
            "durability": "volatile",
            "deadline": {"sec": 9223372036, "nsec": 854775807},
            "lifespan": {"sec": 9223372036, "nsec": 854775807},
            "liveliness": "automatic",
            "liveliness_lease_duration": {"sec": 9223372036, "nsec": 854775807},
            "avoid_ros_namespace_conventions": False,
        }
    ]
    assert profiles_to_yaml([]) == "[]"


def test_rosbags_understands_the_yaml() -> None:
    offer = QosProfile(history="keep_last", depth=7, reliability="best_effort")
    (parsed,) = parse_qos(profiles_to_yaml([offer]))
    assert (parsed.history.name, parsed.depth) == ("KEEP_LAST", 7)
    assert (parsed.reliability.name, parsed.durability.name) == ("BEST_EFFORT", "VOLATILE")
    assert (parsed.deadline.sec, parsed.deadline.nsec) == INFINITE


def test_policies_by_number_are_those_of_the_rmw() -> None:
    values = QosProfile().to_map() | {"history": 1, "reliability": 2, "durability": 1}
    assert QosProfile.from_map(values) == QosProfile(
        history="keep_last", reliability="best_effort", durability="transient_local"
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reliability": "sometimes"}, "reliability is 'sometimes', but must be one of"),
        ({"history": 17}, "not a QoS profile"),
        ({"history": -1}, "history is -1, but must be a whole number >= 0"),
        ({"depth": -1}, "depth is -1, but must be a whole number >= 0"),
        ({"depth": 9.5}, "depth is 9.5, but must be a whole number"),
        ({"deadline": {"sec": -1, "nsec": 0}}, "sec is -1, but must be a whole number"),
        ({"deadline": {"sec": math.inf, "nsec": 0}}, "sec is inf, but must be a whole number"),
        ({"avoid_ros_namespace_conventions": 7}, "neither true nor false"),
        ({"lifespan": {"sec": 1}}, "not a QoS profile .*nsec"),
        ({"lifespan": None}, "not a QoS profile"),
    ],
)
def test_what_is_no_profile_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        QosProfile.from_map(QosProfile().to_map() | change)


@pytest.mark.parametrize("text", ["a: b", "- 1", "[", "- {history: unknown}"])
def test_what_is_no_list_of_profiles_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="not a"):
        profiles_from_yaml(text)


def test_no_text_means_no_profiles() -> None:
    assert profiles_from_yaml("") == ()
