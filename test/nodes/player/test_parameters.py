# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What cannot be played is refused with a reason, and the shipped file has every parameter."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml
from player.bags import Entry, regular, write_bag

from tsobs_ros.errors import BagReadError, ParameterError
from tsobs_ros.nodes.player.parameters import PlayerParameters

CONFIG = Path(__file__).parents[3] / "config" / "player.yaml"
Play = Callable[..., Any]


def test_the_shipped_file_has_every_parameter_at_its_default() -> None:
    shipped = yaml.safe_load(CONFIG.read_text())["/**"]["ros__parameters"]

    defaults = asdict(PlayerParameters())
    assert {k: tuple(v) if isinstance(v, list) else v for k, v in shipped.items()} == defaults
    assert list(shipped) == list(defaults)


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"bag": ""}, "parameter 'bag' must name a bag folder or an .mcap file"),
        ({"rate": 0.001}, "parameter 'rate' must be at least 0.01"),
        ({"rate": 101}, "parameter 'rate' must be at most 100"),
        ({"topics": ["/c"]}, "parameter 'topics': no topic /c; the bag has /a, /b"),
        ({"exclude_regex": "."}, "the parameters leave no topic to play; the bag has /a, /b"),
        ({"regex": "("}, "parameter 'regex': not a regular expression"),
        ({"start_offset": 0.05}, "'start_offset' must be at most 0.04 s, the bag's length"),
        ({"position": 0.05}, "'position' must be at most 0.04 s, the bag's length"),
    ],
)
def test_senseless_parameters_are_refused(
    play: Play, tmp_path: Path, parameters: dict[str, Any], reason: str
) -> None:
    bag = write_bag(tmp_path / "bag", [*regular(5), Entry("/b", 7, "b")])

    with pytest.raises(ParameterError, match=reason):
        play(bag, **parameters)


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("none", "none: "),
        ("bag/metadata.yaml", "metadata.yaml: not an MCAP file"),
        ("bag", "bag_0.mcap: the file has no end"),
    ],
)
def test_what_is_no_whole_bag_is_refused(
    play: Play, tmp_path: Path, path: str, reason: str
) -> None:
    file = write_bag(tmp_path / "bag", regular(5)) / "bag_0.mcap"
    file.write_bytes(file.read_bytes()[:-100])

    with pytest.raises(BagReadError, match=reason):
        play(tmp_path / path)
