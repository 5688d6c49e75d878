# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Lifecycle nodes that work with `ros2 run` alone, and under a lifecycle manager as well.

A node acquires its entities in `configure` and need not release them: the clean-up destroys all
entities that were made since `configure` began, even if it failed half-way. rclpy's lifecycle stops
only lifecycle publishers, so callbacks check `active`.

A transition that fails with an expected error logs one line and leaves the node in its state; only
a failed clean-up still ends unconfigured. Any other exception is a bug: it is logged with its
traceback, and the node is cleaned up. Requests and times that would make rclpy's own callbacks
fail, and thus end the process, are refused.
"""

import math
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any, Generic, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock as SteadyClock
from rclpy.clock import ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription
from rclpy.time_source import TimeSource
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from tsobs_ros.errors import ParameterError, TsobsError, printable
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes.parameters import ManagedParameters, converted, declare, updated
from tsobs_ros.nodes.runtime import EXPECTED, Ticker
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.settings import in_yaml, values_of

# Time for the answer to a shutdown request to be sent, before the node is destroyed [s].
_FAREWELL = 0.5
# Time between two log lines on the same subject [s].
_QUIET = 5.0
# Time between two messages on /diagnostics [s].
_DIAGNOSTICS_PERIOD = 1.0
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_ERROR = TransitionCallbackReturn.ERROR

P = TypeVar("P", bound=ManagedParameters)


class ManagedNode(LifecycleNode, Generic[P]):
    """A lifecycle node; with the parameter `autostart` it configures and activates itself.

    Subclasses override `configure`, `activate`, `deactivate` and `retune` as they need them. The
    constructor ends with `start`.

    Args:
        schema: The dataclass of its parameters.
        **node_kwargs: Arguments of `rclpy.node.Node`, such as `context` or `parameter_overrides`.

    Attributes:
        parameters: The current parameters; the same object until it is changed or configured.
        active: Whether the node works.
        done: Whether its work has ended, until it is configured again.
        steady: A clock that is never set, for timers.
        ticker: Ticks for `runtime.run` to make, set by `configure`; None after the clean-up.

    Raises:
        ParameterError: A parameter has a wrong type or value.
        Exception: Any error of `configure` or `activate`; the node is destroyed.
    """

    ticker: Ticker | None = None
    _overrides: dict[str, Any] | None = None

    def __init__(self, name: str, schema: type[P], **node_kwargs: Any) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **node_kwargs)
        self.steady = SteadyClock(clock_type=ClockType.STEADY_TIME)
        self._acquired: ExitStack | None = None
        self.active = self.done = False
        self._finalized_at = math.inf
        self._failure: Exception | None = None
        self._starting = False
        self._due: dict[object, float] = {}
        for service in self.services:
            service.callback = partial(self._answer, service.callback)
        try:
            self.parameters = declare(self, schema, self._overrides or {})
            self.add_pre_set_parameters_callback(partial(converted, self, schema))
            self.add_on_set_parameters_callback(self._check_set)
            self.add_post_set_parameters_callback(self._take_set)
            self.start()
        except BaseException:
            self.destroy_node()
            raise

    def configure(self) -> None:
        """Acquire everything the work needs: files, publishers, subscriptions, services, timers."""

    def activate(self) -> None:
        """Start or continue to work; `active` becomes true after the return."""

    def deactivate(self) -> None:
        """Stop working and keep everything; `active` is already false."""

    def retune(self, parameters: P) -> None:
        """Apply changed parameters while the node is configured."""

    @property
    def configured(self) -> bool:
        """Whether the node is inactive or active, and holds what `configure` acquired."""
        return self._acquired is not None

    @property
    def finished(self) -> bool:
        """Whether the process may end: a node that was shut down never works again."""
        return self.done or time.monotonic() > self._finalized_at + _FAREWELL

    def now(self) -> int:
        """Return the time of the node's clock [ns], 0 before simulated time begins."""
        clock = self.get_clock()
        # Without simulated time, rclpy's clock is the system's, and takes twenty times as long.
        return int(clock.now().nanoseconds) if clock.ros_time_is_active else time.time_ns()

    def at_cleanup(self, callback: Callable[..., object], *args: Any) -> None:
        """Add a callback to the clean-up, which runs them latest first, then destroys entities."""
        assert self._acquired is not None, "nothing is cleaned up before it is configured"
        self._acquired.callback(callback, *args)

    def is_due(self, subject: object, period: float = _QUIET) -> bool:
        """Return whether a subject is due, once per period [s]; the default is for log lines."""
        now = time.monotonic()
        is_due = now >= self._due.get(subject, 0.0)
        if is_due:
            self._due[subject] = now + period
        return is_due

    def log(self, level: Level, text: str) -> None:
        """Log a line, in which names from elsewhere may contain any characters."""
        text = printable(text, newline=" ")
        # rclpy accepts only one severity from each line of code.
        if level is Level.OK:
            self.get_logger().info(text)
        elif level is Level.WARN:
            self.get_logger().warning(text)
        else:
            self.get_logger().error(text)

    def offer_diagnostics(self, hardware_id: str, make: Callable[[], list[Status]]) -> None:
        """Publish statuses once per second of real time, even while a simulation is paused.

        They are named "<node>: <concern>".
        """
        publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        node = self.get_fully_qualified_name().lstrip("/")

        def publish() -> None:
            message = DiagnosticArray()
            message.header.stamp = self.get_clock().now().to_msg()
            message.status = [
                DiagnosticStatus(
                    level=bytes([each.level]),
                    name=f"{node}: {each.name}",
                    message=each.message,
                    hardware_id=hardware_id,
                    values=[KeyValue(key=key, value=value) for key, value in each.values.items()],
                )
                for each in make()
            ]
            publisher.publish(message)

        self.create_timer(_DIAGNOSTICS_PERIOD, publish, clock=self.steady)

    def offer_triggers(self, answers: Mapping[str, Callable[[], str]]) -> None:
        """Offer std_srvs/Trigger services below the node's name; each function in `answers` returns
        the message of its service or raises an expected error."""

        def serve(answer: Any, _: Trigger.Request, response: Trigger.Response) -> Any:
            try:
                response.success, response.message = True, answer()
            except EXPECTED as error:
                response.success, response.message = False, str(error)
            return response

        for name, answer in answers.items():
            self.create_service(Trigger, f"~/{name}", partial(serve, answer))

    def start(self) -> None:
        """Configure and activate if `autostart` is true."""
        if not self.parameters.autostart:
            self.get_logger().info("unconfigured: waiting for lifecycle transitions")
            return
        self._starting = True
        try:
            for trigger in (self.trigger_configure, self.trigger_activate):
                if trigger() is not _SUCCESS:
                    raise self._failure or AssertionError(trigger)
        finally:
            self._starting = False

    def close(self) -> None:
        """Deactivate and clean up from any state; safe to call twice.

        Raises:
            TsobsError: Something could not be finished; everything has been released anyway.
        """
        try:
            self._deactivate()
        finally:
            self._clean_up()

    def destroy_node(self) -> None:
        """Close, then destroy the node."""
        try:
            self.close()
        finally:
            super().destroy_node()
            # rclpy's state machine keeps the node in the graph, and its name bound to its /rosout,
            # until the garbage collector frees both; a node of the same name may be made earlier.
            for held in list(vars(self).values()):
                release = getattr(held, "destroy_when_not_in_use", None)
                if release is not None:
                    release()

    def declare_parameters(
        self, namespace: str, parameters: list[Any], ignore_override: bool = False
    ) -> list[Any]:
        """Declare parameters; only store the overrides, which rclpy's constructor passes first."""
        if self._overrides is None:
            self._overrides = {name: value for name, value, _ in parameters}
            # rclpy declares it next, and raises an error that is not for users.
            if not isinstance(given := self._overrides.get("use_sim_time", False), bool):
                problem = f"expected true or false, got {in_yaml(given)}"
                raise ParameterError(f"parameter 'use_sim_time': {problem}")
            return []
        declared: list[Any] = super().declare_parameters(namespace, parameters, ignore_override)
        return declared

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, *args: Any, **kwargs: Any
    ) -> Subscription:
        """Subscribe; check times on /clock, to which rclpy subscribes if use_sim_time is set."""
        if isinstance(getattr(callback, "__self__", None), TimeSource):
            callback = partial(self._take_time, callback)
        return super().create_subscription(msg_type, topic, callback, *args, **kwargs)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure, for rclpy's lifecycle."""
        return self._attempt("configure", self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate, for rclpy's lifecycle."""
        result = self._attempt("activate", self.activate)
        self.active = result is _SUCCESS
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate, for rclpy's lifecycle; a failure means that the node stays active."""
        result = self._attempt("deactivate", self._deactivate)
        self.active = result is _FAILURE
        return result

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up, for rclpy's lifecycle; FAILURE would mean inactive, but without entities."""
        return _SUCCESS if self._attempt("clean up", self._clean_up) is _SUCCESS else _ERROR

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Shut down, for rclpy's lifecycle; the node is finalized even if a step fails."""
        self._finalized_at = time.monotonic()
        return _SUCCESS if self._attempt("shut down", self.close) is _SUCCESS else _FAILURE

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up after an error, for rclpy's lifecycle; the node can be configured again."""
        self._attempt("clean up after an error", self.close)
        return _SUCCESS

    def _configure(self) -> None:
        self.done, self._acquired = False, ExitStack()
        self.at_cleanup(self._destroy_all_but, self._entities())
        try:
            self.configure()
        except BaseException:
            self._clean_up()
            raise

    def _deactivate(self) -> None:
        if self.active:
            self.active = False
            self.deactivate()

    def _clean_up(self) -> None:
        if self._acquired is not None:
            with self._acquired:
                self._acquired = self.ticker = None

    def _entities(self) -> set[tuple[str, Any]]:
        """Return the node's ROS entities, each with its kind."""
        kinds = ("timer", "subscription", "service", "client", "publisher")
        return {(kind, entity) for kind in kinds for entity in getattr(self, f"{kind}s")}

    def _destroy_all_but(self, lasting: set[tuple[str, Any]]) -> None:
        for kind, entity in self._entities() - lasting:
            # Keep the subscription to /clock that rclpy makes as soon as use_sim_time is set.
            if getattr(getattr(entity, "callback", None), "func", None) != self._take_time:
                getattr(self, f"destroy_{kind}")(entity)

    def _check_set(self, proposal: Sequence[Parameter]) -> SetParametersResult:
        try:
            updated(self.parameters, proposal)
        except TsobsError as error:  # also from a file
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take_set(self, accepted: Sequence[Parameter]) -> None:
        before, self.parameters = self.parameters, updated(self.parameters, accepted)
        if self.configured and values_of(self.parameters) != values_of(before):
            try:
                self.retune(self.parameters)
            except Exception:
                self.parameters = before
                raise

    def _attempt(self, what: str, step: Callable[[], None]) -> TransitionCallbackReturn:
        """Take a step; log its error, unless `start` is going to raise it."""
        try:
            step()
        except Exception as error:
            expected = isinstance(error, EXPECTED)
            if self._starting:
                self._failure = self._failure or error
            else:
                reason = str(error) if expected else traceback.format_exc()
                newline = " " if expected else "\n"
                self.get_logger().error(printable(f"cannot {what}: {reason}", newline))
            return _FAILURE if expected else _ERROR
        return _SUCCESS

    def _answer(self, answer: Callable[..., Any], request: Any, response: Any) -> Any:
        """Let rclpy answer a request; refuse a request that it cannot answer."""
        if isinstance(request, ChangeState.Request):  # rcl logs labels unescaped
            request.transition.label = printable(request.transition.label)
        try:
            return answer(request, response)
        except Exception as error:  # any error of rclpy on an unexpected request
            kind = type(error).__name__
            reason = printable(f"cannot answer {type(request).__name__}: {error} ({kind})")
            if self.is_due("request"):
                self.log(Level.WARN, reason)
            result = SetParametersResult(successful=False, reason=reason)
            if isinstance(request, SetParameters.Request):
                left = len(request.parameters) - len(response.results)
                response.results = [*response.results, *[result] * left]
            elif isinstance(request, SetParametersAtomically.Request):
                response.result = result
            return response

    def _take_time(self, take: Callable[[Clock], None], message: Clock) -> None:
        """Pass a time on /clock to rclpy if rclpy and the stamps of messages can represent it."""
        sec, nanosec = message.clock.sec, message.clock.nanosec
        if sec >= 0 and nanosec < NANOSECONDS:
            take(message)
        elif self.is_due("clock"):
            self.log(
                Level.WARN,
                "dropped a time on /clock: expected 0 s or more and less than 1e9 ns, got "
                f"{sec} s and {nanosec} ns; time stands still until there is another",
            )
