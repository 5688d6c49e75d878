# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `observer` node: measurements in, certified estimates out at a fixed rate."""

from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.health import (
    DisturbanceLimits,
    DisturbanceMonitor,
    InnovationMonitor,
    Level,
    Phase,
    Status,
    phase_of,
)
from tsobs_ros.estimation.observer import GainMode
from tsobs_ros.estimation.records import NANOSECONDS, Estimate, RejectReason
from tsobs_ros.estimation.supervised import SupervisedState
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.nodes.diagnostics import DiagnosticsPublisher
from tsobs_ros.nodes.draining import DrainedSubscription
from tsobs_ros.nodes.observer_io import MEASUREMENT_QOS, EstimatePublisher, to_measurement
from tsobs_ros.nodes.observer_parameters import ObserverParameters
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
        self._estimator = self._design.supervised(
            parameters.settle_time, GainMode(parameters.gain_mode), parameters.adapt
        )
        self._estimator.options = parameters.supervision.options()
        self._tracker = Tracker(
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
        self._disturbances = DisturbanceMonitor(self._limits(parameters))
        self._meter = TickMeter(parameters.rate)

        self._measurements = DrainedSubscription(
            self, JointState, "joint_measurements", MEASUREMENT_QOS
        )
        learnt = tuple(self._design.request.uncertainty) if parameters.adapt else ()
        self._publisher = EstimatePublisher(self, parameters.joint, learnt)
        self._diagnostics = DiagnosticsPublisher(self, hardware_id=parameters.joint)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/enable", self._on_enable)
        self.ticker = Ticker(self, 1.0 / parameters.rate, self._tick)
        # Not the node's clock: a paused simulation is still worth a diagnosis.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_DIAGNOSTICS_PERIOD, self._diagnose, clock=steady)
        certificate = self._design.certificate.worst
        self.get_logger().info(f"design {path}: certificate holds ({certificate})")

    @property
    def tracker(self) -> Tracker[SupervisedState]:
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
            outcome: Any = read
        else:
            outcome = self._tracker.offer(read, now)
        if isinstance(outcome, RejectReason):
            self._warn_of_rejection(outcome, message, now)
            return
        self._innovations.update(outcome.stamp, float(outcome.value[0] / outcome.expected_std[0]))
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
        self._disturbances.update(now, float(estimate.disturbance[0]))
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
        self._disturbances = DisturbanceMonitor(self._limits(self._binding.value))

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
        self._disturbances.limits = self._limits(parameters)
        self._estimator.options = parameters.supervision.options()

    @staticmethod
    def _limits(parameters: ObserverParameters) -> DisturbanceLimits:
        fault = parameters.fault
        return DisturbanceLimits(fault.warn, fault.error, fault.hold)

    def _diagnose(self) -> None:
        self._diagnostics.publish(
            [
                self._state_status(),
                self._measurement_status(),
                self._meter.status(),
                self._domain_status(),
                self._innovations.status(),
                self._disturbances.status(),
                self._certificate_status(),
                *self._parameter_statuses(),
            ]
        )

    def _state_status(self) -> Status:
        age = self._age(self.get_clock().now().nanoseconds)
        phase = self._phase(age)
        level = {
            Phase.WAITING: Level.WARN,
            Phase.TRACKING: Level.OK,
            Phase.COASTING: Level.WARN,
            Phase.STALE: Level.ERROR,
        }[phase]
        values = {"resets": str(self._resets), "restarts": str(self._tracker.restarts)}
        values["numerical failures"] = str(self._tracker.failures)
        values |= {name: str(count) for name, count in self._tracker.events.items()}
        if age is not None:
            values["measurement age [s]"] = f"{age:.4f}"
        if not self._enabled:
            return Status("state", Level.WARN, "DISABLED", values)
        return Status("state", level, phase.value, values)

    def _measurement_status(self) -> Status:
        rejected = self._tracker.rejected
        total = sum(rejected.values())
        values = {
            "received": str(self._received),
            "used": str(self._tracker.used),
            "rewinds": str(self._tracker.rewinds),
        }
        values |= {f"rejected: {reason.value}": str(rejected[reason]) for reason in RejectReason}
        level = Level.WARN if total > 0.01 * max(self._received, 1) else Level.OK
        return Status("measurements", level, f"{total} rejected", values)

    def _domain_status(self) -> Status:
        x_max = self._design.request.x_max
        values = {"x_max [rad]": f"{x_max:.4g}"}
        if self._estimate is None:
            return Status("premise domain", Level.OK, "no estimate yet", values)
        values["link angle [rad]"] = f"{self._estimate.state[0]:.4f}"
        if self._estimate.in_domain:
            return Status("premise domain", Level.OK, "inside the certificate's domain", values)
        return Status("premise domain", Level.WARN, "outside: the bound is not certified", values)

    def _certificate_status(self) -> Status:
        certified = self._estimate is not None and self._estimate.certified
        request = self._design.request
        values = {
            "design": str(self._design_path),
            "disturbance model": request.disturbance_model.label,
            "design rate [Hz]": f"{request.rate:g}",
            "margin [1/s]": f"{self._design.certificate.worst.margin:.3e}",
            "gain": "certified" if certified else "riccati",
        }
        message = "certified gain and bound" if certified else "settling: bound along the estimate"
        return Status("certificate", Level.OK, message, values)

    def _parameter_statuses(self) -> list[Status]:
        """Return a status of the learnt parameters, if any are learnt."""
        names = tuple(self._design.request.uncertainty) if self._binding.value.adapt else ()
        if not names or self._estimate is None:
            return []
        learnt = zip(names, self._estimate.parameters, self._estimate.parameter_bound, strict=True)
        values = {name: f"{theta:.4f} +- {bound:.4f}" for name, theta, bound in learnt}
        if self._estimate.parameters_valid:
            return [Status("parameters", Level.OK, "learnt", values)]
        return [Status("parameters", Level.OK, "not yet: the motion is too poor", values)]


def create(**node_kwargs: Any) -> Observer:
    """Return the node, for the runtime or for an executor of your own."""
    return Observer(**node_kwargs)
