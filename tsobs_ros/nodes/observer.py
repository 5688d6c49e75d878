# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `observer` node: measurements in, certified estimates out at a fixed rate."""

import math
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation import comparison
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.faults import FaultMonitor
from tsobs_ros.estimation.health import DisturbanceLimits, InnovationMonitor, Phase, phase_of
from tsobs_ros.estimation.observer import GainMode
from tsobs_ros.estimation.records import NANOSECONDS, Estimate, RejectReason
from tsobs_ros.estimation.supervised import SupervisedObserver
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.nodes.diagnostics import DiagnosticsPublisher
from tsobs_ros.nodes.draining import DrainedSubscription
from tsobs_ros.nodes.observer_io import MEASUREMENT_QOS, EstimatePublisher, to_measurement
from tsobs_ros.nodes.observer_parameters import ObserverParameters
from tsobs_ros.nodes.observer_statuses import (
    certificate_status,
    domain_status,
    measurement_status,
    parameter_status,
    state_status,
)
from tsobs_ros.nodes.parameters import ParameterBinding
from tsobs_ros.nodes.tick_meter import TickMeter
from tsobs_ros.nodes.ticker import Ticker
from tsobs_ros.resources import config_path

_DIAGNOSTICS_PERIOD = 1.0
_THROTTLE = 5.0
_THROTTLE_NS = 5_000_000_000


class Observer(Node):
    """Runs the certified observer of one joint.

    Args:
        node_kwargs: Arguments of `rclpy.node.Node`, such as `context` or `parameter_overrides`.

    Raises:
        ParameterError: A parameter has a wrong type or value.
        DesignFileError: The design file is missing or malformed.
        CertificateError: The design's certificate does not hold.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("observer", **node_kwargs)
        try:
            self._start()
        except BaseException:
            super().destroy_node()
            raise

    def _start(self) -> None:
        self._binding = ParameterBinding(self, ObserverParameters, on_change=self._retune)
        parameters = self._binding.value
        path = (
            Path(parameters.design)
            if parameters.design
            else config_path("elastic_joint.design.yaml")
        )
        self._design = load_design(path)
        self._design_path = path
        self._estimator = self._make_estimator(parameters)
        self._tracker: Tracker[Any] = Tracker(
            self._estimator,
            TrackerOptions(
                x_max=self._design.request.x_max,
                history=parameters.history,
                future_tolerance=parameters.future_tolerance,
                restart_after=parameters.stale_after,
            ),
        )
        self._received = 0
        self._resets = 0
        self._enabled = True
        self._last_now = 0
        self._last_output = 0
        self._next_warning: dict[RejectReason, int] = {}
        self._estimate: Estimate | None = None
        self._innovations = InnovationMonitor()
        self._faults = self._fault_monitor(parameters)
        self._meter = TickMeter(parameters.rate)

        self._measurements = DrainedSubscription(
            self, JointState, "joint_measurements", MEASUREMENT_QOS
        )
        self._publisher = EstimatePublisher(self, parameters.joint, self._learnt)
        self._diagnostics = DiagnosticsPublisher(self, hardware_id=parameters.joint)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/enable", self._on_enable)
        self.ticker = Ticker(self, 1.0 / parameters.rate, self._tick)
        # Not the node's clock: a paused simulation is still worth a diagnosis.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_DIAGNOSTICS_PERIOD, self._diagnose, clock=steady)
        certificate = self._design.certificate.worst
        self.get_logger().info(f"design {path}: certificate holds ({certificate})")

    def _make_estimator(self, parameters: ObserverParameters) -> Estimator[Any]:
        """Return what the parameter `method` names, and warn of a method that cannot work."""
        request = self._design.request
        if parameters.method == "certified":
            supervised = self._design.supervised(
                parameters.settle_time, GainMode(parameters.gain_mode), parameters.adapt
            )
            supervised.options = parameters.supervision.options()
            return supervised
        common = (request.period, request.measurement_std)
        if parameters.method == "paper":
            estimator = comparison.paper(request.arm, *common)
            self.get_logger().warning(comparison.PAPER_WARNING)
            return estimator
        make = (
            comparison.high_gain
            if parameters.method == "high_gain"
            else comparison.proportional_integral
        )
        self.get_logger().warning(
            f"method {parameters.method}: takes any disturbance of the sensor for motion of the "
            "arm; no bound is published"
        )
        return make(request.arm, parameters.theta, *common)

    @property
    def _learnt(self) -> tuple[str, ...]:
        """Names of the parameters that are learnt."""
        parameters = self._binding.value
        learns = parameters.method == "certified" and parameters.adapt
        return tuple(self._design.request.uncertainty) if learns else ()

    @property
    def tracker(self) -> Tracker[Any]:
        """The tracker behind the node, with its counts."""
        return self._tracker

    @property
    def received(self) -> int:
        """Number of messages taken since the start: used + rejected, as long as enabled."""
        return self._received

    def _tick(self) -> None:
        now = self.get_clock().now().nanoseconds
        if now == 0:
            return  # simulated time has not begun
        if now < self._last_now:
            self._meter.restart()
            self._begin_afresh(f"the clock went back by {(self._last_now - now) * 1e-9:.3f} s")
        self._last_now = now
        self._meter.begin(now)
        for message, _ in self._measurements.drain():
            if self._enabled:
                self._take(message, now)
        if self._enabled and now > self._last_output:
            self._publish(now)
        self._meter.end()

    def _take(self, message: JointState, now: int) -> None:
        """Use one message, or count and report why not."""
        parameters = self._binding.value
        self._received += 1
        read = to_measurement(message, parameters.joint, parameters.assume_zero_torque)
        if isinstance(read, RejectReason):
            self._tracker.reject(read)
            self._warn_of_rejection(read, message, now)
            return
        outcome = self._tracker.offer(read, now)
        if isinstance(outcome, RejectReason):
            if outcome is RejectReason.GATED:
                self._faults.unused(read.stamp, float(read.y[0]))
            self._warn_of_rejection(outcome, message, now)
            return
        innovation, expected_std = float(outcome.value[0]), float(outcome.expected_std[0])
        self._innovations.update(outcome.stamp, innovation / expected_std)
        self._faults.measured(outcome.stamp, float(read.y[0]), innovation, expected_std)
        self._publisher.publish_innovation(outcome)

    def _warn_of_rejection(self, reason: RejectReason, message: JointState, now: int) -> None:
        """Warn, throttled for each reason on its own, so that none hides another."""
        if now >= self._next_warning.get(reason, 0):
            self._next_warning[reason] = now + _THROTTLE_NS
            detail = self._detail(reason, message, now)
            self.get_logger().warning(f"measurement rejected: {reason.value} ({detail})")

    def _publish(self, now: int) -> None:
        age = self._age(now)
        phase = self._phase(age)
        if phase in (Phase.WAITING, Phase.STALE):
            return
        failures = self._tracker.failures
        estimate = self._tracker.estimate(now)
        if self._tracker.failures > failures:
            self.get_logger().error(
                "the estimate was not finite; started afresh", throttle_duration_sec=_THROTTLE
            )
        if estimate is None:
            return
        self._estimate = estimate
        if estimate.disturbance.size:
            bound = estimate.disturbance_bound
            self._faults.estimated(
                now, float(estimate.disturbance[0]), float(bound[0]) if bound.size else math.inf
            )
        self._publisher.publish(estimate)
        self._last_output = now

    def _age(self, now: int) -> float | None:
        newest = self._tracker.newest
        return None if newest is None else max(0, now - newest) / NANOSECONDS

    def _phase(self, age: float | None) -> Phase:
        parameters = self._binding.value
        return phase_of(age, parameters.coast_after, parameters.stale_after)

    def _detail(self, reason: RejectReason, message: JointState, now: int) -> str:
        if reason is RejectReason.WRONG_JOINT:
            return (
                f"expected position and effort of '{self._binding.value.joint}', got names "
                f"{list(message.name)} with {len(message.position)} positions and "
                f"{len(message.effort)} efforts"
            )
        if reason is RejectReason.NON_FINITE:
            return f"position {list(message.position)}, effort {list(message.effort)}"
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        return f"stamp {stamp:.3f}, clock {now * 1e-9:.3f}"

    def _begin_afresh(self, why: str) -> None:
        """Reset everything an instance computes from data; counts of a new instance are zero."""
        self.get_logger().warning(f"starting afresh: {why}")
        self._tracker.reset()
        self._received = 0
        self._resets += 1
        self._last_output = 0
        self._next_warning = {}
        self._estimate = None
        self._publisher.restart()
        self._innovations = InnovationMonitor()
        self._faults = self._fault_monitor(self._binding.value)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        # What was received before the reset must not be used after it.
        self._measurements.drain()
        self._begin_afresh("reset service")
        response.success, response.message = True, "started afresh"
        return response

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data and not self._enabled:
            self._measurements.drain()
            self._begin_afresh("enabled")
        self._enabled = request.data
        response.success = True
        response.message = "enabled" if request.data else "disabled: nothing is published"
        return response

    def _retune(self, parameters: ObserverParameters) -> None:
        self._faults.limits = self._limits(parameters)
        if isinstance(self._estimator, SupervisedObserver):
            self._estimator.options = parameters.supervision.options()

    def _fault_monitor(self, parameters: ObserverParameters) -> FaultMonitor:
        return FaultMonitor(self._design.request.measurement_std, self._limits(parameters))

    @staticmethod
    def _limits(parameters: ObserverParameters) -> DisturbanceLimits:
        fault = parameters.fault
        return DisturbanceLimits(fault.warn, fault.error, fault.hold)

    def _diagnose(self) -> None:
        age = self._age(self.get_clock().now().nanoseconds)
        method = self._binding.value.method
        statuses = [
            state_status(self._tracker, self._phase(age), age, self._resets, self._enabled),
            measurement_status(self._tracker, self._received),
            self._meter.status(),
            domain_status(self._estimate, self._design.request.x_max),
            self._innovations.status(),
            self._faults.status(),
            certificate_status(self._design, self._design_path, method, self._estimate),
        ]
        if self._learnt and self._estimate is not None:
            statuses.append(parameter_status(self._learnt, self._estimate))
        self._diagnostics.publish(statuses)


def create(**node_kwargs: Any) -> Observer:
    """Return the node, for the runtime or for an executor of your own."""
    return Observer(**node_kwargs)
