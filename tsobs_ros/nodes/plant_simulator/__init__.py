# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `plant_simulator` node: arms or T-S systems to test an observer on, and their ground truth.

topics, sensor_msgs/msg/JointState without another type:
  joint_measurements (out)         position: measured angle of the link [rad], 0 hanging down, or
                                   the outputs that the joint's design file has instead;
                                   effort: motor torque from the stamp on [N m]
  ground_truth/joint_states (out)  true <joint>_link and <joint>_motor [rad, rad/s]
  ground_truth/disturbance (out)   disturbance of the measured angle, without white noise [rad]
  ground_truth/torque_disturbance (out)
                                   effort: torque on <joint>_motor and <joint>_link in addition to
                                   the known one: contact, friction, payload [N m]
  joint_torque_command (in)        std_msgs/msg/Float64MultiArray: torque in place of `excitation`
                                   [N m], one number per arm
  /clock (out)                     rosgraph_msgs/msg/Clock, with `publish_clock`

services:
  ~/reset                          std_srvs/srv/Trigger: start again at t = 0
"""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray

from tsobs_ros.bag.estimate_topics import TRUE_DISTURBANCE, TRUE_STATES, TRUE_TORQUE, sides
from tsobs_ros.bag.timeline import Ticks, Timeline
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.signals import Place, positions
from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters
from tsobs_ros.nodes.runtime import Ticker
from tsobs_ros.nodes.wire import (
    QUIET,
    DrainedSubscription,
    JointStatePublisher,
    clock_message,
    wait_until_taken,
)
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.simulation.plant import Plant, Scenario, Trajectories

# A process that was stopped for longer must not flood its subscribers when it continues.
_LONGEST_LAG = NANOSECONDS
# Longest time of catching up without a break, while services and signals wait [s].
_MAX_BURST = 0.02
# The system clock may be slewed a little; simulated time never goes back unless it restarts.
_SLEW_MARGIN = NANOSECONDS
# Driven time starts here: a zero stamp means "no time" to most of ROS.
_DRIVEN_START = NANOSECONDS
# Without this callback, the first tick, and thus t = 0, would come one message after the jump.
_BACKWARD = JumpThreshold(
    min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
)
# Distance between the joints' seeds, so that no joint repeats another's numbers at a later seed.
SEED_STEP = 2**32
_ACKNOWLEDGE_TIMEOUT = 1.0
# The parts of a scenario that can change while a plant runs.
_SIGNALS = attrgetter("inputs", "outputs", "torque_disturbance", "torque_error")


class TorqueCommands:
    """The torque commands of a node; each of them holds for `command_timeout`.

    A command has one number per arm and per input of a T–S system, in the order of the joints.
    """

    def __init__(self, node: ManagedNode[PlantSimulatorParameters]) -> None:
        plants = node.parameters.scenarios.values()
        self._counts = [each.input_count for each in plants]
        self._is_arm = np.repeat([isinstance(each, Scenario) for each in plants], self._counts)
        self._node, self._rejected = node, 0
        self.subscription = DrainedSubscription(
            node, Float64MultiArray, "joint_torque_command", QoSProfile(depth=10)
        )
        self.forget()

    def forget(self) -> None:
        """Drop the command that holds."""
        self._torques: list[Array] = []
        self._end = 0.0

    def take(self, sample: int) -> None:
        """Take the commands that have arrived; the last one holds from the given sample on."""
        given, count = self._node.parameters, len(self._is_arm)
        for message, _ in self.subscription.drain():
            torques = np.array(message.data)
            if len(torques) != count or not np.isfinite(torques).all():
                self._rejected += 1
                if self._node.is_due("commands"):
                    self._node.log(
                        Level.WARN,
                        f"rejected {self._rejected} torque commands so far: expected {count} "
                        f"finite numbers, got {torques[:4].tolist()}",
                    )
                continue
            limits = np.where(self._is_arm, given.torque_limit, math.inf)
            limited = np.clip(torques, -limits, limits)
            self._torques = np.split(limited, np.cumsum(self._counts)[:-1])
            held = max(1, round(given.command_timeout * given.sample_rate))
            self._end = sample + (held if given.command_timeout > 0.0 else math.inf)

    def at(self, sample: int) -> list[Array] | list[None]:
        """Return the commanded inputs of each joint at a sample, None without a command."""
        return self._torques if sample < self._end else [None] * len(self._counts)


class SamplePublisher:
    """Publishes the measurements and the truth of samples, with all joints in each message."""

    def __init__(self, node: ManagedNode[PlantSimulatorParameters]) -> None:
        requests = node.parameters.requests
        joints = [
            request.signals(joint, alone=len(requests) == 1) for joint, request in requests.items()
        ]
        # Outputs come last, so a lost value of an output that is an input too is NaN. Only this
        # publisher warns of unsuitable subscribers: reliable ones such as the others suit all.
        self.measurements = JointStatePublisher(
            node,
            "joint_measurements",
            [(*each.inputs, *each.outputs) for each in joints],
            qos_profile_sensor_data,
            events=None,
        )
        truths: dict[str, tuple[str, Sequence[Sequence[Place]]]] = {
            TRUE_STATES: ("physical", [each.states for each in joints]),
            TRUE_DISTURBANCE: ("disturbances", [positions(each.disturbances) for each in joints]),
            TRUE_TORQUE: (
                "torque_disturbances",
                [
                    # The motor's first, as in the truth of a sample.
                    [Place(name, "effort") for name in reversed(sides(joint))]
                    if isinstance(each, ArmRequest)
                    else []
                    for joint, each in requests.items()
                ],
            ),
        }
        self._truths = [
            (attrgetter(of), JointStatePublisher(node, topic, parts))
            for topic, (of, parts) in truths.items()
            if any(parts)
        ]
        # Wait until the subscribers have the last truth.
        publishers = [truth.publisher for _, truth in self._truths]
        node.at_cleanup(wait_until_taken, publishers, _ACKNOWLEDGE_TIMEOUT)
        self._clock: Any = None
        if node.parameters.publish_clock:
            self._clock = node.create_publisher(Clock, "/clock", 10, event_callbacks=QUIET)

    def __call__(self, stamp: int, samples: Sequence[Trajectories]) -> None:
        """Publish the time [ns], the truth and, unless they were lost, the measurements."""
        if self._clock is not None:
            self._clock.publish(clock_message(stamp))
        for truth, publisher in self._truths:
            publisher.publish(stamp, {k: truth(each).tolist() for k, each in enumerate(samples)})
        measured = {
            place: [*each.torques.tolist(), *each.measurements.tolist()]
            for place, each in enumerate(samples)
            if not np.isnan(each.measurements).all()
        }
        self.measurements.publish(stamp, measured)


class PlantSimulatorNode(ManagedNode[PlantSimulatorParameters]):
    """Publishes simulated measurements, the truth behind them and, on request, the time.

    Configuring creates the plant, activating starts its time. While the node is inactive, this time
    stands still; the next activation continues from there, with stamps of the present.

    The simulation determines every number, the node only when it is published. All samples that are
    due are published, even late, so a run's data do not depend on how the process was scheduled.
    Time comes from the system clock, from an external /clock (use_sim_time), or from the node
    itself, which then publishes /clock (publish_clock) ahead of each sample.
    """

    def configure(self) -> None:
        """Create the plant at t = 0, its topics and its services."""
        self.parameters = parameters = replace(self.parameters)  # reads what was forgotten
        self.at_cleanup(lambda: self.parameters.files.clear())
        self._publish_sample = SamplePublisher(self)
        self._commands = TorqueCommands(self)
        self.offer_triggers({"reset": self._reset})
        self._schedule = Ticks(parameters.sample_rate)
        self._schedule.start(_DRIVEN_START if parameters.publish_clock else 0)
        self._driven: Timeline | None = None
        self._pace = 1.0
        if parameters.publish_clock:
            self._pace = parameters.real_time_factor
            self._driven = Timeline(_DRIVEN_START, self._pace)
        else:
            jumps = self.get_clock().create_jump_callback(_BACKWARD, post_callback=self._tick)
            self.at_cleanup(jumps.unregister)
        self._new_plant()
        self._latest = 0
        # A timer on the node's clock wakes up with each /clock message. Without /clock, however, it
        # would stop if the system clock were set back.
        self.ticker = Ticker(
            self,
            1.0 / parameters.sample_rate,
            self._tick,
            executor_clock=None if self._follows_clock else self.steady,
        )

    def activate(self) -> None:
        """Start or continue sampling as soon as there are a time and the wanted subscribers."""
        self._commands.subscription.discard()  # earlier ones were for a plant that stood still
        self._activated, self._runs = time.monotonic(), False
        if self._now_ns() == 0:
            self.log(Level.OK, "waiting for /clock")

    @property
    def _is_over(self) -> bool:
        duration = self.parameters.duration
        return duration > 0.0 and self._index >= self._plants[0].scenario.sample_count

    @property
    def _index(self) -> int:
        """Index of the next sample, which all joints have in common."""
        return self._plants[0].index

    def _now_ns(self) -> int:
        """Return the time to stamp samples with [ns]; 0 before the first /clock."""
        if self._driven is not None:
            return self._driven.at(time.monotonic_ns())
        return self.now()

    @property
    def _follows_clock(self) -> bool:
        """Whether time comes from an external /clock."""
        return self._driven is None and bool(self.get_clock().ros_time_is_active)

    def _may_start(self) -> bool:
        """Return whether the wanted subscribers are there or the wait is over; if so, start time at
        the present, or continue it where it stopped if the node drives it."""
        wanted = self.parameters.wait_for_subscribers
        there = self._publish_sample.measurements.publisher.get_subscription_count()
        is_over = 0.0 < self.parameters.wait_timeout <= time.monotonic() - self._activated
        if there < wanted and not (self._index or is_over):
            return False
        if self._driven is not None:
            self._driven.anchor(self._schedule.due, time.monotonic_ns())
            self._driven.paused = False
        elif (now := self._now_ns()) > self._schedule.due:
            self._schedule.start(now)
        what = "going on" if self._index else "started"
        text = f"{what}: {there} of {wanted} subscriptions of joint_measurements"
        self.log(Level.WARN if there < wanted else Level.OK, text)
        self._runs = True
        return True

    def _tick(self, _jump: Any = None) -> int | None:
        """Publish every sample that is due; return the time until the next one [ns]."""
        if not self.active or self.done or self._now_ns() == 0:
            return None
        if not (self._runs or self._may_start()):
            return None
        now = self._now_ns()
        back = self._latest - now
        if back > (0 if self._follows_clock else _SLEW_MARGIN):
            size = f"{back / NANOSECONDS:g} s"
            self.log(Level.WARN, f"the clock went back by {size}: the plant restarts")
            self._new_plant()
            self._schedule.start(now)
        self._commands.take(self._index)
        self._latest = now = self._limit_lag(now)
        burst_end = time.monotonic() + _MAX_BURST
        while not self._is_over and now >= self._schedule.due:
            if time.monotonic() >= burst_end:
                return 0
            torques = self._commands.at(self._index)
            samples = [plant.step(u) for plant, u in zip(self._plants, torques, strict=True)]
            self._publish_sample(self._schedule.take(), samples)
        if self._is_over:
            self.done = True
            return None
        return math.ceil((self._schedule.due - self._now_ns()) / self._pace)

    def _limit_lag(self, now: int) -> int:
        """Return the time up to which to publish; after too long a stop, do not catch up."""
        lag = now - self._schedule.due
        if lag <= _LONGEST_LAG * max(1.0, self._pace):
            return now
        if self.is_due("lag"):
            self.log(Level.WARN, f"{lag / NANOSECONDS:.3f} s behind: going on from here")
        if self._driven is None:
            self._schedule.start(now)
        else:
            now = self._schedule.due
            self._driven.anchor(now, time.monotonic_ns())
        return now

    def _new_plant(self) -> None:
        self._plants = plants_of(self.parameters)
        self._commands.forget()

    def retune(self, parameters: PlantSimulatorParameters) -> None:
        """Apply changed parameters from the next sample on."""
        before = [_SIGNALS(plant.scenario) for plant in self._plants]
        for plant, scenario in zip(self._plants, parameters.scenarios.values(), strict=True):
            plant.exchange(scenario)
        if [_SIGNALS(plant.scenario) for plant in self._plants] != before:
            time = self._index / parameters.sample_rate
            self.log(Level.OK, f"changed at t = {time:g} s; new disturbances count from there")

    def _reset(self) -> str:
        """Restart the plant at the next sample; the stamps continue."""
        self._new_plant()
        if self.done and self.active:
            self._schedule.start(self._now_ns())
        self.done = False
        message = f"restarted with seed {self.parameters.seed}"
        self.log(Level.OK, message)
        return message


def plants_of(parameters: PlantSimulatorParameters) -> list[Plant]:
    """Return each joint's plant at t = 0; its numbers do not depend on the other joints."""
    return [
        Plant(scenario, parameters.seed + place * SEED_STEP)
        for place, scenario in enumerate(parameters.scenarios.values())
    ]


Parameters = PlantSimulatorParameters
create = partial(PlantSimulatorNode, "plant_simulator", Parameters)
