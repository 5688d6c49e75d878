# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulator publishes its core's numbers bit for bit, with commands and resets."""

from typing import Any

from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters

PERIOD = 5_000_000
SECOND = 1_000_000_000


def test_a_command_moves_the_arm_until_its_timeout(listener: Any) -> None:
    listener.start(command_timeout=0.1)
    listener.wait_for(listener.measurements, 10)
    listener.command(2.5)
    efforts = lambda: [item.message.effort[0] for item in listener.measurements]  # noqa: E731
    listener.wait_until(lambda: 2.5 in efforts() and efforts()[-1] != 2.5, "the command's timeout")
    assert efforts().count(2.5) <= 20
    first = efforts().index(2.5)
    stamps = [item.stamp for item in listener.measurements if item.message.effort[0] == 2.5]
    assert stamps[-1] - stamps[0] == 19 * PERIOD or len(stamps) < 20
    samples = listener.core(5000)
    # The same arm until the sample that applied the command, another one after it.
    assert listener.places(listener.measurements[: first + 1], samples)[-1] >= 10
    known = {sample.measurement.item() for sample in samples}
    assert listener.measurements[-1].message.position[0] not in known


def test_reset_starts_as_fresh_while_stamps_go_on(listener: Any) -> None:
    # Time that the node drives itself: the wall clock may stand still for a second on a busy
    # machine, and then the stamps restart.
    listener.start(seed=5, disturbance__kind="gauss_markov", publish_clock=True)
    listener.wait_for(listener.measurements, 100)
    listener.command(4.0)
    listener.wait_until(
        lambda: any(item.message.effort[0] == 4.0 for item in listener.measurements),
        "the command's effect",
    )
    answer = listener.reset()
    assert answer.success
    assert answer.message == "restarted with seed 5"
    disturbance = PlantSimulatorParameters().disturbance
    samples = listener.core(5000, seed=5, disturbance=type(disturbance)(kind="gauss_markov"))
    early = {sample.measurement.item() for sample in samples[:30]}
    restarted = lambda: [  # noqa: E731
        place
        for place in range(100, len(listener.measurements))
        if listener.measurements[place].message.position[0] in early
    ]
    listener.wait_until(lambda: bool(restarted()), "the restart")
    listener.wait_for(listener.measurements, 50)
    found = listener.places(listener.measurements[restarted()[0] :], samples)
    assert found == sorted(set(found))
    steps = {
        (item.stamp - listener.measurements[0].stamp) % PERIOD for item in listener.measurements
    }
    assert steps == {0}
