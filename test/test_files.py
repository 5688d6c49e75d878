# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files appear whole or not at all, whatever ends the command that writes them."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tsobs_ros.bag import BagWriter
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.cli.main import main
from tsobs_ros.errors import OutputError
from tsobs_ros.files import written_whole

STAMPS = range(1_700_000_000_000_000_000, 1_700_000_005_000_000_000, 5_000_000)
COMMANDS = {
    "recover": "bag recover BAG --output OUT/new",
    "estimate": "estimate BAG --output OUT/new",
    "csv": "export BAG --output OUT",
    "parquet": "export BAG --format parquet --output OUT",
    "report": "report BAG_estimates --no-ekf --output OUT --force",
}


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five seconds of measurements at rest; a bag of estimates is beside it."""
    path = tmp_path_factory.mktemp("bags") / "bag"
    encode, random = JointStateEncoder(["elbow"]), np.random.default_rng(1)
    with BagWriter(path) as writer:
        writer.add_topic("/joint_measurements", JOINT_STATE)
        for angle, stamp in zip(random.normal(0.0, 1e-3, 1000).tolist(), STAMPS, strict=True):
            writer.write("/joint_measurements", encode(stamp, [angle], (), [0.0]), stamp, stamp)
    assert main(["estimate", str(path)]) == 0
    return path


@contextmanager
def no_room_beyond(size: int) -> Iterator[None]:
    """Let files grow to so many bytes, as on a disk that is full then."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_an_interruption_leaves_nothing(tmp_path: Path) -> None:
    def write() -> None:
        with written_whole(tmp_path / "new") as partial:
            (partial / "a").write_text("half of it")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert list((tmp_path / "new").iterdir()) == []


@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_disk_leaves_nothing(
    command: str, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # What is read in several passes is in temporary files of other folders.
    with no_room_beyond({"report": 600_000, "estimate": 100_000}.get(command, 3_000)):
        words = COMMANDS[command].replace("BAG", str(bag)).replace("OUT", str(tmp_path / "out"))
        assert main(words.split()) == 1

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {tmp_path / 'out'}")
    assert "File too large" in line
    assert ".partial" not in line
    assert list((tmp_path / "out").iterdir()) == []


def test_files_move_below_folders_that_are_there_and_replace_none(tmp_path: Path) -> None:
    def write(text: str) -> None:
        with written_whole(tmp_path) as partial:
            (partial / "deep").mkdir()
            (partial / "deep" / "a").write_text(text)

    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "b").write_text("old")
    write("new")
    with pytest.raises(OutputError, match=f"{tmp_path}/deep/a: exists already"):
        write("newer")
    assert (tmp_path / "deep" / "a").read_text() == "new"
    assert {each.name for each in tmp_path.rglob("*")} == {"deep", "a", "b"}
