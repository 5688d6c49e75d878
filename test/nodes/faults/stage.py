# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers in the process of a test, under a time that only the test lets pass.

Nothing waits and nothing races: what is published in one process is in every queue of it when
`publish` returns, time is where the test has put it, and a step ends when all ticks that it made
due are done.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from rclpy.clock import ClockType
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from faults.script import Counts, Event, Sender, steps
from faults.senders import Senders
from faults.watcher import Watcher
from tsobs_ros.nodes.messages import to_stamp
from tsobs_ros.nodes.observer import create

_TIMEOUT = 30.0
TOPIC = "/joint_measurements"


def start_observer(context: Any, namespace: str, **parameters: Any) -> Any:
    """Return an observer under simulated time that reads the stage's sensor."""
    given = {"use_sim_time": True, **parameters}
    return create(
        context=context,
        namespace=namespace,
        cli_args=["--ros-args", "-r", f"joint_measurements:={TOPIC}"],
        parameter_overrides=[Parameter(n.replace("__", "."), value=v) for n, v in given.items()],
    )


def counts_of(observer: Any) -> Counts:
    """Return what an observer counts, without the second's wait for its diagnostics."""
    trackers = [joint.tracker for joint in observer.joints]
    rejected = sum((tracker.rejected for tracker in trackers), Counter())
    return Counts(observer.received, sum(tracker.used for tracker in trackers), rejected)


class Stage:
    """Observers, a sensor and the time.

    Attributes:
        now: The simulated time [ns].
        observers: By namespace.
        watchers: What reads the observers, by namespace.

    Args:
        ros: The fixture of test/conftest.py.
    """

    def __init__(self, ros: Any) -> None:
        self.ros = ros
        self.now = 0
        self.observers: dict[str, Any] = {}
        self.watchers: dict[str, Watcher] = {}
        self.node = ros.node("stage")
        self.senders = Senders(self.node, TOPIC, self._wait_for_match)
        self._clock = self.node.create_publisher(Clock, "/clock", 100)

    def close(self) -> None:
        """Release what the fixture does not know."""
        self.senders.close()

    def add(
        self,
        namespace: str = "",
        keep: Callable[[str, Any], None] | None = None,
        **parameters: Any,
    ) -> Any:
        """Start an observer and wait until everything is connected; it has the time there is."""
        watcher = Watcher(self.node, f"{namespace}/observer", keep)
        observer = self.ros.add(start_observer(self.ros.context, namespace, **parameters))
        self.observers[namespace], self.watchers[namespace] = observer, watcher
        self.wait_until(lambda: watcher.matched, "matching of the outputs")
        self._wait_for_match(self._clock)
        for sender in (Sender.SENSOR, Sender.SECOND_SENSOR):
            self._wait_for_match(self.senders.publisher(sender))
        if self.now:
            self.step(self.now)
        return observer

    def remove(self, namespace: str) -> None:
        """End an observer and what reads it."""
        self.watchers.pop(namespace).close()
        self.ros.remove(self.observers.pop(namespace))

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service and return its answer."""
        client = self.node.create_client(kind, name)
        self.wait_until(client.service_is_ready, f"the service {name}")
        future = client.call_async(request)
        self.wait_until(future.done, f"the answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def play(self, events: Iterable[Event], until: int, period: int) -> None:
        """Send events as their time comes, time going on by a period at a time, to `until` [ns]."""
        for now, batch in steps(list(events), self.now + period, until, period):
            self.step(now, batch)

    def step(self, now: int, batch: Iterable[Event] = ()) -> None:
        """Send a batch, set the time, and let everybody do what is then due."""
        for event in batch:
            self.senders.send(event)
        self.set_clock(now)
        for watcher in self.watchers.values():
            watcher.read()

    def set_clock(self, now: int) -> None:
        """Set the time, and let everybody do what is then due."""
        if now < self.now:
            for watcher in self.watchers.values():
                watcher.time_began_anew()
        self.now = now
        self._clock.publish(Clock(clock=to_stamp(now)))
        self.wait_until(self._settled, f"the ticks of {now}")

    def counts(self, namespace: str = "") -> Counts:
        """Return what became of the messages, as an observer counts them."""
        return counts_of(self.observers[namespace])

    def wait_until(self, predicate: Callable[[], bool], what: str) -> None:
        """Spin until something is so."""
        self.ros.spin_until(predicate, _TIMEOUT, what)

    def _settled(self) -> bool:
        return all(
            observer.get_clock().now().nanoseconds == self.now and not _has_work(observer)
            for observer in self.observers.values()
        )

    def _wait_for_match(self, publisher: Any) -> None:
        wanted = len(self.observers)
        self.wait_until(lambda: publisher.get_subscription_count() >= wanted, "matching")


def _has_work(observer: Any) -> bool:
    """Return whether a tick is due: whoever spins runs a due timer and returns when it is done."""
    return any(
        timer.is_ready()
        for timer in observer.timers
        if timer.clock.clock_type == ClockType.ROS_TIME
    )
