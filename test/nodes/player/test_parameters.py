# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What cannot be played is refused with a reason."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from player.bags import Entry, regular, write_bag

from tsobs_ros.errors import BagReadError, ParameterError

Play = Callable[..., Any]


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"bag": ""}, "parameter 'bag' must name a bag folder or an .mcap file"),
        ({"rate": 0.001}, "parameter 'rate' must be at least 0.01"),
        ({"rate": 101}, "parameter 'rate' must be at least 0.01 and at most 100"),
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


def test_a_bag_without_an_end_is_refused(play: Play, tmp_path: Path) -> None:
    file = write_bag(tmp_path / "bag", regular(5)) / "bag_0.mcap"
    file.write_bytes(file.read_bytes()[:-100])

    with pytest.raises(BagReadError, match=r"bag_0.mcap: the file has no end"):
        play(tmp_path / "bag")
