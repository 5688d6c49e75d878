# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs estimate`, `tsobs compare` and `tsobs export` as they are typed."""

import json
from pathlib import Path

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.bag import BagReader
from tsobs_ros.bag.joint_states import JointStateEncoder
from tsobs_ros.cli.main import main
from tsobs_ros.methods import METHODS
from tsobs_ros.report.bag_report import make_bag_report
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path

START, PERIOD, LATENCY = 1_700_000_000_000_000_000, 5_000_000, 300_000


@pytest.fixture
def bag(arms, write_bag) -> Path:
    """A second and a half of one joint, with a true disturbance."""
    encode = JointStateEncoder(["elbow"])
    messages = arms.messages(300)
    stamps = [time - 300_000 for _, _, time in messages]
    truth = [("/ground_truth/disturbance", encode(s, [0.0]), s + 300_000) for s in stamps]
    return write_bag(sorted([*messages, *truth], key=lambda message: message[2]))


def test_estimate_writes_a_bag_beside_the_bag(bag: Path, capsys) -> None:
    assert main(["estimate", str(bag)]) == 0

    out, err = capsys.readouterr()
    assert "300 measurements of elbow over 1.5 s" in out
    assert "observer  300 estimates from 300 measurements; rejected: none" in out
    assert err == ""
    counts = {name: topic.count for name, topic in BagReader(f"{bag}_estimates").topics.items()}
    assert counts["/ground_truth/disturbance"] == counts["/observer/joint_states"] == 300
    assert main(["estimate", str(bag)]) == 1
    assert "exists already" in capsys.readouterr().err


def test_a_log_without_a_number_is_no_success(tmp_path, capsys) -> None:
    lines = ["t,q,tau", *(f"{0.005 * k},nan,nan" for k in range(400))]
    (tmp_path / "log.csv").write_text("\n".join(lines))

    assert main(["estimate", str(tmp_path / "log.csv")]) == 1
    assert "error: no estimate was made; rejected: " in capsys.readouterr().err


def test_estimate_warns_as_the_node_does(arms, write_bag, capsys) -> None:
    """Half the design's rate, then messages without effort, then with angles far away."""
    slow = write_bag(arms.messages(200)[::2], "slow")
    encode = JointStateEncoder(["elbow"])
    silent = [
        ("/joint_measurements", encode(START + k * PERIOD, [0.0]), START + k * PERIOD)
        for k in range(100)
    ]
    silent = write_bag(silent, "silent")

    assert main(["estimate", str(slow)]) == 0
    text = "warning: elbow: measurements come at 100 Hz, the design is for 200 Hz: the bound may"
    assert capsys.readouterr().out.count(text) == 1
    assert main(["estimate", str(silent)]) == 1
    warning = "warning: effort is empty in all 100 messages, which are not used"
    assert capsys.readouterr().out.count(warning) == 1
    again = ["estimate", str(silent), "--output", f"{silent}_0", "--param"]
    assert main([*again, "assume_zero_torque=true"]) == 0
    assert "effort" not in capsys.readouterr().out

    far = [
        ("/joint_measurements", encode(START + k * PERIOD, [1e300], (), [0.0]), START + k * PERIOD)
        for k in range(100)
    ]
    assert main(["estimate", str(write_bag(far, "far"))]) == 0
    out = capsys.readouterr().out
    assert out.count("warning: 100 % of the measurements were rejected (most: gated): is") == 1
    assert "as designed" not in out


def test_estimate_lists_what_happened_to_the_estimates(arms, write_bag, capsys) -> None:
    """Noise of three times the design's, a silence, and good measurements after it."""
    encode, random = JointStateEncoder(["elbow"]), np.random.default_rng(4)
    messages = []
    for k in range(600):
        late = 0 if k < 300 else 8_000_000_000
        stamp = START + k * PERIOD + late
        y = float(arms.y[k, 0]) + (0.0 if late else 0.08 * random.normal())
        data = encode(stamp, [y], (), [float(arms.u[k, 0])])
        messages.append(("/joint_measurements", data, stamp + LATENCY))
    command = ["estimate", str(write_bag(messages)), "--rate", "100"]

    assert main(command) == 0
    out = capsys.readouterr().out
    assert main([*command, "--output", f"{command[1]}_other", "--json"]) == 0
    (observer,) = json.loads(capsys.readouterr().out)["observers"]

    events = observer["events"]
    lines = out[out.index("events, in seconds since") :].splitlines()[1 : 1 + len(events)]
    for event, line in zip(events, lines, strict=True):
        assert line == f"{event['time']:9.1f} s  {event['level']:<5}  elbow: {event['text']}"
        assert event["stamp"] == pytest.approx(START + event["time"] * 1e9, abs=1e7)
    found = [(round(one["time"], 1), one["kind"], one["level"]) for one in events]
    for expected in (
        (0.0, "state", "OK"), (1.6, "state", "WARN"), (6.5, "state", "ERROR"), (9.5, "state", "OK")
    ):  # fmt: skip
        assert expected in found
    assert [level for _, kind, level in found if kind == "noise"] == ["WARN", "OK"]
    health = observer["health"]["elbow"]
    assert health["noise_scale"]["max"] >= health["noise_scale"]["median"] > 1.5
    assert (health["learning"], health["certified"]) == ("active", 0.0)
    assert f"; claimed to hold {100.0 * health['claimed']:.3g} %" in out

    new = f"{command[1]}_new"
    assert main([*command, "--output", new, "--json", "--param", "stale_after=2"]) == 0
    (sooner,) = json.loads(capsys.readouterr().out)["observers"]
    report, _ = make_bag_report(Path(new), Path(f"{new}_report"), ekf=False)
    listed = [[one["text"] for one in each["events"]] for each in (sooner, report["health"])]
    assert listed[0] == listed[1] != [one["text"] for one in events]


def test_several_designs_and_methods_have_names_of_their_own(bag: Path, capsys) -> None:
    designs = [str(config_path(name)) for name in (FIXED_DESIGN, SHIPPED_DESIGN)]
    new = f"{bag}_new"

    command = ["estimate", str(bag), "--output", new, "--estimates-only", "--design", *designs]
    assert main([*command, "--method", "certified", "high_gain"]) == 0

    assert {topic.split("/")[1] for topic in BagReader(new).topics} == {
        f"{design}_{method}"
        for design in ("elastic_joint_fixed", "elastic_joint")
        for method in ("certified", "high_gain")
    }
    assert "/elastic_joint_certified/parameters_estimate" in BagReader(new).topics
    assert "the recording is too short" in capsys.readouterr().out


def test_parameters_are_those_of_the_node(bag: Path, tmp_path, capsys) -> None:
    main(["estimate", str(bag), "--output", f"{bag}_1", "--param", "gain_mode=riccati"])
    file = tmp_path / "observer.yaml"
    file.write_text(
        "observer:\n  ros__parameters:\n    gain_mode: riccati\n"
        "    rate: 50.0\n    supervision: {gate: 5.0}\n    joints: [elbow]\n"
        "    settle_tme: 1.0\n    use_sim_time: true\n",
        encoding="utf-8",
    )
    again = ["estimate", f"{bag}_1", "--json", "--params-file"]
    capsys.readouterr()

    assert main([*again, str(file), "--output", f"{bag}_2"]) == 0
    out, err = capsys.readouterr()
    live = json.loads(out)["live"]
    assert live["reproduced"] == live["recorded"] == 300
    said = "ignored unknown parameter 'settle_tme'; did you mean 'settle_time'?"
    assert err == f"warning: {file}: {said}\n"
    other = ["--param", "supervision.gate=1"]
    assert main([*again, str(file), *other, "--output", f"{bag}_3"]) == 0
    live = json.loads(capsys.readouterr().out)["live"]
    assert live["reproduced"] < live["recorded"]


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--joints elbow elbow", "joints: expected names, each once, got ['elbow', 'elbow']"),
        ("--columns time=t", "--columns and --units are for CSV logs"),
        ("--param rate=3", "parameter 'rate': expected one of method, theta"),
        ("--param adapt=maybe", "parameter 'adapt': expected true or false, got 'maybe'"),
        ("--param settle_time=long", "parameter 'settle_time': expected a finite number"),
        ("--param gain_mode=best", "parameter 'gain_mode': expected one of: certified, riccati"),
        ("--param supervision.stuck_samples=1.5", "parameter 'supervision.stuck_samples'"),
        ("--param supervision.gate=-1", "gate"),
    ],
)
def test_a_wrong_option_is_named(bag: Path, capsys, option, said) -> None:
    assert main(["compare", str(bag), *option.split()]) == 1
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("rate", ["1e-300", "1e300"])
def test_a_rate_that_no_recording_can_have_is_refused(bag: Path, capsys, rate: str) -> None:
    assert main(["estimate", str(bag), "--rate", rate]) == 1
    assert "rate: expected 1e-06 to 10000 Hz" in capsys.readouterr().err


def test_compare_leaves_out_what_does_not_fit_the_arm_and_says_why(bag, tmp_path, capsys) -> None:
    text = config_path(FIXED_DESIGN).read_text(encoding="utf-8")
    other = tmp_path / "other.design.yaml"
    other.write_text(text.replace("stiffness: 10.0", "stiffness: 10.000000001"), encoding="utf-8")
    command = ["compare", str(bag), "--design", str(other)]

    assert main(["compare", str(bag)]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in (*METHODS, "innovation² / expected"))
    assert {path.name for path in bag.parent.iterdir()} == {"bag", other.name}
    assert main([*command, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    left_out = {"paper", "ekf_augmented"}
    assert {row["observer"] for row in result["errors"]} == set(METHODS) - left_out
    assert any("paper is left out: method paper: expected" in each for each in result["remarks"])

    assert main([*command, "--method", "paper"]) == 1
    assert "the method's Example 3" in capsys.readouterr().err


def test_damage_is_an_error_after_all_before_it(arms, write_bag, capsys) -> None:
    bag = write_bag(arms.messages(300), max_duration_ns=250_000_000, compression="none")
    last = max(bag.glob("*.mcap"))
    last.write_bytes(last.read_bytes().replace(b"elbow", b"xxxxx"))

    assert main(["estimate", str(bag)]) == 1
    assert main(["export", str(bag), "--output", f"{bag}_csv"]) == 1

    err = capsys.readouterr().err
    for text in ("damaged", "estimated up to there", "exported up to there"):
        assert text in err
    assert 0 < BagReader(f"{bag}_estimates").topics["/observer/joint_states"].count < 300


def test_damage_is_an_error_of_a_fit_and_a_warning_of_a_comparison(
    arms, write_bag, tmp_path, capsys
) -> None:
    bag = write_bag(arms.messages(600), max_duration_ns=2_200_000_000, compression="none")
    last = max(bag.glob("*.mcap"))
    last.write_bytes(last.read_bytes().replace(b"elbow", b"xxxxx"))
    request, fitted = tmp_path / "request.yaml", tmp_path / "fitted.yaml"
    request.write_text("rate: 200.0", encoding="utf-8")

    command = ["fit", str(request), str(bag), "--output", str(fitted), "--free", "stiffness"]
    assert main(command) == 1
    out, err = capsys.readouterr()
    assert "damaged: " in out
    assert "fitted up to there" in err
    assert fitted.exists()
    with pytest.warns(UserWarning, match="compared up to there"):
        ts.compare(bag, methods=["certified", "ekf"])
