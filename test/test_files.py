# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files appear whole or not at all, whatever ends the command that writes them."""

import resource
import signal
import time
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
        for topic in ("/joint_measurements", "/other/joint_states"):
            writer.add_topic(topic, JOINT_STATE)
        for k in range(2000):
            stamp = 1_700_000_000_000_000_000 + (k // 2) * 5_000_000
            angle = float(random.normal(0.0, 1e-3))
            topic = ("/joint_measurements", "/other/joint_states")[k % 2]
            writer.write(topic, encode(stamp, [angle], (), [0.0]), stamp + 10_000, stamp)
    assert main(["estimate", str(path), "--topic", "/joint_measurements"]) == 0
    return path


def run(command: str, bag: Path, output: Path) -> int:
    words = COMMANDS[command].replace("BAG", str(bag)).replace("OUT", str(output))
    topic = ["--topic", "/joint_measurements"] if command == "estimate" else []
    return main([*words.split(), *topic])


def written(output: Path) -> dict[str, bytes]:
    """Return the files there, without those whose path says that they are partial."""
    found = {
        str(path.relative_to(output)): path.read_bytes()
        for path in output.rglob("*")
        if path.is_file() and ".partial/" not in str(path)
    }
    return {name: data for name, data in found.items() if not name.endswith("metadata.yaml")}


@contextmanager
def alarm(seconds: float) -> Iterator[None]:
    """Interrupt what runs in so many seconds, as Ctrl-C does."""
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds)
        yield
    except KeyboardInterrupt:
        pass
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def no_room_beyond(size: int) -> Iterator[None]:
    """Let files grow to so many bytes, as on a disk that is full then."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("command", ["recover", "estimate", "parquet"])
def test_an_interrupted_command_leaves_nothing_partial(
    command: str, bag: Path, tmp_path: Path
) -> None:
    for name in ("first", "whole"):  # once for what is imported
        begin = time.monotonic()
        assert run(command, bag, tmp_path / name) == 0
        taken = time.monotonic() - begin
    whole = written(tmp_path / "whole")

    nothing = 0
    for number in range(4):
        output = tmp_path / str(number)
        with alarm((number + 0.5) / 4 * taken):
            run(command, bag, output)
        found = written(output)
        nothing += not found
        assert found.items() <= whole.items()
        if command != "parquet":
            assert not found or found.keys() == whole.keys()
    assert nothing


@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_disk_leaves_nothing(
    command: str, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # What is read in several passes is in temporary files of other folders.
    with no_room_beyond({"report": 600_000, "estimate": 100_000}.get(command, 3_000)):
        assert run(command, bag, tmp_path / "out") == 1

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
