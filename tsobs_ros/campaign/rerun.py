# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Repetition of one run of a campaign, as a bag of measurements, truth and estimates."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tsobs_ros.bag.cdr import MessageSeries
from tsobs_ros.bag.estimate_topics import TRUE_DISTURBANCE, TRUE_STATES, TRUE_TORQUE, sides
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.metadata import QosProfile
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.campaign.definition import Campaign, CampaignError
from tsobs_ros.campaign.drawing import draw_group
from tsobs_ros.design.signals import Place, positions
from tsobs_ros.replay.estimate import Observer, open_source, run_observers
from tsobs_ros.replay.places import Layout
from tsobs_ros.replay.source import MEASUREMENTS
from tsobs_ros.series import stamps_of
from tsobs_ros.simulation.plant import Plant, Trajectories

JOINT = "elastic_joint"
"""Name of the joint in the bag."""


def rerun(campaign: Campaign, run: int, output: Path) -> Path:
    """Repeat a run by its number, and return its bag: `bag` in the folder `output`.

    Raises:
        CampaignError: The campaign has no such run.
        BagWriteError: The bag exists, or cannot be written.
    """
    if not 0 <= run < campaign.entries.runs:
        raise CampaignError(f"run {run}: expected a number from 0 to {campaign.entries.runs - 1}")
    (drawn,) = draw_group(campaign, run, run + 1)
    runs = Plant(drawn.scenario, drawn.seed).run(drawn.scenario.sample_count)
    with TemporaryDirectory() as folder:
        source = open_source(_recorded(campaign, runs, Path(folder, f"run_{run}")))
        observer = Observer("observer", campaign.settings, (campaign.design,))
        run_observers(source, [observer], output / "bag", as_live=False)
    return output / "bag"


def _recorded(campaign: Campaign, run: Trajectories, bag: Path) -> Path:
    """Write the messages that a plant simulator would have sent; return the bag."""
    own = campaign.design.arm_request.signals(JOINT, alone=True)
    stamps, everywhere = stamps_of(run.times), np.ones(len(run.times), np.bool_)
    measured = np.isfinite(run.measurements).any(axis=1)
    inputs_and_outputs = np.hstack([run.measurements, run.torques])
    # The motor's first, as in the truth of a run.
    torques = [Place(name, "effort") for name in reversed(sides(JOINT))]
    series = []
    with BagWriter(bag) as writer:
        for name, places, values, there in (
            (MEASUREMENTS, (*own.outputs, *own.inputs), inputs_and_outputs, measured),
            (TRUE_STATES, own.states, run.physical, everywhere),
            (TRUE_DISTURBANCE, positions(own.disturbances), run.disturbances, everywhere),
            (TRUE_TORQUE, torques, run.torque_disturbances, everywhere),
        ):
            writer.add_topic(f"/{name}", JOINT_STATE, [QosProfile()])
            times, data = stamps[there], Layout(places).encode(stamps[there], values[there])
            series.append(MessageSeries(f"/{name}", JOINT_STATE, times, times, data))
        writer.write_series(series)
    return bag
