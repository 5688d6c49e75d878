# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulator node publishes the core's numbers, at exact stamps, whatever happens around it."""

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from tsobs_ros.errors import ParameterError
from tsobs_ros.nodes.plant_parameters import PlantSimulatorParameters
from tsobs_ros.nodes.plant_simulator import PlantSimulatorNode, create
from tsobs_ros.nodes.stamps import set_stamp, to_nanoseconds, to_stamp
from tsobs_ros.simulation.plant import Plant, Sample

CONFIG = Path(__file__).parents[2] / "config" / "plant_simulator.yaml"
PERIOD = 5_000_000
SECOND = 1_000_000_000
BEST_EFFORT = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=5000)


class Received(NamedTuple):
    stamp: int
    message: Any


class Listener:
    """Collects what the simulator publishes and talks to it."""

    def __init__(self, ros: Any) -> None:
        self.ros = ros
        self.node = ros.node("listener")
        self.measurements: list[Received] = []
        self.states: list[Received] = []
        self.disturbances: list[Received] = []
        self.clock: list[int] = []
        for topic, qos, kept in (
            ("joint_measurements", BEST_EFFORT, self.measurements),
            ("ground_truth/joint_states", RELIABLE, self.states),
            ("ground_truth/disturbance", RELIABLE, self.disturbances),
        ):
            self.node.create_subscription(JointState, topic, self._keeper(kept), qos)
        self.commands = self.node.create_publisher(Float64MultiArray, "joint_torque_command", 10)
        self.resets = self.node.create_client(Trigger, "plant_simulator/reset")

    def listen_to_clock(self) -> None:
        self.node.create_subscription(
            Clock, "/clock", lambda m: self.clock.append(to_nanoseconds(m.clock)), RELIABLE
        )

    def start(self, **overrides: Any) -> PlantSimulatorNode:
        """Start a simulator which waits for this listener."""
        given = {"wait_for_subscribers": 1, **overrides}
        parameters = [Parameter(name.replace("__", "."), value=v) for name, v in given.items()]
        node = create(context=self.ros.context, parameter_overrides=parameters)
        return self.ros.add(node)

    def wait_for(self, kept: list[Any], more: int) -> None:
        wanted = len(kept) + more
        self.ros.spin_until(lambda: len(kept) >= wanted, 20.0, f"the arrival of {more} messages")

    def wait_until(self, predicate: Callable[[], bool], what: str) -> None:
        self.ros.spin_until(predicate, 20.0, what)

    def command(self, *values: float) -> None:
        self.wait_until(lambda: self.commands.get_subscription_count() == 1, "matching")
        self.commands.publish(Float64MultiArray(data=list(values)))

    def reset(self) -> Any:
        self.wait_until(self.resets.service_is_ready, "the reset service")
        future = self.resets.call_async(Trigger.Request())
        self.wait_until(future.done, "the reset")
        return future.result()

    @staticmethod
    def _keeper(kept: list[Received]) -> Callable[[Any], None]:
        return lambda m: kept.append(Received(to_nanoseconds(m.header.stamp), m))


@pytest.fixture
def listener(ros: Any) -> Listener:
    return Listener(ros)


def core(count: int, seed: int = 0, **changes: Any) -> list[Sample]:
    plant = Plant(PlantSimulatorParameters(**changes).scenario(), seed)
    return [plant.step() for _ in range(count)]


def places(received: list[Received], samples: list[Sample]) -> list[int]:
    """Find each measurement, bit for bit, among the samples of the core."""
    index = {sample.measurement.item(): sample.index for sample in samples}
    return [index[item.message.position[0]] for item in received]


def test_measurements_are_the_cores_bit_for_bit_at_exact_stamps(listener: Listener) -> None:
    listener.start(seed=3)
    listener.wait_for(listener.measurements, 300)
    samples = core(5000, seed=3)
    found = places(listener.measurements, samples)
    assert found == sorted(set(found))
    start = listener.measurements[0].stamp - found[0] * PERIOD
    for k, item in zip(found, listener.measurements, strict=True):
        assert item.stamp == start + k * PERIOD
        assert list(item.message.name) == ["elastic_joint"]
        assert list(item.message.effort) == samples[k].torque.tolist()
        assert item.message.header.frame_id == ""
        assert len(item.message.velocity) == 0


def test_truth_is_what_the_measurement_was_made_of(listener: Listener) -> None:
    listener.start(disturbance__kind="sinusoid", joint="elbow")
    listener.wait_for(listener.measurements, 100)
    disturbance = PlantSimulatorParameters().disturbance
    samples = core(5000, disturbance=type(disturbance)(kind="sinusoid"))
    stamps = dict(
        zip(
            (item.stamp for item in listener.measurements),
            places(listener.measurements, samples),
            strict=True,
        )
    )
    compared = 0
    for item in listener.states:
        if item.stamp in stamps:
            q1, v1, q2, v2 = samples[stamps[item.stamp]].physical.tolist()
            assert list(item.message.name) == ["elbow_link", "elbow_motor"]
            assert list(item.message.position) == [q1, q2]
            assert list(item.message.velocity) == [v1, v2]
            compared += 1
    for item in listener.disturbances:
        if item.stamp in stamps:
            assert list(item.message.name) == ["elbow"]
            d = samples[stamps[item.stamp]].disturbance.tolist()
            assert list(item.message.position) == d
            compared += 1
    assert compared > 100


def test_a_command_moves_the_arm_until_its_timeout(listener: Listener) -> None:
    listener.start(command_timeout=0.1)
    listener.wait_for(listener.measurements, 10)
    listener.command(2.5)
    efforts = lambda: [item.message.effort[0] for item in listener.measurements]  # noqa: E731
    listener.wait_until(lambda: 2.5 in efforts() and efforts()[-1] != 2.5, "the command's timeout")
    assert efforts().count(2.5) <= 20
    first = efforts().index(2.5)
    stamps = [item.stamp for item in listener.measurements if item.message.effort[0] == 2.5]
    assert stamps[-1] - stamps[0] == 19 * PERIOD or len(stamps) < 20
    samples = core(5000)
    # The same arm until the sample that applied the command, another one after it.
    assert places(listener.measurements[: first + 1], samples)[-1] >= 10
    known = {sample.measurement.item() for sample in samples}
    assert listener.measurements[-1].message.position[0] not in known


def test_a_command_without_timeout_holds_and_saturates(listener: Listener) -> None:
    node = listener.start(command_timeout=0.0, torque_limit=3.0)
    listener.command(-7.0)
    listener.wait_until(
        lambda: [m.message.effort[0] for m in listener.measurements[-150:]] == [-3.0] * 150,
        "150 samples with the saturated command",
    )
    assert node.rejected_commands == 0


def test_senseless_commands_are_counted_and_ignored(listener: Listener) -> None:
    node = listener.start()
    for values in ((math.nan,), (math.inf,), (), (1.0, 2.0)):
        listener.command(*values)
    listener.wait_until(lambda: node.rejected_commands == 4, "the rejection of four commands")
    listener.wait_for(listener.measurements, 50)
    places(listener.measurements, core(5000))


def test_reset_starts_as_fresh_while_stamps_go_on(listener: Listener) -> None:
    listener.start(seed=5, disturbance__kind="gauss_markov")
    listener.wait_for(listener.measurements, 100)
    listener.command(4.0)
    listener.wait_until(
        lambda: listener.measurements[-1].message.effort[0] == 4.0, "the command's effect"
    )
    answer = listener.reset()
    assert answer.success
    assert answer.message == "restarted with seed 5"
    disturbance = PlantSimulatorParameters().disturbance
    samples = core(5000, seed=5, disturbance=type(disturbance)(kind="gauss_markov"))
    early = {sample.measurement.item() for sample in samples[:30]}
    restarted = lambda: [  # noqa: E731
        place
        for place in range(100, len(listener.measurements))
        if listener.measurements[place].message.position[0] in early
    ]
    listener.wait_until(lambda: bool(restarted()), "the restart")
    listener.wait_for(listener.measurements, 50)
    found = places(listener.measurements[restarted()[0] :], samples)
    assert found == sorted(set(found))
    steps = {
        (item.stamp - listener.measurements[0].stamp) % PERIOD for item in listener.measurements
    }
    assert steps == {0}


def test_a_new_seed_takes_effect_at_the_reset(listener: Listener) -> None:
    node = listener.start()
    node.set_parameters([Parameter("seed", value=9)])
    listener.wait_for(listener.measurements, 20)
    places(listener.measurements, core(5000))
    listener.reset()
    ninth = {sample.measurement.item() for sample in core(5000, seed=9)}
    listener.wait_until(
        lambda: listener.measurements[-1].message.position[0] in ninth, "data of seed 9"
    )


def test_faults_are_injected_by_parameters_while_running(listener: Listener) -> None:
    node = listener.start()
    listener.wait_for(listener.disturbances, 20)
    (result,) = node.set_parameters([Parameter("disturbance.kind", value="bias_step")])
    assert result.successful
    listener.wait_until(lambda: listener.disturbances[-1].message.position[0] == 0.1, "the bias")
    node.set_parameters([Parameter("disturbance.bias_step.amplitude", value=-0.3)])
    listener.wait_until(
        lambda: listener.disturbances[-1].message.position[0] == -0.3, "the other bias"
    )
    node.set_parameters([Parameter("disturbance.kind", value="none")])
    listener.wait_until(lambda: listener.disturbances[-1].message.position[0] == 0.0, "the end")
    values = [item.message.position[0] for item in listener.disturbances]
    assert set(values) == {0.0, 0.1, -0.3}
    # Neither the motion nor the white noise knows of the fault.
    index = {s.physical[0].item(): s for s in core(5000)}
    assert all(item.message.position[0] in index for item in listener.states)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("disturbance.kind", "offset", "got 'offset'"),
        ("disturbance.gauss_markov.time_constant", -1.0, "gauss_markov time_constant"),
        ("excitation.frequency", 0.0, "sine frequency"),
        ("noise_std", -0.1, "noise_std"),
        ("rate", 100.0, "read-only"),
    ],
)
def test_senseless_sets_are_refused_with_a_reason(
    listener: Listener, name: str, value: Any, reason: str
) -> None:
    node = listener.start()
    before = node.get_parameter(name).value
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert reason in result.reason
    assert node.get_parameter(name).value == before


@pytest.mark.parametrize(
    ("overrides", "reason"),
    [
        ({"rate": 0.0}, "rate"),
        ({"initial_state": [0.1, 0.2]}, "initial_state: expected four"),
        ({"mismatch__stiffness": -1.0}, "mismatch stiffness"),
        ({"arm__link_inertia": 0.0}, "link_inertia"),
        ({"excitation__kind": "triangle"}, "excitation.kind"),
        ({"joint": ""}, "joint"),
    ],
)
def test_senseless_overrides_are_refused(ros: Any, overrides: dict[str, Any], reason: str) -> None:
    parameters = [Parameter(name.replace("__", "."), value=v) for name, v in overrides.items()]
    with pytest.raises(ParameterError, match=reason):
        create(context=ros.context, parameter_overrides=parameters)


def test_lost_samples_are_not_published_but_their_truth_is(listener: Listener) -> None:
    listener.start(dropouts__interval=0.25, dropouts__duration=0.1)
    listener.wait_for(listener.states, 200)
    listener.wait_for(listener.measurements, 1)
    samples = core(5000)
    found = places(listener.measurements, samples)
    assert not any(k >= 50 and k % 50 < 20 for k in found)
    assert len(listener.states) > len(listener.measurements) + 50


def test_duration_finishes_the_node_after_its_last_sample(listener: Listener) -> None:
    node = listener.start(duration=0.5)
    assert not node.finished
    listener.wait_until(lambda: node.finished, "the end of the duration")
    last = core(101)[-1].physical[0].item()
    listener.wait_until(
        lambda: bool(listener.states) and listener.states[-1].message.position[0] == last,
        "the last sample",
    )
    listener.reset()
    assert not node.finished
    listener.wait_until(lambda: node.finished, "the end after the reset")


def test_without_subscribers_it_starts_after_the_timeout(ros: Any) -> None:
    node = create(
        context=ros.context,
        parameter_overrides=[
            Parameter("wait_for_subscribers", value=2),
            Parameter("wait_timeout", value=0.3),
            Parameter("duration", value=0.1),
        ],
    )
    ros.add(node)
    ros.spin_until(lambda: node.finished, 20.0, "a run without subscribers")


def test_it_does_not_start_before_its_subscribers(ros: Any) -> None:
    parameters = [Parameter("wait_for_subscribers", value=1), Parameter("wait_timeout", value=0.0)]
    node = create(context=ros.context, parameter_overrides=parameters)
    ros.add(node)
    ticks: list[int] = []
    ros.node("metronome").create_timer(0.02, lambda: ticks.append(1))
    ros.spin_until(lambda: len(ticks) >= 25, what="half a second")
    late = Listener(ros)
    late.wait_for(late.measurements, 50)
    # Had it started at once, the first sample to arrive would be at least the hundredth.
    assert places(late.measurements, core(5000))[0] < 80


def test_driven_clock_starts_at_one_second_and_leads_the_samples(listener: Listener) -> None:
    listener.listen_to_clock()
    listener.start(publish_clock=True, real_time_factor=4.0, duration=2.0)
    final = SECOND + 400 * PERIOD
    listener.wait_until(
        lambda: bool(listener.clock) and listener.clock[-1] == final, "the last clock"
    )
    assert all((time - SECOND) % PERIOD == 0 for time in listener.clock)
    assert listener.clock == sorted(set(listener.clock))
    found = places(listener.measurements, core(401))
    assert [item.stamp for item in listener.measurements] == [SECOND + k * PERIOD for k in found]


def test_external_clock_is_followed_and_a_jump_back_starts_anew(listener: Listener) -> None:
    publisher = listener.node.create_publisher(Clock, "/clock", 10)
    node = listener.start(use_sim_time=True)
    listener.wait_until(lambda: publisher.get_subscription_count() == 1, "matching of /clock")
    samples, message, node_clock = core(1000), Clock(), node.get_clock()

    def advance(first: int, count: int) -> list[Received]:
        """Publish the clock in steps of 12 ms, no multiple of the period; return what came."""
        already = len(listener.states)
        times = [first + step * 12_000_000 for step in range(count)]
        for now in times:
            set_stamp(message.clock, now)
            publisher.publish(message)
            listener.wait_until(lambda n=now: node_clock.now().nanoseconds == n, "the clock")
        listener.wait_until(
            lambda: 0 <= times[-1] - listener.states[-1].stamp < PERIOD, "the last sample"
        )
        return listener.states[already:]

    def found(received: list[Received]) -> list[int]:
        index = {sample.physical[0].item(): sample.index for sample in samples}
        return [index[item.message.position[0]] for item in received]

    set_stamp(message.clock, 50 * SECOND)
    publisher.publish(message)
    listener.wait_until(lambda: bool(listener.states), "the first sample")
    advance(50 * SECOND, 80)
    came = found(listener.states)
    assert came == list(range(came[0], 190))
    assert [item.stamp for item in listener.states] == [50 * SECOND + k * PERIOD for k in came]

    again = advance(20 * SECOND, 20)
    assert found(again) == list(range(46))
    assert [item.stamp for item in again] == [20 * SECOND + k * PERIOD for k in range(46)]


def test_nothing_is_published_before_the_first_clock(ros: Any) -> None:
    listener = Listener(ros)
    publisher = listener.node.create_publisher(Clock, "/clock", 10)
    node = listener.start(use_sim_time=True)
    listener.wait_until(lambda: publisher.get_subscription_count() == 1, "matching of /clock")
    ticks: list[int] = []
    ros.node("metronome").create_timer(0.02, lambda: ticks.append(1))
    ros.spin_until(lambda: len(ticks) >= 25, what="half a second")
    assert not listener.states
    publisher.publish(Clock(clock=to_stamp(7 * SECOND)))
    listener.wait_for(listener.states, 1)
    assert listener.states[0].stamp == 7 * SECOND
    assert node.get_clock().now().nanoseconds == 7 * SECOND


def test_a_late_tick_catches_up_and_a_long_stop_does_not(ros: Any) -> None:
    listener = Listener(ros)
    publisher = listener.node.create_publisher(Clock, "/clock", 10)
    listener.start(use_sim_time=True)
    listener.wait_until(lambda: publisher.get_subscription_count() == 1, "matching of /clock")

    def come(now: int) -> list[Received]:
        already = len(listener.states)
        publisher.publish(Clock(clock=to_stamp(now)))
        listener.wait_until(
            lambda: len(listener.states) > already and listener.states[-1].stamp == now,
            "the sample at the clock's time",
        )
        return listener.states[already:]

    come(10 * SECOND)
    # Depth 10 of the publisher bounds what may reach the listener, not what is published.
    caught_up = come(10 * SECOND + 10 * PERIOD)
    assert [item.stamp for item in caught_up] == [10 * SECOND + k * PERIOD for k in range(1, 11)]
    assert [item.stamp for item in come(20 * SECOND)] == [20 * SECOND]
    samples = core(13)
    expected = [sample.physical[0].item() for sample in samples[:12]]
    assert [item.message.position[0] for item in listener.states] == expected


def test_a_stopped_process_holds_its_driven_clock_back(listener: Listener) -> None:
    listener.listen_to_clock()
    listener.start(publish_clock=True)
    listener.wait_for(listener.clock, 10)
    time.sleep(1.5)  # the stop itself, which no other means brings about
    listener.wait_for(listener.clock, 100)
    steps = {b - a for a, b in itertools.pairwise(listener.clock)}
    assert steps == {PERIOD}


def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    return {
        name: value
        for key, branch in tree.items()
        for name, value in (
            flat(branch, f"{prefix}{key}.") if isinstance(branch, dict) else {prefix + key: branch}
        ).items()
    }


def test_the_shipped_parameter_file_is_the_defaults() -> None:
    shipped = flat(yaml.safe_load(CONFIG.read_text())["/**"]["ros__parameters"])
    defaults = flat(asdict(PlantSimulatorParameters()))
    assert {k: tuple(v) if isinstance(v, list) else v for k, v in shipped.items()} == defaults
    assert list(shipped) == list(defaults)


def test_the_executable_ends_by_itself_after_its_duration(ros_process: Any) -> None:
    process = ros_process(
        "plant_simulator", params_file=CONFIG, parameters={"duration": 1, "noise_std": 0}
    )
    ended = process.finish(60.0)
    assert ended.exit_code == 0
    assert "unknown" not in ended.stderr
    assert "Traceback" not in ended.stderr
