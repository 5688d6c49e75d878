# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the `observer` node does: its entities, its tick, its lifecycle."""

import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.estimation.records import (
    Innovation,
    Measurement,
    RejectReason,
    Sample,
    stamp_of,
)
from tsobs_ros.estimation.tracker import JointTrackers, Tracker
from tsobs_ros.methods import WARNINGS
from tsobs_ros.nodes.draining import DrainedSubscription
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.messages import DiagnosticsPublisher
from tsobs_ros.nodes.observer.io import MEASUREMENT_QOS, EstimatePublisher, MeasurementReader
from tsobs_ros.nodes.observer.joints import ObservedJoint, observed_joints
from tsobs_ros.nodes.observer.parameters import ObserverParameters
from tsobs_ros.nodes.observer.statuses import (
    estimate_statuses,
    joint_statuses,
    measurement_status,
    state_status,
    summary_status,
    tracking_values,
    worst_phase,
)
from tsobs_ros.nodes.observer.tick_meter import TickMeter
from tsobs_ros.nodes.ticker import Ticker

_DIAGNOSTICS_PERIOD = 1.0
_WARNING_PERIOD = 5.0


class Observer(ManagedNode[ObserverParameters]):
    """Runs the certified observers of one or several independent joints.

    Configuring loads the designs and re-checks their certificates, activating begins to estimate,
    each time afresh. While the node is inactive, what arrives is thrown away.

    Args:
        node_kwargs: Arguments of `rclpy.node.Node`, such as `context` or `parameter_overrides`.

    Raises:
        ParameterError: A parameter has a wrong type or value.
        DesignFileError: A design file is missing or malformed.
        CertificateError: A design's certificate does not hold.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("observer", ObserverParameters, **node_kwargs)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.start()

    def configure(self) -> None:
        """Load the designs and make everything."""
        parameters = self.parameters
        self._joints = observed_joints(parameters)
        self._trackers = JointTrackers([joint.tracker for joint in self._joints])
        self._resets = 0
        self._told_failures = 0
        self._enabled = True
        self._fresh = True
        self._just_published = False
        self._last_now = 0
        self._last_output = 0
        self._unanswered: deque[int] = deque(maxlen=MEASUREMENT_QOS.depth)
        self._next_warning: dict[object, float] = {}
        self._meter = TickMeter(parameters.rate)

        self._reader = MeasurementReader(parameters.joints, parameters.assume_zero_torque)
        at_once = parameters.publish_on == "measurement"
        self._measurements = DrainedSubscription(
            self,
            JointState,
            "joint_measurements",
            MEASUREMENT_QOS,
            raw=True,
            on_arrival=self._on_arrival if at_once else None,
        )
        self._publisher = EstimatePublisher(
            self, {joint.name: joint.learnt for joint in self._joints}
        )
        self._diagnostics = DiagnosticsPublisher(self, hardware_id=", ".join(parameters.joints))
        self.offer_triggers({"reset": self._on_reset})
        self.create_service(SetBool, "~/enable", self._on_enable)
        self._ticker = Ticker(self, 1.0 / parameters.rate, self._on_tick)
        # Only an executor notices arrivals.
        self.ticker = self._ticker if self._measurements.in_bulk and not at_once else None
        # Not the node's clock: a paused simulation is still worth a diagnosis.
        self.create_timer(_DIAGNOSTICS_PERIOD, self._diagnose, clock=self._steady)
        self._tell_of_designs()

    def activate(self) -> None:
        """Begin to estimate from what comes from now on."""
        self._measurements.drain()
        if not self._fresh:
            self._begin_afresh("activated again")
        self._meter.restart()
        self._ticker.start()

    def deactivate(self) -> None:
        """Stop estimating and publishing."""
        self._ticker.stop()

    def retune(self, parameters: ObserverParameters) -> None:
        """Take over parameters that were changed while the node runs."""
        for joint in self._joints:
            joint.retune(parameters)

    @property
    def joints(self) -> tuple[ObservedJoint, ...]:
        """The joints with their trackers and counts."""
        return tuple(self._joints)

    @property
    def tracker(self) -> Tracker[Any]:
        """The tracker of the first joint, with its counts."""
        return self._joints[0].tracker

    @property
    def received(self) -> int:
        """Number of samples of all joints since the start: used + rejected, while enabled."""
        return sum(joint.received for joint in self._joints)

    def _on_tick(self) -> None:
        now = None if self._just_published else self._now()
        self._just_published = False
        if now is not None:
            self._meter.begin(now)
            self._take_all(now)
            self._publish(now)
            self._meter.end()

    def _on_arrival(self) -> None:
        """Estimate from measurements as soon as they have come."""
        now = self._now() if self.active else None
        if now is not None:
            self._meter.begin(now, tick=False)
            self._just_published |= self._take_all(now) and self._publish(now)
            self._meter.end()

    def _now(self) -> int | None:
        """Return the time, None before simulated time begins; restart if it went back."""
        now = int(self.get_clock().now().nanoseconds)
        if now == 0:
            return None
        if now < self._last_now:
            self._on_backward_jump(now)
        self._last_now = now
        return now

    def _on_backward_jump(self, now: int) -> None:
        self._meter.restart()
        if self.parameters.reset_on_backward_jump:
            self._last_output = 0
            self._publisher.restart()
            self._begin_afresh(f"the clock went back by {(self._last_now - now) * 1e-9:.3f} s")

    def _take_all(self, now: int) -> bool:
        """Take what has arrived; return whether any of it was used."""
        used = False
        taken = self._measurements.take()
        if not self._enabled:
            return False
        arrived = [(self._reader.read(data), data, info) for data, info in taken]
        # A late one in its place costs as many steps as there are newer ones.
        arrived.sort(key=lambda message: stamp_of(message[0]))
        for read, data, info in arrived:
            if self._take(read, data, now):
                self._unanswered.append(info["received_timestamp"])
                used = True
        return used

    def _take(self, message: Sequence[Sample], data: bytes, now: int) -> bool:
        """Use the joints' samples in one message, or count and report why not."""
        self._fresh = False
        samples: list[Measurement | None] = []
        for joint, read in zip(self._joints, message, strict=True):
            joint.received += read is not None
            if isinstance(read, RejectReason):
                joint.tracker.reject(read)
                self._warn_of_rejection(joint, read, data, now)
                read = None
            samples.append(read)
        outcomes = self._trackers.offer(samples, now)
        stamp = None
        for joint, sample, outcome in zip(self._joints, samples, outcomes, strict=True):
            if sample is None or outcome is None:
                continue
            if isinstance(outcome, Innovation):
                stamp = sample.stamp
                joint.used(sample, outcome)
                continue
            if outcome is RejectReason.GATED:
                joint.gated(sample)
            self._warn_of_rejection(joint, outcome, data, now)
        if stamp is None:
            return False
        self._publisher.publish_innovations(stamp, outcomes)
        return True

    def _publish(self, now: int) -> bool:
        """Publish the estimates for the present; return whether there were any."""
        if not self._enabled or now <= self._last_output:
            return False
        # Only of fresh joints: to predict through a long silence would take long, and say nothing.
        fresh = [joint.fresh(now) for joint in self._joints]
        estimates = self._trackers.estimate(now, fresh)
        for place, (joint, estimate) in enumerate(zip(self._joints, estimates, strict=True)):
            if estimate is not None:
                joint.estimated(estimate)
            elif not fresh[place] and self.parameters.when_stale == "hold":
                estimates[place] = joint.held()
        if not self._publisher.publish(now, estimates):
            return False
        self._last_output = now
        if self._unanswered:
            done = time.time_ns()
            for arrived in self._unanswered:
                self._meter.answered(done - arrived)
            self._unanswered.clear()
        return True

    def _warn_of_rejection(
        self, joint: ObservedJoint, reason: RejectReason, data: bytes, now: int
    ) -> None:
        """Warn, throttled for each reason on its own, so that none hides another."""
        if self._may_warn(reason):
            said = self._reader.describe(data, joint.name)
            self.get_logger().warning(
                f"measurement of {joint.name} rejected: {reason.value} "
                f"({said}, clock {now * 1e-9:.3f})"
            )

    def _may_warn(self, subject: object) -> bool:
        """Return whether the last warning of a subject was long enough ago."""
        now = time.monotonic()
        if now < self._next_warning.get(subject, 0.0):
            return False
        self._next_warning[subject] = now + _WARNING_PERIOD
        return True

    def _begin_afresh(self, why: str) -> None:
        """Reset everything an instance computes from data; counts of a new instance are zero."""
        if self._may_warn("afresh"):
            self.get_logger().warning(f"restarting: {why}")
        self._trackers.reset()
        for joint in self._joints:
            joint.reset()
        self._resets += 1
        self._fresh = True
        self._unanswered.clear()

    def _on_reset(self) -> tuple[bool, str]:
        # What was received before the reset must not be used after it.
        self._measurements.drain()
        self._begin_afresh("reset service")
        return True, "restarted"

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data and not self._enabled:
            self._measurements.drain()
            self._begin_afresh("enabled")
        self._enabled = request.data
        response.success = True
        response.message = "enabled" if request.data else "disabled: nothing is published"
        return response

    def _diagnose(self) -> None:
        if not self.active:
            self._diagnostics.publish([Status("state", Level.WARN, "INACTIVE", {})])
            return
        now, parameters, joints = self.get_clock().now().nanoseconds, self.parameters, self._joints
        values = {"resets": str(self._resets)}
        parts: dict[str, list[Status]] = {}
        if len(joints) == 1:
            values |= tracking_values(joints[0], now)
            further = estimate_statuses(joints[0], parameters.method)
        else:
            parts = {
                joint.name: joint_statuses(joint, now, parameters, enabled=self._enabled)
                for joint in joints
            }
            further = [summary_status(parts)]
        phase = worst_phase(joint.phase(now, parameters) for joint in joints)
        failed = self._has_failed()
        statuses = [
            state_status(phase, values, enabled=self._enabled, failed=failed),
            measurement_status([joint.tracker for joint in joints], self.received),
            self._meter.status(),
            *further,
        ]
        self._diagnostics.publish(statuses, parts)

    def _has_failed(self) -> bool:
        """Return, and say, whether there was a numerical failure since the last time."""
        failures = sum(joint.tracker.failures for joint in self._joints)
        failed = failures > self._told_failures
        self._told_failures = failures
        if failed and self._may_warn("failure"):
            self.get_logger().error("numerical failure: an estimate was not finite; restarted")
        return failed

    def _tell_of_designs(self) -> None:
        """Say what each joint is estimated with, and warn of methods that cannot work."""
        by_path = {joint.loaded.path: joint.loaded for joint in self._joints}
        for path, loaded in by_path.items():
            names = ", ".join(each.name for each in self._joints if each.loaded.path == path)
            self.get_logger().info(
                f"{names}: design {path} ({loaded.identity}): certificate holds "
                f"({loaded.design.certificate.worst})"
            )
        method = self.parameters.method
        if method in WARNINGS:
            self.get_logger().warning(WARNINGS[method])
        elif method != "certified":
            self.get_logger().warning(
                f"method {method}: takes any disturbance of the sensor for motion of the arm; no "
                "bound is published"
            )


def create(**node_kwargs: Any) -> Observer:
    """Return the node, for the runtime or for an executor of your own."""
    return Observer(**node_kwargs)
