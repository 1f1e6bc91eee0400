"""Base class and main program of every node: parameters, lifecycle, topics, diagnostics and log lines."""

import math
import sys
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from typing import Any, Generic, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import Executor
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from flexmanip_ros.cli import console
from flexmanip_ros.errors import FlexmanipError, ParameterError
from flexmanip_ros.event_replay import MOST_EVENTS
from flexmanip_ros.io import cdr
from flexmanip_ros.io.parameter_file import check_names
from flexmanip_ros.messages import Diagnostics
from flexmanip_ros.parameters.document import help_text
from flexmanip_ros.ros import diagnostics, qos, rclpy_workarounds
from flexmanip_ros.ros.conversions import to_message
from flexmanip_ros.ros.parameters import NodeParameters, arm_line, given_files
from flexmanip_ros.samples.signals import Rejection

Config = TypeVar('Config')
THROTTLE_S = 2.0
"""Shortest time between two log lines of a repeated error [s]: the log stays readable and does not fill the disk."""
NO_STAMP = 0
"""Stamp [ns] that a publisher did not fill in, such as that of some grippers; no clock can be kept by it."""
MISMATCHED = {'durability': ('volatile', 'transient_local'), 'reliability': ('best_effort', 'reliable')}
"""What a publisher offers, and the subscription wants, where the two do not match: the only such pair of a policy."""


def _logged(work: Callable[[Any], None]) -> Callable[..., TransitionCallbackReturn]:
    """Turn a method into a callback of a transition, and log its exception, which rclpy would drop."""
    @wraps(work)
    def transition(node: Any, state: LifecycleState | None = None) -> TransitionCallbackReturn:
        try:
            work(node)
        except FlexmanipError as error:
            node.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except NameValidationException as error:
            words = ' '.join(str(error).rstrip(' ^\n').split())
            node.get_logger().error(f'{words}; correct the parameter that has this name')
            return TransitionCallbackReturn.FAILURE
        except Exception:
            node.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    return transition


class FlexmanipNode(rclpy_workarounds.ManagedNode, Generic[Config]):
    """A lifecycle node whose parameters are those of one configuration class.

    Subclasses override ``start`` (configure), ``activated``, ``deactivated`` and ``report``. Topics and services are
    created once and stay: a node that is not active ignores the messages it receives (but see ``each_event``) and
    publishes diagnostics alone.
    The cleanup transition keeps the state too; the next configure transition builds a new one.
    """

    def __init__(self, name: str, cls: type[Config], *, overrides: list[Parameter] | None = None, **options: Any
                 ) -> None:
        """Declare the parameters. Raises ParameterError, which names the parameter that is wrong.

        overrides: values given in code; options: arguments of ``rclpy.node.Node``, such as context and namespace.
        """
        super().__init__(name, parameter_overrides=overrides, **options)
        self.active = False
        self.meter = diagnostics.Meter()
        self.events: dict[str, int] = {}
        """Counts of QoS events, by topic and kind: missed deadlines, incompatible publishers, ..."""
        self._entities_made = False
        self._unheard: deque[Callable[[], None]] = deque(maxlen=MOST_EVENTS)
        """What is to be done at the activation with the events that came before it."""
        self._unknown_to_rclpy = ExitStack()
        """Clean-up of the alarms and batches, which ``destroy_node`` of rclpy does not know."""
        self._logged_at: dict[str, float] = {}
        self._waits_for = self._cause = ''  # the topic, and the cause of faults, in the last report
        self._heard_at: float | None = None
        """Time of the last report in which the node waited for nothing [s]; None while there was none."""
        try:
            self.autostarts = bool(self.declare_parameter(
                'autostart', True, ParameterDescriptor(
                    description='configure and activate at start; false: wait for ros2 lifecycle set',
                    read_only=True)).value)
            self.parameters: NodeParameters[Config] = NodeParameters(
                self, cls, self.configuration_changed, self.check_change)
        except BaseException:
            self.destroy_node()
            raise
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # On a steady clock, diagnostics are published even while simulated time stands still.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics_timer = self.create_timer(1.0, self.diagnose, clock=self._steady)

    @property
    def config(self) -> Config:
        """The parameters as they are now."""
        return self.parameters.config

    # Methods that a subclass overrides.

    def make_entities(self) -> None:
        """Create publishers, subscriptions, services and timers; called once, after the first ``start``."""

    def start(self) -> None:
        """Build the state and compile the kernels. A FlexmanipError makes the configure transition fail."""

    def summary(self) -> str:
        """Return what the node does with these parameters, for the log at activation."""
        return ''

    def activated(self) -> None:
        """Begin to work; called before ``active`` becomes true."""

    def deactivated(self) -> None:
        """Cease to work; what was published before stays. ``active`` becomes false after this call."""

    def check_change(self, config: Config) -> None:
        """Raise ParameterError to reject parameters that are set while the node runs and that it cannot work with."""

    def configuration_changed(self, config: Config, names: Collection[str]) -> None:
        """Apply parameters of these names that were set while the node runs, to whatever values."""

    def report(self, report: diagnostics.Report) -> None:
        """Fill the node's diagnostic entry; never called before ``make_entities``."""

    # Lifecycle transitions.

    @_logged
    def on_configure(self) -> None:
        """Create what the node needs and build its state."""
        for path in given_files():
            try:
                check_names(path, self.get_fully_qualified_name())
            except ParameterError as error:  # rclpy ignores such a file without a word
                self.get_logger().warning(str(error))
        arm, is_doubtful = arm_line(self)
        if is_doubtful:
            self.get_logger().warning(arm)
        elif arm:
            self.get_logger().info(arm)
        with console.announced(lambda: self.get_logger().warning(console.COMPILING)):
            self.start()
        if not self._entities_made:  # last: messages that come while kernels load would overflow the queues
            self.make_entities()
            self._entities_made = True

    @_logged
    def on_activate(self) -> None:
        """Begin to work."""
        self.activated()
        self.active, self._waits_for, self._heard_at = True, '', None
        self.meter.window()  # the first report is on a whole second of work
        self._diagnostics_timer.reset()
        self.get_logger().info(f'ready: {self.summary()}' if self.summary() else 'ready')
        while self._unheard:
            self._unheard.popleft()()

    @_logged
    def on_deactivate(self) -> None:
        """Cease to work."""
        if self.active:
            try:
                self.deactivated()
            finally:
                self.active = False

    on_shutdown = close = on_deactivate

    def autostart(self) -> bool:
        """Configure and activate at once, as a plain ``ros2 run`` expects, unless ``autostart`` is false.

        Return False, with the reason logged, when a transition fails.
        """
        if not self.autostarts:
            self.get_logger().info('not started, as autostart is false; to start it: '
                                   f'ros2 lifecycle set {self.get_fully_qualified_name()} configure, then activate')
            return True
        return all(transition() == TransitionCallbackReturn.SUCCESS
                   for transition in (self.trigger_configure, self.trigger_activate))

    # Topics.

    def publisher(self, kind: type[Any], topic: str, profile: QoSProfile) -> Publisher:
        """Create a publisher whose quality of service the user may override."""
        with _qos_errors(topic):
            return self.create_publisher(kind, topic, profile, qos_overriding_options=qos.overridable())

    def subscription(self, kind: type[Any], topic: str, callback: Callable[[Any], None], profile: QoSProfile, *,
                     raw: bool = False, losses: diagnostics.LossCounter | None = None) -> Subscription:
        """Create a subscription whose quality of service the user may override; its QoS events are counted.

        losses: counts the messages that do not arrive.
        """
        def counted(message: Any, info: Any) -> None:
            assert losses is not None
            losses.note(rclpy_workarounds.sequence_number(info))
            callback(message)

        watch = SubscriptionEventCallbacks(
            matched=None if losses is None else losses.matched,
            deadline=lambda event: self._count(topic, 'deadline_missed', event.total_count),
            liveliness=lambda event: self._count(topic, 'publishers_not_alive', event.not_alive_count),
            incompatible_qos=lambda event: self._incompatible(topic, event))
        with _qos_errors(topic):
            return self.create_subscription(
                kind, topic, callback if losses is None else rclpy_workarounds.with_info(counted), profile, raw=raw,
                event_callbacks=watch, qos_overriding_options=qos.overridable())

    def each_joint_state(self, take: Callable[[bytes], None], losses: diagnostics.LossCounter | None = None) -> None:
        """Subscribe to the joint states, serialized; ``take`` gets each while the node is active, and is timed.

        losses: counts the lost ones, for a node that needs each.
        """
        def timed(raw: bytes) -> None:
            if self.active:
                with self.meter.timed():
                    take(raw)

        profile = qos.sensor_input() if losses is None else qos.gapless_input()
        self.subscription(JointState, 'joint_states', timed, profile, raw=True, losses=losses)

    def each_event(self, take: Callable[[str, Header], None]) -> None:
        """Subscribe to both topics of events; ``take`` gets topic and message.

        The middleware sends a latched event once, and what the arm holds is true after it too. So those that come while
        the node is not active are taken at its activation.
        """
        def heard(topic: str, message: Header) -> None:
            if self.active:
                take(topic, message)
            else:
                self._unheard.append(partial(take, topic, message))

        for topic in ('capture_event', 'capture_detected'):
            self.subscription(Header, topic, partial(heard, topic), qos.latched_input())

    def waiting_joint_states(self, losses: diagnostics.LossCounter) -> rclpy_workarounds.Batches:
        """Subscribe to the joint states, which wait, serialized, until they are taken."""
        made = rclpy_workarounds.Batches(self, self.subscription(
            JointState, 'joint_states', lambda raw: None, qos.gapless_input(), raw=True, losses=losses), losses.note)
        self._unknown_to_rclpy.callback(made.give_back, self)
        return made

    def alarm(self, callback: Callable[[], None]) -> rclpy_workarounds.Alarm:
        """Return a one-shot timer that runs a callback after a time chosen at each call, see ``Alarm``."""
        made = rclpy_workarounds.Alarm(self, callback)
        self._unknown_to_rclpy.callback(made.close)
        return made

    def trigger_service(self, name: str, act: Callable[[], tuple[bool, str]]) -> None:
        """Create a service without arguments; ``act`` returns whether it succeeded, and what the caller is told."""
        def called(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success, response.message = act()
            return response

        self.create_service(Trigger, name, called)

    def destroy_node(self) -> None:
        """Destroy the node, its alarms, and the subscriptions that the executor does not know."""
        self._unknown_to_rclpy.close()
        super().destroy_node()

    def _count(self, topic: str, what: str, count: int) -> None:
        self.events[f'{topic} {what}'] = count

    def _incompatible(self, topic: str, event: Any) -> None:
        self._count(topic, 'incompatible_publishers', event.total_count)
        policy, full = QoSPolicyKind(event.last_policy_kind).name.lower(), self.resolve_topic_name(topic)
        offered, wanted = MISMATCHED.get(policy, ('that this node cannot take', 'of another value'))
        value = f':={offered}' if policy in MISMATCHED else ''
        self.get_logger().error(
            f'a publisher of {full} offers {policy} {offered}, so none of its messages is received; publish with '
            f'{policy} {wanted}, or start this node with -p qos_overrides.{full}.subscription.{policy}{value}')

    def stamp_of(self, raw: bytes) -> int | None:
        """Return the header stamp [ns] of a serialized JointState; log an error and return None if it is not CDR."""
        try:
            return cdr.stamp_ns(raw)
        except cdr.CdrError:
            self.log_throttled('encoding', 'a JointState of another encoding than CDR was dropped')
            return None

    # Log lines and diagnostics.

    def log_throttled(self, reason: str, words: str, *, is_error: bool = True) -> None:
        """Log an error or a warning; those of the same reason are logged at most once in ``THROTTLE_S``."""
        now = time.monotonic()
        if now - self._logged_at.get(reason, -math.inf) < THROTTLE_S:
            return
        self._logged_at[reason] = now
        if is_error:
            self.get_logger().error(diagnostics.shortened(words))
        else:  # rclpy raises where one line of code logs with two severities
            self.get_logger().warning(diagnostics.shortened(words))

    def log_dropped(self, why: Rejection | None) -> None:
        """Log why a joint state was dropped, where there is a reason."""
        if why is not None:
            self.log_throttled(why.reason, f'message dropped: {why.problem}; {why.remedy}')

    def report_faults(self, report: diagnostics.Report, faults: diagnostics.JointStateFaults) -> None:
        """Report the faults of the joint states; log why none can be used, and once what the likely cause is."""
        self.log_dropped(faults.report(report))
        before, self._cause = self._cause, faults.likely_cause()
        if self._cause and not before:
            self.get_logger().warning(f'the stamps of the joint states are irregular: {self._cause}')

    def diagnose(self) -> None:
        """Publish the node's diagnostic entry; log when the messages that it needs stop or come."""
        now = time.monotonic()
        report = diagnostics.Report(silence_s=None if self._heard_at is None else now - self._heard_at)
        if self._entities_made:
            report.values.update(self.meter.window())
            self.report(report)
        report.values['active'] = self.active
        for name, count in self.events.items():
            report.values[name] = count
            if count:
                level = diagnostics.WARN if name.endswith('deadline_missed') else diagnostics.ERROR
                report.worse(level, f'{name}: {count}')
        own = self.get_name(), self.get_namespace()
        if self.get_node_names_and_namespaces().count(own) > 1:
            report.worse(diagnostics.ERROR, 'another node has the same name; stop one, or rename it with __node')
        if not self.active:
            report.words.insert(0, 'not active')
        else:
            self._log_silence(report)
            self._heard_at = self._heard_at if report.waits_for else now
        entry = report.entry(self.get_fully_qualified_name(), self.get_namespace())
        self._diagnostics.publish(to_message(Diagnostics(self.get_clock().now().nanoseconds, (entry,))))

    def _log_silence(self, report: diagnostics.Report) -> None:
        """Log when the messages that the node needs cease or come."""
        before, self._waits_for = self._waits_for, report.waits_for
        if report.waits_for == before:
            return
        topic = self.resolve_topic_name(report.waits_for or before)
        if report.waits_for and report.silence_s is not None:
            self.get_logger().warning(report.silence(topic))
        elif report.waits_for:
            self.get_logger().info(report.silence(topic, none='waiting for'))
        elif before == diagnostics.CLOCK:
            self.get_logger().info(f'{diagnostics.CLOCK} is there')
        else:
            self.get_logger().info(f'messages arrive: {report.values["rate_hz"]:.0f} a second')


@contextmanager
def _qos_errors(topic: str) -> Iterator[None]:
    """Raise ParameterError for a quality of service that is not possible, naming the parameters that set it."""
    try:
        yield
    except (RuntimeError, ValueError, InvalidQosOverridesError, ParameterException) as error:
        raise ParameterError(f"qos_overrides of '{topic}': {error}",
                             'give a policy that ROS knows, such as reliable or best_effort') from error


class SampleGrid:
    """A uniform grid of instants, and a timer on it: instant k is k / rate seconds after instant 0.

    ``begun`` is called when instant 0 is set: at ``start``, or with the first simulated time, and again when simulated
    time goes back before instant 0. ``reached`` is called with the index of the latest instant. Elapsed time is that of
    a steady clock, so a correction of the system clock moves no stamp. With ``use_sim_time`` it is that of /clock.
    """

    def __init__(self, node: FlexmanipNode[Any], rate: float, begun: Callable[[], None], reached: Callable[[int], None]
                 ) -> None:
        self._node, self._rate, self._begun, self._reached = node, rate, begun, reached
        self.is_simulated = bool(node.get_parameter('use_sim_time').value)
        """Whether elapsed time is that of /clock."""
        self._clock = node.get_clock() if self.is_simulated else Clock(clock_type=ClockType.STEADY_TIME)
        self.start_ns = 0
        """Stamp of instant 0."""
        self._origin_ns: int | None = None
        self._timer: Timer = node.create_timer(1.0 / rate, self.tick, clock=self._clock)
        self._timer.cancel()

    @property
    def is_running(self) -> bool:
        """Whether instant 0 is set; not before the first simulated time."""
        return self._origin_ns is not None

    def start(self) -> None:
        """Set instant 0 to now, and start the timer."""
        self._begin()
        self._timer.reset()

    def stop(self) -> None:
        """Stop the timer and forget instant 0."""
        self._timer.cancel()
        self._origin_ns = None

    def _begin(self) -> None:
        self.start_ns = int(self._node.get_clock().now().nanoseconds)
        self._origin_ns = int(self._clock.now().nanoseconds) if self.start_ns > 0 else None
        if self.is_running:
            self._begun()

    def latest(self) -> int:
        """Return the index of the latest instant reached; negative when the clock went back before instant 0."""
        assert self._origin_ns is not None
        elapsed_ns = int(self._clock.now().nanoseconds) - self._origin_ns
        return int(elapsed_ns * self._rate / 1e9 + 1e-6) if elapsed_ns >= 0 else -1

    def tick(self) -> None:
        """Run the callback of the timer."""
        if not self._node.active:
            return
        if not self.is_running or self.latest() < 0:
            self._begin()
        if self.is_running:
            self._reached(self.latest())


def run(make: Callable[[], FlexmanipNode[Any]], name: str, about: str | None, cls: type,
        argv: Sequence[str] | None = None) -> int:
    """Run one node until it is asked to stop; return the exit code.

    The code is 0 after SIGINT or SIGTERM at any time, and 2, with the reason on stderr, for bad arguments or
    parameters. name, about, cls: the name of the node, its topics and services, and its parameters, for --help.
    """
    arguments = list(sys.argv if argv is None else argv)
    console.open_streams()
    try:
        rclpy_workarounds.interrupt_on_signals(again=True)
        try:
            parser = console.parser(name, about or '', 'parameters:\n' + help_text(cls))
            parser.usage = f'{name} [--help] [--ros-args -p NAME:=VALUE --params-file FILE.yaml ...]'
            parser.parse_args(remove_ros_args(arguments)[1:])
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        except Exception as error:  # rcl raises types of its C extension for --ros-args and parameter files
            return console.print_error(name, rclpy_workarounds.first_line(error))
        return _spin(make, name)
    except KeyboardInterrupt:
        rclpy_workarounds.ignore_signals()
        return 0


def _spin(make: Callable[[], FlexmanipNode[Any]], name: str) -> int:
    warnings.simplefilter('ignore', RuntimeWarning)  # the status of an estimate reports numbers out of range
    node: FlexmanipNode[Any] | None = None
    executor: Executor | None = None
    try:
        node = make()
        executor = rclpy_workarounds.make_executor()
        caught = rclpy_workarounds.interrupt_on_signals(again=True)
        executor.add_node(node)
        started = node.autostart()
        if not started and not caught:
            return console.BAD_INPUT  # the node has logged why
        if not caught:
            rclpy_workarounds.spin(executor)
    except (FlexmanipError, ParameterException) as error:
        return console.print_error(name, error)
    finally:
        with rclpy_workarounds.shutdown():
            if node is not None:
                node.close()
            if executor is not None:
                executor.shutdown()
            if node is not None:
                node.destroy_node()
            executor = node = None
    return 0
