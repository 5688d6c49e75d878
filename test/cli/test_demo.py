# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs demo` from end to end: its processes, a bag, a table and figures, and no litter."""

import json
import re
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from tsobs_ros.bag import BagReader
from tsobs_ros.cli.demo import ADAPTIVE_TOPICS, RECORDED_TOPICS
from tsobs_ros.cli.main import main
from tsobs_ros.design.file import checksum, load_design
from tsobs_ros.replay.designs import recorded_observers
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

pytest.importorskip("matplotlib")
pytest.importorskip("tqdm")

SHIPPED = config_path(SHIPPED_DESIGN)
ROOT = Path(__file__).resolve().parents[2]
TIMEOUT = 120.0
Demo = Callable[..., Any]


@pytest.fixture
def demo(ros: Any, ros_process: Any) -> Demo:
    """Start the command."""
    domain = ["demo", "--domain-id", str(ros.domain_id)]
    return lambda *arguments: ros_process("tsobs", arguments=[*domain, *arguments])


def running(folder: Path) -> list[int]:
    """Return the processes that were started to log into a folder."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            environment = (process / "environ").read_bytes()
            state = (process / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue  # it has ended, or is not ours
        if f"ROS_LOG_DIR={folder / 'log'}".encode() in environment and state != "Z":
            found.append(int(process.name))
    return found


def test_a_demo_leaves_a_bag_a_table_and_figures(
    domain_id: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "demo"
    command = ["demo", "--domain-id", str(domain_id), "--output", str(output)]
    command += ["--duration", "3", "--seed", "7", "--bias", "0.25", "--bias-at", "1.5"]
    assert main(command) == 0
    out, err = capfd.readouterr()
    assert "Traceback" not in err
    assert "3.0/3.0 s" in err
    for quantity in ("link angle", "motor velocity", "sensor disturbance"):
        assert quantity in out
    for name in ("report.png", "report.json"):
        assert str(output / name) in out
        assert (output / name).stat().st_size > 0
    assert (output / "report.png").read_bytes().startswith(b"\x89PNG")
    report = json.loads((output / "report.json").read_text(encoding="utf-8"))
    assert report["bag"] == str(output / "bag")
    assert running(output) == []
    plant = (output / "log" / "plant_simulator.log").read_text(encoding="utf-8")
    assert "WARN" not in plant  # it starts as soon as observer and recorder listen

    reader = BagReader(output / "bag")
    assert set(reader.topics) == {*RECORDED_TOPICS, *ADAPTIVE_TOPICS}
    check_disturbance(reader)
    check_layouts(reader)
    ran, shipped = recorded_observers(reader)["/observer"], load_design(SHIPPED)
    assert ran.designs["elastic_joint"][0].text == shipped.source
    assert report["design"] == {"file": shipped.file, "sha256": checksum(shipped)}


def check_disturbance(reader: BagReader) -> None:
    """What was asked for on the command line is what the simulated sensor suffered."""
    truth = reader.messages(["/ground_truth/disturbance"])
    biases = [deserialize_message(each.data, JointState).position[0] for each in truth]
    # Samples 0 to 600; the recorder may have come too late for the truth of the first few.
    assert biases == [0.0] * (len(biases) - 301) + [0.25] * 301
    assert len(biases) > 500
    assert reader.topics["/observer/joint_states"].count > 100


def check_layouts(reader: BagReader) -> None:
    """Each series that the shipped layouts plot is in the bag."""
    newest = {
        item.topic: deserialize_message(item.data, JointState)
        for item in reader.messages()
        if reader.topics[item.topic].type == "sensor_msgs/msg/JointState"
    }
    foxglove = (ROOT / "views" / "foxglove_layout.json").read_text(encoding="utf-8")
    (script,) = json.loads(foxglove)["userNodes"].values()
    paths = re.findall(r'"value": "(/[\w/]+)\.(\w+)\[(\d+)\]"', foxglove)
    assert len(paths) == foxglove.count('"value": ') > 25
    for topic, field, place in paths:
        if f'output = "{topic}";' in script["sourceCode"]:
            assert f"\n  {field}: number[];" in script["sourceCode"]
        elif topic in newest:  # nothing is learnt in so short a time
            assert int(place) < len(getattr(newest[topic], field)), topic
        else:
            assert topic in reader.topics
    assert set(re.findall(r'^  "(/.*)",$', script["sourceCode"], re.MULTILINE)) <= set(newest)

    learnt = load_design(SHIPPED).request.uncertainty
    series = {f"{topic}/{name}/position" for topic in ADAPTIVE_TOPICS for name in learnt} | {
        f"{topic}/{name}/{field}"
        for topic, message in newest.items()
        for field in ("position", "velocity", "effort")
        for name, _ in zip(message.name, getattr(message, field), strict=False)
    }
    layout = ElementTree.parse(ROOT / "views" / "plotjuggler_layout.xml").getroot()
    sources = [each.text for each in layout.iterfind(".//snippet/additional_sources/*")]
    sources += [each.text for each in layout.iter("linked_source")]
    assert series >= set(sources)
    curves = {curve.attrib["name"] for curve in layout.iter("curve")}
    assert len(curves) > 25
    assert curves <= series | {snippet.attrib["name"] for snippet in layout.iter("snippet")}


def test_a_node_that_fails_fails_the_demo_with_its_reason(
    domain_id: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    output = tmp_path / "demo"
    command = ["demo", "--domain-id", str(domain_id), "--output", str(output)]
    monkeypatch.setattr("tsobs_ros.cli.demo.ADAPTIVE_TOPICS", ("/b ad",))
    assert main(command) == 1
    err = capfd.readouterr().err
    (line,) = [line for line in err.splitlines() if line.startswith("error: ")]
    assert "recorder ended with exit code 1" in line
    assert "parameter 'topics': expected a ROS name, got '/b ad'" in line
    assert running(output) == []
    # Another one does not write into its folder.
    assert main(["demo", "--output", str(output)]) == 1
    assert f"error: {output}: exists already" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--domain-id", "233", "--domain-id: expected 0 to 232, got 233"),
        ("--bias", "nan", "amplitude': expected a finite number"),
        ("--seed", "-1", "'seed': expected an integer of at least 0, got -1"),
        ("--design", "no.yaml", "no.yaml: cannot read it: No such file or directory"),
    ],
)
def test_what_no_node_would_take_makes_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, value: str, said: str
) -> None:
    with suppress(SystemExit):
        assert main(["demo", "--output", str(tmp_path / "demo"), option, value]) == 1
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_signals_end_the_nodes_and_close_the_bag(demo: Demo, tmp_path: Path) -> None:
    output = tmp_path / "demo"
    process = demo("--duration", "300", "--output", str(output))
    process.wait_for_line(r"[1-9]\d*\.\d/300\.0 s", TIMEOUT)
    assert len(running(output)) == 4
    for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGTERM):
        process.signal(number)
    finished = process.finish(TIMEOUT)
    assert finished.exit_code == 1
    assert "Traceback" not in finished.stderr
    assert "interrupted" in finished.stderr
    assert running(output) == []
    assert BagReader(output / "bag").message_count > 100


@pytest.mark.slow
def test_the_nodes_end_with_a_demo_that_is_killed(ros: Any, demo: Demo, tmp_path: Path) -> None:
    process = demo("--duration", "300", "--output", str(tmp_path / "demo"))
    process.wait_for_line(r"[1-9]\d*\.\d/300\.0 s", TIMEOUT)
    process.signal(signal.SIGKILL)
    ros.spin_until(lambda: not running(tmp_path / "demo"), TIMEOUT, "the nodes' end")
    assert BagReader(tmp_path / "demo" / "bag").message_count > 0
