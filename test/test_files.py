# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files appear whole or not at all, the shipped ones are found, and YAML may be anybody's."""

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tsobs_ros.bag import BagWriter
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.cli.main import main
from tsobs_ros.errors import OutputError
from tsobs_ros.files import write_whole, written_whole
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.yaml_files import load_yaml

ROOT = Path(__file__).resolve().parents[1]
SHARE = "share/tsobs_ros/config"
PRINT = "from tsobs_ros.resources import config_path; print(config_path('some.yaml'))"
STAMPS = range(1_700_000_000_000_000_000, 1_700_000_005_000_000_000, 5_000_000)
COMMANDS = {
    "recover": "bag recover BAG --output OUT/new",
    "estimate": "estimate BAG --output OUT/new",
    "csv": "export BAG --output OUT",
    "parquet": "export BAG --format parquet --output OUT",
    "report": "report BAG_estimates --no-ekf --output OUT --force",
    "export-c": f"export-c {config_path(SHIPPED_DESIGN)} --output OUT/new.tsobs",
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


def test_a_folder_in_a_file_s_place_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=f"^{tmp_path}: cannot write it: a folder is there"):
        write_whole(tmp_path, "text")


def config(folder: Path) -> str:
    folder.mkdir(parents=True)
    (folder / "some.yaml").write_text("some: thing\n")
    return str(folder / "some.yaml")


@pytest.mark.parametrize("site", ["lib/python3.12/site-packages", "."])
def test_files_are_those_nearest_to_the_code(tmp_path: Path, site: str) -> None:
    """Of colcon or pip, and of `pip --target`: of a checkout, its prefix, and of ament."""
    prefix, other = tmp_path / "prefix", tmp_path / "other"
    code = prefix / site / "tsobs_ros"
    code.mkdir(parents=True)
    for name in ("__init__.py", "errors.py", "resources.py"):
        shutil.copy(ROOT / "tsobs_ros" / name, code)

    def found() -> str:
        environment = {"PYTHONPATH": str(code.parent), "AMENT_PREFIX_PATH": f"/none:{other}"}
        command = [sys.executable, "-P", "-c", PRINT]
        return subprocess.check_output(command, env={**os.environ, **environment}, text=True)

    for folder in (other / SHARE, prefix / SHARE, code.parent / "config"):
        (code.parent / "package.xml").touch()
        path = config(folder)
        assert found() == f"{path}\n"


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@settings(max_examples=30)
@given(PLAIN)
@example({"%TAG": "%TAG"})
def test_plain_data_comes_back(data: object) -> None:
    assert load_yaml(yaml.safe_dump(data)) == data


LAUGHS = "a0: &a0 [x, x]\n" + "".join(
    f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 40)
)
MERGES = "m0: &m0 {x: 1}\n" + "".join(
    f"m{i}: &m{i} {{<<: [*m{i - 1}, *m{i - 1}], y{i}: 1}}\n" for i in range(1, 40)
)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (LAUGHS, "line 2: aliases are not supported"),
        (MERGES, "line 2: merge keys are not supported"),
        ("a: 1" + ":1" * 500_000, "line 1: a number of 1000001 digits"),
        ("%TAG !a! b\n--- 1", "abbreviations of tags are not supported"),
        ("- 1\n" * 150_000, "line 100000: more than 100000 values"),
        ("a" * 2_000_000, "larger than 1048576 bytes"),
        ("[" * 1_000_000, "line 1: nested deeper than 50 levels|line 1: exceeded maximum nesting"),
        ("a: 1\nb: !!python/object/apply:os.system ['true']", "line 2: could not determine a con"),
        ("a: 2001-13-45", "month must be in 1..12"),
        ("a: " + "9" * 5000, "line 1: a number of 5000 digits"),
        ("a: \x01", "special characters are not allowed|control characters are not allowed"),
        ("--- a\n--- b", "line 2: but found another document|found another document"),
        ("? [1, 2]\n: 3", "line 1: found unhashable key"),
        ("a:\n\t- 1", "line 2: found a tab; indent by spaces"),
        ("a: {b: 1}\nc:\n  d: 1\n  d: 1", "line 4: d occurs twice in a mapping"),
    ],
    ids=["laughs", "merges", "base 60", "directive", "many", "large", "deep", "tag", "date",
         "digits", "control", "documents", "key", "tab", "twice"],
)  # fmt: skip
def test_what_is_dangerous_or_malformed_is_refused_in_one_line(text: str, problem: str) -> None:
    with pytest.raises(ValueError, match=problem) as caught:
        load_yaml(text)

    assert "\n" not in str(caught.value)
