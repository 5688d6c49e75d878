# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `observer` node: measurements in, estimates with bounds out at a fixed rate.

Depending on the design, it estimates for each joint the angles and velocities of link and motor,
the sensors' disturbances and the torque of a contact, or the states of a T-S system.

topics, sensor_msgs/msg/JointState without another type:
  joint_measurements (in)      position: measured angle of the link [rad], 0 hanging down, or
                               velocity [rad/s]; also of <joint>_motor if both sides are measured;
                               effort: motor torque from the stamp on [N m];
                               for a T-S system: position of each output and input, by its name
  ~/joint_states (out)         <joint>_link and <joint>_motor [rad, rad/s]
  ~/error_bound (out)          1 sigma bound of each
  ~/disturbance (out)          disturbance of the sensor [rad] and its rate [rad/s]
  ~/disturbance_bound (out)    1 sigma bound of the disturbance
  ~/torque_disturbance (out)   effort: torque in addition to the known one at <joint>_motor and
                               <joint>_link, as far as the design models it [N m]
  ~/torque_disturbance_bound (out)
                               1 sigma bound of each
  ~/parameters_estimate (out)  learnt changes of the parameters that the design calls uncertain
  ~/parameters_bound (out)     1 sigma bound of each
  ~/innovation (out)           measured minus expected value of each output in use
  ~/restarts (out)             number of restarts; latched
  ~/design (out)               std_msgs/msg/String: design and parameters, as JSON; latched
  ~/health (out)               quality of the estimates, ten times per second
  ~/ticks (out)                std_msgs/msg/Int64MultiArray: the measurements behind each estimate
  /diagnostics (out)           diagnostic_msgs/msg/DiagnosticArray, once per second

services:
  ~/reset                      std_srvs/srv/Trigger: restart as a new observer
  ~/enable                     std_srvs/srv/SetBool: switch the estimates on or off
"""

import time
from collections import deque
from collections.abc import Iterable
from functools import partial
from itertools import chain, compress

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.design.file import identity, record_text
from tsobs_ros.estimation.events import Event
from tsobs_ros.estimation.faults import FaultKind
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.methods import ObserverSettings, warning
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.observer.joints import FAILURES, ObservedJoint, observed_joints
from tsobs_ros.nodes.observer.messages import EstimatePublisher
from tsobs_ros.nodes.observer.parameters import ObserverParameters
from tsobs_ros.nodes.observer.statuses import TickMeter, statuses_of
from tsobs_ros.nodes.runtime import Ticker
from tsobs_ros.nodes.wire import LATCHED, DrainedSubscription
from tsobs_ros.replay.samples import MeasurementReader
from tsobs_ros.settings import settings_of, values_of

MEASUREMENT_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Sensor data with room for a second of samples, as the queue is emptied only once per tick."""

# A tick reads the queue for at most this share of its period and at most this time [s], which
# leaves the rest of half a period for the estimation. Unread messages stay in the queue.
_MAX_SHARE = 0.4
_MAX_BACKLOG = 0.05
# The highest rate of one node [Hz]; a design may have a higher one.
_FASTEST = 2000.0
_DISABLED = "disabled: nothing is published until ~/enable"
# Looks for measurements per period of the fastest design, with `publish_on: measurement`.
_LOOKS = 8


class Observer(ManagedNode[ObserverParameters]):
    """Runs the certified observers of one or several independent joints.

    Configuring loads the designs and re-checks their certificates. Each activation starts the
    estimation from nothing. While the node is inactive, it discards new measurements.

    Attributes:
        joints: The joints with their trackers and counts.
    """

    def configure(self) -> None:
        """Load the designs and make everything."""
        parameters = self.parameters
        topic = self.resolve_topic_name("joint_measurements")
        self.joints = observed_joints(parameters, topic)
        self._resets, self._enabled = -1, True
        self._last_now = self._last_output = 0
        self._newest = b""
        self._unanswered: deque[int] = deque(maxlen=MEASUREMENT_QOS.depth)
        # The default is the rate of measurements in the design, the fastest one of several designs.
        own = max(joint.design.request.rate for joint in self.joints)
        self._rate = parameters.rate or min(own, _FASTEST)
        self._meter = TickMeter(self._rate)

        places = {joint.name: joint.signals for joint in self.joints}
        self._reader = MeasurementReader(places, parameters.assume_zero_torque)
        at_once = parameters.publish_on == "measurement"
        self._measurements = DrainedSubscription(
            self,
            JointState,
            "joint_measurements",
            MEASUREMENT_QOS,
            raw=True,
            on_arrival=partial(self._work, is_tick=False) if at_once else None,
        )
        self._publisher = EstimatePublisher(self, places, [joint.learnt for joint in self.joints])
        self._record = self.create_publisher(String, f"~/{topics.DESIGN}", LATCHED)
        self.offer_diagnostics(", ".join(parameters.joints), self._statuses)
        self.offer_triggers({"reset": self._on_reset})
        self.create_service(SetBool, "~/enable", self._on_enable)
        self.ticker = self._ticker = Ticker(
            self,
            1.0 / self._rate,
            self._work,
            look=self._measurements.look if at_once else None,
            look_period=1.0 / (_LOOKS * min(max(own, self._rate), _FASTEST)),
        )
        for joint in self.joints:
            design = f"design {joint.design.file} ({identity(joint.design)})"
            self.log(Level.OK, f"{joint.name}: {design}: certificate holds")
        warnings = (warning(joint.design, parameters.method) for joint in self.joints)
        for text in filter(None, dict.fromkeys(warnings)):
            self.log(Level.WARN, text)

    def activate(self) -> None:
        """Start to estimate from the measurements that arrive from now on."""
        self._measurements.discard()
        self._publish_record()
        self._restart("activated again" if self._resets >= 0 else "")
        if not self._enabled:
            self.log(Level.WARN, _DISABLED)

    def retune(self, parameters: ObserverParameters) -> None:
        """Take over parameters that were changed while the node runs."""
        for joint in self.joints:
            joint.retune(parameters)
        if self.active:
            self._publish_record()

    def _log(self, joint: ObservedJoint, news: Iterable[Event]) -> None:
        for event in news:
            self.log(event.level, f"{joint.name}: {event.text}")

    def _work(self, *, is_tick: bool = True) -> None:
        """Take new measurements, then publish: always at a tick, else only if any was used."""
        if self.active and (now := self._now()) is not None:
            self._meter.begin(now, tick=is_tick)
            used = self._take_all(now)
            if self._publish(now, wanted=is_tick or used) and not is_tick:
                self._ticker.skip_next()
            self._meter.end()

    def _now(self) -> int | None:
        """Return the time, or None before simulated time begins; restart if the clock went back."""
        now = self.now()
        if now == 0:
            return None
        if now < self._last_now and self.parameters.reset_on_backward_jump:
            self._last_output = 0
            self._restart(f"the clock went back by {(self._last_now - now) * 1e-9:.3f} s")
        self._last_now = now
        return now

    def _take_all(self, now: int) -> bool:
        """Take as many new measurements as time permits; return whether any was used."""
        until = time.monotonic() + min(_MAX_SHARE / self._rate, _MAX_BACKLOG)
        taken = self._measurements.drain(until=until)
        if not taken or not self._enabled:
            return False
        messages = [data for data, _ in taken]
        self._publisher.take(messages)
        self._newest = messages[-1]
        batch = self._reader.read(messages)
        innovations = []
        for joint, y, u, codes in zip(self.joints, batch.y, batch.u, batch.codes, strict=True):
            innovations.append(joint.offer(batch.stamps, y, u, codes, now).tolist())
            for place in np.flatnonzero(codes > 0).tolist() if np.count_nonzero(codes) else ():
                reason = RejectReason(int(codes[place]))
                if self.is_due((joint.name, reason)):
                    found = self._reader.describe(messages[batch.order[place]], joint.name)
                    text = f"sample of {joint.name} rejected: {reason.text} ({found}, clock "
                    self.log(Level.WARN, f"{text}{now * 1e-9:.3f}): {reason.remedy}")
        rows = [list(chain(*each)) for each in zip(*innovations, strict=True)]
        self._publisher.publish_innovations(batch.stamps.tolist(), rows)
        used = [any(each == each for each in row) for row in rows]  # NaN does not equal itself
        self._unanswered += [
            taken[place][1]["received_timestamp"] for place in compress(batch.order, used)
        ]
        return any(used)

    def _publish(self, now: int, *, wanted: bool) -> bool:
        """Publish estimates for the present time; return whether there were any."""
        if not self._enabled:
            return False
        joints = self.joints if wanted and now > self._last_output else ()
        each = ((place, joint.estimate(now)) for place, joint in enumerate(joints))
        estimates = {place: one for place, one in each if one is not None}
        due = self._publisher.publish(now, estimates)
        if estimates:
            self._last_output = now
            done = time.time_ns()
            for arrived in self._unanswered:
                self._meter.answered(done - arrived)
            self._unanswered.clear()
        for place, joint in enumerate(joints):
            self._log(joint, joint.news(now, estimates.get(place), due))
        return bool(estimates)

    def _restart(self, why: str) -> None:
        """Reset everything that is computed from data, including the counts of the joints."""
        if why and self.is_due("restart"):
            self.log(Level.WARN, f"restarting: {why}")
        for joint in self.joints:
            joint.reset()
        self._resets += 1
        self._meter.restart()
        self._unanswered.clear()
        now = self.now()
        self._publisher.publish_restart(now, self._resets)

    def _publish_record(self) -> None:
        """Publish designs and parameters, latched."""
        values = values_of(self.parameters)
        text = record_text(
            self.resolve_topic_name("joint_measurements"),
            [joint.name for joint in self.joints],
            [joint.design for joint in self.joints],
            {name: values[name] for name in settings_of(ObserverSettings)},
        )
        self._record.publish(String(data=text))

    def _on_reset(self) -> str:
        if not self.active:
            return "inactive: each activation restarts"
        # Messages received before the reset must not be used after it.
        self._measurements.discard()
        self._restart("reset service")
        return "restarted"

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data != self._enabled and self.active:
            if request.data:
                self._measurements.discard()
                self._restart("enabled")
            else:
                self.log(Level.WARN, _DISABLED)
        self._enabled = request.data
        response.success, response.message = True, "enabled" if request.data else _DISABLED
        return response

    def _statuses(self) -> list[Status]:
        if not self.active:
            return [Status("state", Level.WARN, "INACTIVE", {})]
        timing, now = self._meter.status(), self.now()
        if now == 0:
            text = "waiting for /clock: use_sim_time is set, and nothing publishes the time"
            if self.is_due("clock"):
                self.log(Level.WARN, text)
            return [Status("state", Level.WARN, text, {}), timing]
        for joint in self.joints:
            self._log(joint, joint.count())
            if joint.newly[FAILURES]:
                what = "numerical failure: an estimate was not finite; restarted"
                self.log(Level.ERROR, f"{joint.name}: {what}")
            names = joint.request.output_names
            each = zip(names, joint.faults.faults, joint.signals.outputs, strict=True)
            for output, fault, place in each:
                if fault.kind is FaultKind.MISSING and self.is_due((joint.name, output)):
                    newest = self._reader.describe(self._newest, joint.name)
                    text = f"{output} is missing: expected {place.described}; the newest message: "
                    text += f"{newest}; estimation goes on without it"
                    self.log(Level.WARN, f"{joint.name}: {text}")
        return statuses_of(self.joints, timing, now, resets=self._resets, enabled=self._enabled)


Parameters = ObserverParameters
create = partial(Observer, "observer", Parameters)
