"""What every node of this package shares: parameters, managed life, diagnostics, throttled words."""

from __future__ import annotations

import inspect
import math
import textwrap
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.subscription import Subscription

from flexmanip_ros.errors import FlexmanipError, ParameterError
from flexmanip_ros.io import cdr
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.diagnostics import ERROR, WARN, Report
from flexmanip_ros.ros.parameters import NodeParameters
from flexmanip_ros.ros.real_time import RealTime
from flexmanip_ros.ros.wake_latency import UNASKED

Config = TypeVar('Config')
THROTTLE_S = 2.0
"""A repeated complaint is written at most this often."""
LONGEST_WORDS = 600
"""Characters of a complaint: it may quote a message, and that may be of any length, over any lines."""


class FlexmanipNode(LifecycleNode, Generic[Config]):
    """A managed node over one configuration class.

    Subclasses write ``start`` (configure), ``activated``, ``deactivated`` and ``report``. Topics and
    services are made once and stay: what is not active takes nothing and says nothing.
    """

    THREAD_PRIORITY, WAKE_LATENCY = 0, UNASKED
    """Defaults of ``thread_priority`` and ``wake_latency``."""

    def __init__(self, name: str, cls: type[Config], *, context: Context | None = None,
                 overrides: list[Parameter] | None = None, namespace: str | None = None,
                 cli_args: list[str] | None = None) -> None:
        """Declare the parameters; raises ParameterError naming the one that is wrong."""
        super().__init__(name, context=context, parameter_overrides=overrides, namespace=namespace,
                         cli_args=cli_args)
        self.active = False
        self._entities_made = False
        self.events: dict[str, int] = {}
        self._logged_at: dict[str, float] = {}
        try:
            self.autostarts = bool(self.declare_parameter(
                'autostart', True, ParameterDescriptor(
                    description='configure and activate at start; false: wait for ros2 lifecycle set',
                    read_only=True)).value)
            self.real_time = RealTime(self, self.THREAD_PRIORITY, self.WAKE_LATENCY)
            self.parameters: NodeParameters[Config] = NodeParameters(self, cls, self.configuration_changed)
        except BaseException:
            self.destroy_node()
            raise
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # Steady: diagnostics come even while simulated time stands still.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics_timer = self.create_timer(1.0, self.diagnose, clock=self._steady)

    @property
    def config(self) -> Config:
        """The parameters as they are now."""
        return self.parameters.config

    # What a subclass fills in.

    def make_entities(self) -> None:
        """Create publishers, subscriptions, services and timers; called once, at the first configure."""

    def start(self) -> None:
        """Build the state, compile what must be compiled. FlexmanipError refuses the configuration."""

    def activated(self) -> None:
        """Begin to work."""

    def deactivated(self) -> None:
        """Cease to work; what was published before stays."""

    def configuration_changed(self, config: Config) -> None:
        """Take parameters that were changed while running."""

    def report(self, report: Report) -> None:
        """Fill the node's diagnostic entry."""

    # Managed life.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create what the node needs and build its state."""
        return self._transition(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work."""
        return self._transition(self._activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Cease to work."""
        return self._transition(self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the state; the next configure builds it anew."""
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Cease to work for good."""
        return self._transition(self._deactivate)

    def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:
        """Answer no to a transition that the present state does not have.

        The method of rclpy 7.1 (Jazzy) raises, which ends the node: ros2/rclpy#1209.
        """
        try:
            return super()._LifecycleNodeMixin__on_change_state(request, response)
        except RuntimeError as error:
            state, reason = self._state_machine.current_state[1], str(error).split(', at ')[0]
            self.get_logger().error(f"a transition was refused in state '{state}': {reason}")
            response.success = False
            return response

    def autostart(self) -> bool:
        """Configure and activate at once, as a plain ``ros2 run`` expects, unless ``autostart`` is false.

        Return False, with the reason logged, when the node could not.
        """
        return not self.autostarts or all(
            transition() == TransitionCallbackReturn.SUCCESS
            for transition in (self.trigger_configure, self.trigger_activate))

    def close(self) -> None:
        """Cease to work before the node is destroyed."""
        self._transition(self._deactivate)

    def _configure(self) -> None:
        if not self._entities_made:
            self.make_entities()
            self._entities_made = True
        self.start()

    def _activate(self) -> None:
        self.activated()
        self.active = True

    def _deactivate(self) -> None:
        if self.active:
            self.active = False
            self.deactivated()

    def _transition(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        """Run a part of a transition; rclpy would swallow its exception without a word."""
        try:
            work()
        except FlexmanipError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception:
            self.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    # Topics.

    def publisher(self, kind: type[Any], topic: str, profile: QoSProfile) -> Publisher:
        """Create a publisher whose quality of service the user may override."""
        with _qos_errors(topic):
            return self.create_publisher(kind, topic, profile, qos_overriding_options=qos.overridable())

    def subscription(self, kind: type[Any], topic: str, callback: Callable[..., None],
                     profile: QoSProfile, *, raw: bool = False,
                     matched: Callable[[Any], None] | None = None) -> Subscription:
        """Create a subscription whose quality of service the user may override; its events are counted.

        matched: called when a publisher comes or goes.
        """
        watch = SubscriptionEventCallbacks(
            matched=matched,
            deadline=lambda event: self._count(topic, 'deadline_missed', event.total_count),
            liveliness=lambda event: self._count(topic, 'publishers_not_alive', event.not_alive_count),
            incompatible_qos=lambda event: self._incompatible(topic, event))
        with _qos_errors(topic):
            return self.create_subscription(
                kind, topic, callback, profile, raw=raw, qos_overriding_options=qos.overridable(),
                event_callbacks=watch)

    def _count(self, topic: str, what: str, count: int) -> None:
        self.events[f'{topic} {what}'] = count

    def _incompatible(self, topic: str, event: Any) -> None:
        self._count(topic, 'incompatible_publishers', event.total_count)
        self.get_logger().error(
            f"a publisher of '{topic}' offers a quality of service this node cannot take; set "
            f'qos_overrides.{self.resolve_topic_name(topic)}.subscription.reliability or its like')

    # Words.

    def log_throttled(self, reason: str, words: str) -> None:
        """Log an error, at most every few seconds for one reason."""
        now = time.monotonic()
        if now - self._logged_at.get(reason, -math.inf) >= THROTTLE_S:
            self._logged_at[reason] = now
            self.get_logger().error(textwrap.shorten(words, LONGEST_WORDS, placeholder=' ...'))

    def stamp_of(self, raw: bytes) -> int | None:
        """Return the header stamp [ns] of a serialized JointState; None, with a complaint, without one."""
        try:
            return cdr.stamp_ns(raw)
        except cdr.CdrError:
            self.log_throttled('encoding', 'a JointState of another encoding than CDR was dropped')
            return None

    def diagnose(self) -> None:
        """Publish the node's diagnostic entry."""
        report = Report()
        self.report(report)
        report.values['active'] = self.active
        self.real_time.report(report)
        for name, count in self.events.items():
            report.values[name] = count
            if count:
                report.worse(WARN if name.endswith('deadline_missed') else ERROR, f'{name}: {count}')
        own = self.get_name(), self.get_namespace()
        if self.get_node_names_and_namespaces().count(own) > 1:
            report.worse(ERROR, 'another node has the same name; stop one, or rename it with __node')
        if not self.active:
            report.words.insert(0, 'not active')
        self._diagnostics.publish(report.message(self.get_name(), self.get_clock().now().to_msg()))


@contextmanager
def _qos_errors(topic: str) -> Iterator[None]:
    """Say a quality of service that cannot be as an error of the parameter that asked for it."""
    try:
        yield
    except (RuntimeError, ValueError, InvalidQosOverridesError, ParameterException) as error:
        raise ParameterError(f"qos_overrides of '{topic}': {error}",
                             'give a policy that ROS knows, such as reliable or best_effort') from error


def with_info(callback: Callable[[Any, Any], None]) -> Callable[..., None]:
    """Adapt a ``(message, info)`` callback to both executors.

    rclpy looks at the signature to see that the information is wanted; the events executor of Jazzy then
    hands over one tuple where the others give two arguments.
    """
    def adapter(message: Any, info: Any = None) -> None:
        if info is None:
            message, info = message
        callback(message, info)

    adapter.__signature__ = inspect.signature(callback)  # type: ignore[attr-defined]
    return adapter


def sequence_number(info: Any) -> int | None:
    """Return the publisher's number of a message, None where the middleware has none."""
    number = info['publication_sequence_number']
    return None if number is None or math.isnan(number) else int(number)
