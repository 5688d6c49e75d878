# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Plays kinds of bad input to an observer that runs somewhere, in real time, and reports."""

import time
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from faults.arm import Arm
from faults.script import Counts, Kind, complaints
from faults.senders import Senders
from faults.watcher import SIGMAS, Watcher
from tsobs_ros.estimation.records import NANOSECONDS, RejectReason

_PATIENCE = 10.0
_LEAD = 200_000_000
_TICK = 20_000_000


class Outcome(NamedTuple):
    """What became of one kind.

    Attributes:
        counts: What the observer counted.
        sigmas: The largest error of the last estimate, in bounds; None if none came.
        complaints: What was not as it must be; empty if all was.
    """

    counts: Counts
    sigmas: float | None
    complaints: list[str]


class Live:
    """A sensor and a listener beside an observer on the wall clock.

    Args:
        observer: The observer's full name, such as /observer.
        topic: Where it takes its measurements from.
        joint: The joint's name.
    """

    def __init__(self, observer: str, topic: str, joint: str) -> None:
        self._observer, self._joint = observer, joint
        self._node = Node("faults")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._diagnostics: dict[str, DiagnosticStatus] = {}
        self._told = 0
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._keep, 10)
        self._reset = self._node.create_client(Trigger, f"{observer}/reset")
        self._watcher = Watcher(self._node, observer)
        self._senders = Senders(self._node, topic, self._wait_for_match)

    def close(self) -> None:
        """Release everything."""
        self._senders.close()
        self._executor.shutdown()
        self._node.destroy_node()

    def play(self, kind: Kind) -> Outcome:
        """Play one kind to an observer that restarts, and say what became of it."""
        self._begin_afresh()
        arm = Arm(time.time_ns() + _LEAD, self._joint)
        events = kind.script(arm)
        for event in events:
            self._spin_until_time(event.at)
            self._senders.send(event)
        sigmas = self._sigmas(arm, events[-1].at)
        self._wait_for_diagnosis()
        counts = self._counts()
        said = [*complaints(events, counts, may_lose=True), *self._watcher.broken]
        if sigmas is None or sigmas > SIGMAS:
            said.append("no estimate at the end" if sigmas is None else "the error is too large")
        return Outcome(counts, sigmas, said)

    def _begin_afresh(self) -> None:
        self._wait(self._reset.service_is_ready, f"an observer of the name {self._observer}")
        answer = self._reset.call_async(Trigger.Request())
        self._wait(answer.done, "the observer's reset")
        self._watcher.broken.clear()

    def _sigmas(self, arm: Arm, last: int) -> float | None:
        """Wait for an estimate of now; return its largest error in bounds, None without one."""
        until = last + NANOSECONDS
        while (self._watcher.stamp() or 0) < last:
            if time.time_ns() > until:
                return None
            self._spin_until_time(time.time_ns() + _TICK)
        return self._watcher.sigmas(arm)

    def _counts(self) -> Counts:
        values = {item.key: item.value for item in self._diagnostics["measurements"].values}
        rejected = {reason: int(values[f"rejected: {reason.value}"]) for reason in RejectReason}
        return Counts(int(values["received"]), int(values["used"]), rejected)

    def _keep(self, message: DiagnosticArray) -> None:
        prefix = f"{self._observer.lstrip('/')}: "
        for status in message.status:
            if status.name.startswith(prefix):
                self._diagnostics[status.name.removeprefix(prefix)] = status
                self._told = time.monotonic_ns()

    def _wait_for_diagnosis(self) -> None:
        """Wait for diagnostics that know all that was sent."""
        for _ in range(2):
            since = time.monotonic_ns()
            self._wait(lambda since=since: self._told > since, "the observer's diagnostics")

    def _wait_for_match(self, publisher: Any) -> None:
        self._wait(
            lambda: publisher.get_subscription_count() > 0, f"{publisher.topic_name}'s match"
        )

    def _wait(self, predicate: Any, what: str) -> None:
        deadline = time.monotonic() + _PATIENCE
        while not predicate():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{what}: nothing in {_PATIENCE:g} s")
            self._executor.spin_once(timeout_sec=0.05)
            self._watcher.read()

    def _spin_until_time(self, at: int) -> None:
        while (left := at - time.time_ns()) > 0:
            self._executor.spin_once(timeout_sec=min(left / NANOSECONDS, 0.02))
            self._watcher.read()


def play_all(kinds: list[Kind], observer: str, topic: str, joint: str) -> dict[str, Outcome]:
    """Play kinds one after the other, printing a line for each, and return what became of them."""
    rclpy.init()
    live = Live(observer, topic, joint)
    outcomes = {}
    try:
        print(f"{'kind':32s} {'received':>8s} {'used':>6s} {'error':>7s}  rejected")
        for kind in kinds:
            outcomes[kind.name] = live.play(kind)
            print(line(kind.name, outcomes[kind.name]), flush=True)
    finally:
        live.close()
        rclpy.shutdown()
    return outcomes


def line(name: str, outcome: Outcome) -> str:
    """Return an outcome as a line of the table, with complaints below."""
    counts = outcome.counts
    rejected = ", ".join(f"{n} {reason.value}" for reason, n in counts.rejected.items() if n)
    error = "none" if outcome.sigmas is None else f"{outcome.sigmas:.1f} σ"
    text = f"{name:32s} {counts.received:8d} {counts.used:6d} {error:>7s}  {rejected}"
    return "\n".join([text, *(f"  WRONG: {each}" for each in outcome.complaints)])
