# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Campaigns as a whole: the numbers depend on nothing but the campaign."""

import json
from collections.abc import Callable
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tsobs_ros.campaign import batches
from tsobs_ros.campaign.batches import claimed, compute
from tsobs_ros.campaign.definition import Campaign, CampaignError, load_campaign
from tsobs_ros.campaign.drawing import draw_group
from tsobs_ros.campaign.folder import PART, run_campaign
from tsobs_ros.campaign.rerun import rerun
from tsobs_ros.campaign.summary import summarise
from tsobs_ros.cli.main import main
from tsobs_ros.estimation.records import Basis
from tsobs_ros.replay.source import BagSource
from tsobs_ros.report.metrics import measure
from tsobs_ros.report.run import read_run
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN

pytestmark = pytest.mark.xdist_group("campaign")  # its fixture takes seconds


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "runs").iterdir())}


@pytest.fixture(scope="module")
def done(short_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a campaign that one thread ran through."""
    folder = tmp_path_factory.mktemp("done") / "campaign"
    assert main(["campaign", str(short_file), "--output", str(folder), "--workers", "1"]) == 0
    return folder


def stop(runs: int) -> None:
    """End a campaign once a part is done."""
    if runs >= PART:
        raise InterruptedError


def test_rows_depend_on_their_numbers_alone(short: Campaign, done: Path) -> None:
    together = run_campaign(short, done)
    assert together["run"].tolist() == list(range(250))
    for run in (249, 7, 8, 130):
        alone = compute(short, run, run + 1)
        for name, column in alone.items():
            assert column.tobytes() == together[name][run : run + 1].astype(column.dtype).tobytes()


def test_an_error_of_a_scenario_names_the_file(
    write: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(scenarios={"a": {"noise": -1.0}})
    assert main(["campaign", str(path), "--output", str(tmp_path / "campaign")]) == 1
    assert f"error: {path}: scenarios.a: " in capsys.readouterr().err


def test_a_run_that_diverges_refutes_no_bound(write: Callable[..., Path]) -> None:
    huge = {"x": {"link_torque": [{"kind": "bias_step", "amplitude": 1e308, "start": 0.5}]}}
    row = compute(load_campaign(write(runs=1, scenarios=huge)), 0, 1)
    assert not row["premises_hold"][0]
    assert "divergence" in row["violated"][0]


def test_neither_threads_nor_interruptions_change_a_bit(
    short: Campaign, done: Path, tmp_path: Path
) -> None:
    folder, expected = tmp_path / "campaign", files_of(done)
    assert list(expected) == [f"{begin:08d}.parquet" for begin in (0, PART, 2 * PART)]
    # Fewer runs first, whose last part is not whole; then stopped in the middle.
    run_campaign(short.with_runs(30), folder, threads=1)
    with pytest.raises(InterruptedError):
        run_campaign(short, folder, threads=2, progress=stop)
    assert files_of(folder).keys() < expected.keys()
    damaged = folder / "runs" / "00000000.parquet"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    run_campaign(short, folder, threads=3)
    assert files_of(folder) == expected
    # What is there is not computed again.
    times = {path: path.stat().st_mtime_ns for path in (folder / "runs").iterdir()}
    run_campaign(short, folder)
    assert times == {path: path.stat().st_mtime_ns for path in (folder / "runs").iterdir()}
    assert run_campaign(short.with_runs(30), folder)["run"].tolist() == list(range(30))
    assert files_of(folder) == expected


def test_an_end_does_not_wait_for_the_runs_of_whole_parts(
    short: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn, ended = list[int](), Event()

    def draw(campaign: Campaign, begin: int, end: int) -> Any:
        drawn.append(begin)
        assert begin <= PART or ended.wait(60.0)
        return draw_group(campaign, begin, end)

    def end(runs: int) -> None:
        if runs:
            ended.set()
            raise KeyboardInterrupt

    monkeypatch.setattr(batches, "draw_group", draw)
    with pytest.raises(KeyboardInterrupt):
        run_campaign(short, tmp_path, threads=1, progress=end)
    assert drawn[-1] < 1.5 * PART
    assert len(files_of(tmp_path)) == 1


def test_the_certified_bound_holds_if_its_premises_do(write: Callable[..., Path]) -> None:
    path = write(
        design=FIXED_DESIGN,
        runs=60,
        duration=15.0,
        settle_time=5.0,
        initial_state=[[-0.1, 0.1], 0.0, [-0.1, 0.1], 0.0],
        scenarios={"as_designed": {"as_designed": True}, "stiff": {"mismatch": {"stiffness": 0.3}}},
    )
    asked = load_campaign(path)
    summary = summarise(asked, compute(asked, 0, 60))
    held, others = summary["bounds"]["premises hold"], summary["bounds"]["they do not"]
    assert summary["scenarios"]["as_designed"]["premises_hold"] == 1.0
    assert summary["violated"]["parameters"] == 30
    assert held["certified"]["samples"] > 0.4
    for one in held["certified"]["quantities"].values():
        assert one["inside"] > 0.997
        assert one["rms"] < 1.05
        assert one["worst"] < 4.5
    # Where they do not, claims stay honest: slow innovations widen the bounds.
    wrong = [one["inside"] for claim in others.values() for one in claim["quantities"].values()]
    assert min(wrong) > 0.97
    assert others["certified"]["samples"] < 0.5 * held["certified"]["samples"]


def test_a_bound_is_called_what_its_basis_is() -> None:
    rows = np.zeros(len(Basis) + 2, [("basis", float), ("claimed", float)])
    rows["basis"], rows["claimed"] = [*Basis, Basis.LEARNT, np.nan], 1.0
    rows["claimed"][-2] = 0.0
    found = claimed(SimpleNamespace(quantities=()), rows)
    expected = {"certified": 1, "learnt": 1, "covariance": 5, "none": 3}
    assert found == {f"{name}_samples": count for name, count in expected.items()}


@pytest.mark.parametrize("outputs", ["one", "two"])
def test_a_run_is_made_again_as_a_bag_with_the_same_errors(
    outputs: str, both_encoders: Path, write: Callable[..., Path], tmp_path: Path
) -> None:
    design = {"one": SHIPPED_DESIGN, "two": str(both_encoders)}[outputs]
    scenarios = {"only": {"as_designed": True}}
    asked = load_campaign(write(design=design, runs=3, duration=8.0, scenarios=scenarios))
    row = compute(asked, 2, 3)
    bag = rerun(asked, 2, tmp_path / "again")
    run = read_run(BagSource(bag), asked.design.request)
    measured = measure(run, settle_time=0.3)
    assert measured.normalised_rmse == pytest.approx(row["normalised_rmse"][0], rel=1e-9)
    for one in measured.quantities:
        for name in ("rmse", "bound", "inside"):
            assert getattr(one, name) == pytest.approx(
                row[f"{one.quantity.key}_{name}"][0], rel=1e-9
            )
    with pytest.raises(CampaignError, match="run 3: expected a number from 0 to 2"):
        rerun(asked, 3, tmp_path / "never")


def test_the_command_shows_and_refuses(
    short_file: Path, done: Path, write: Callable[..., Path], tmp_path: Path, capsys: Any
) -> None:
    assert main(["campaign", str(short_file), "--output", str(done), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((done / "summary.json").read_text(encoding="utf-8"))
    assert "250 runs of 1 s" in (done / "summary.txt").read_text(encoding="utf-8")
    assert found["scenarios"]["as_designed"]["runs"] == 99
    worst = [one["value"] for one in found["worst"]["normalised RMSE"]]
    assert worst == sorted(worst, reverse=True)

    other = str(write(seed=4, runs=2))
    assert main(["campaign", other, "--output", str(done)]) == 1
    assert "has another campaign, of " in capsys.readouterr().err
    (tmp_path / "summary.txt").write_text("mine")
    assert main(["campaign", other, "--output", str(tmp_path)]) == 1
    assert "summary.txt: exists already; choose another folder" in capsys.readouterr().err
    again = ["--rerun", "one", str(done), "--output", "x"]
    good = [*again[:1], "1", *again[2:]]
    for wrong in ([], [other, *again], again, [other], [*good, "--runs", "2"]):
        with pytest.raises(SystemExit, match="2"):
            main(["campaign", *wrong])
