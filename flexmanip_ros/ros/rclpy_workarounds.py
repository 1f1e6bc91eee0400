"""Every defect or surprise of rclpy 7.1 (Jazzy) and Fast DDS 2.14 that the nodes work around, in one place.

Each piece says what happens without it, and names the upstream issue where one is known.
"""

import faulthandler
import gc
import inspect
import math
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from types import FrameType
from typing import Any

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription

from flexmanip_ros.cli.console import is_postponed, send_again
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.io.parameter_file import sections

POLL_S = 0.1
"""Longest wait inside the executor [s], hence the longest time before an idle node handles a signal."""
MOST_WAITING = 30_000
"""Largest number of messages that wait in a ``Batches``, half a minute at 1 kHz: with Coulomb friction the fits keep
the identifier up to 19 s behind (docs/lab/payload.md, cost). A message takes about a kilobyte."""
AGAIN_S = 1.0
"""Time after which a signal that has not ended the process yet is sent again [s]."""
LONGEST_END_S = 10.0
"""Time limit for the shutdown of the middleware [s]; a normal shutdown takes some tenths of a second."""


def make_executor(context: Context | None = None) -> Executor:
    """Return an EventsExecutor, or a SingleThreadedExecutor where rclpy has no EventsExecutor.

    Without the events executor a node takes four times the processor time at 1 kHz. MultiThreadedExecutor does not
    keep up at all: 2.5 of 1000 messages a second were measured (https://github.com/ros2/rclpy/issues/1452).
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def interrupt_on_signals(*, again: bool = False) -> list[int]:
    """Let SIGINT and SIGTERM raise KeyboardInterrupt; call it again after an executor was made.

    Return a list to which each received signal is added, because an exception in a callback from C is printed and
    lost. A signal that comes while a kernel is loaded or a recording written is handled later, see
    ``console.is_postponed``. again: each signal is sent again every ``AGAIN_S`` until signals are ignored, in case a
    callback from C lost its exception.

    rclpy's own handlers end the context before a node can send its last message, such as zero torque. With
    ``SignalHandlerOptions.NO`` alone, SIGTERM ends the process at once, and the events executor sets handlers of its
    own.
    """
    caught: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        if is_postponed(number, frame):
            return
        caught.append(number)
        if again:
            send_again(number, AGAIN_S)
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    return caught


def spin(executor: Executor, until: Callable[[], bool] = lambda: False) -> None:
    """Run callbacks until the context ends or a condition holds. SIGINT and SIGTERM raise KeyboardInterrupt.

    The events executor of rclpy 7.1 runs no callback in ``spin()`` without a time-out. It reports a KeyboardInterrupt
    inside a callback as a fatal error with a traceback, so this function raises it between two callbacks.
    """
    caught: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: caught.append(number))
    try:
        while not caught and rclpy.ok() and not until():
            executor.spin_once(timeout_sec=POLL_S)
    except ExternalShutdownException:
        return
    finally:
        interrupt_on_signals()
    if caught:
        raise KeyboardInterrupt


@contextmanager
def shutdown() -> Iterator[None]:
    """Shut down rclpy and Fast DDS; the body of the context destroys executor and nodes and drops all references.

    Signals are ignored: ``ros2 launch`` and the terminal both send SIGINT, and the second would interrupt the shutdown.
    A node is part of a reference cycle, so its DDS participant outlives ``destroy_node`` until a garbage collection
    (https://github.com/ros2/rclpy/issues/1710). Without one, C's exit handlers destroy the participant while a thread
    of rmw_fastrtps still waits on its readers, and the process aborts ("malloc_consolidate(): unaligned fastbin chunk
    detected"). Fast DDS can also wait without end where a participant is destroyed just as another leaves
    (https://github.com/eProsima/Fast-DDS/issues/6193): after ``LONGEST_END_S`` the process ends with exit code 1.
    """
    ignore_signals()
    faulthandler.dump_traceback_later(LONGEST_END_S, exit=True)
    try:
        yield
    finally:
        rclpy.try_shutdown()
        gc.collect()
        faulthandler.cancel_dump_traceback_later()
        ignore_signals()  # the destroyed executor restored the default actions of the signals


def ignore_signals() -> None:
    """Ignore SIGINT and SIGTERM, because the process is ending."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def with_info(callback: Callable[[Any, Any], None]) -> Callable[..., None]:
    """Adapt a ``(message, info)`` callback to both executors.

    rclpy passes the message info to a callback whose signature has two parameters. The events executor passes message
    and info as one tuple, the other executors as two arguments.
    """
    def adapter(message: Any, info: Any = None) -> None:
        if info is None:
            message, info = message
        callback(message, info)

    adapter.__signature__ = inspect.signature(callback)  # type: ignore[attr-defined]
    return adapter


def sequence_number(info: Any) -> int | None:
    """Return the publisher's number of a message; None where the middleware has none, which rclpy gives as NaN."""
    number = info['publication_sequence_number']
    return None if number is None or math.isnan(number) else int(number)


class Batches:
    """A subscription that the executor does not know: ``take`` gives all messages that wait in its queue.

    At 1000 messages a second, one Python callback per message takes 10 % of a core; taking the waiting messages a
    hundred times a second takes 3 %. rclpy has no subscription without a callback, so this one is removed from its
    node after its creation.

    Fast DDS keeps at most 5000 messages, whatever the depth of the queue. So ``fetch`` moves all of them into a queue
    of its own (``MOST_WAITING``), which ``take`` does first.

    note: gets the sequence number of each message that is taken.
    """

    def __init__(self, node: Node, subscription: Subscription, note: Callable[[int | None], None]) -> None:
        self._subscription, self._note = subscription, note
        self._waiting = deque[tuple[Any, Any]](maxlen=MOST_WAITING)
        node._subscriptions.remove(subscription)
        node._wake_executor()  # an executor on another thread may have added the subscription

    @property
    def depth(self) -> int:
        """Largest number of messages that can wait in the middleware."""
        return max(int(self._subscription.qos_profile.depth), 1)

    def fetch(self) -> int:
        """Move the messages that wait in the middleware into the queue; return how many the queue then holds."""
        subscription = self._subscription
        with subscription.handle:
            for _ in range(self.depth):
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if taken is None:
                    break
                self._waiting.append(taken)
        return len(self._waiting)

    def take(self) -> Iterator[tuple[Any, Any]]:
        """Yield each waiting message with its message info, the oldest first."""
        self.fetch()
        while self._waiting:
            taken = self._waiting.popleft()
            self._note(sequence_number(taken[1]))
            yield taken

    def give_back(self, node: Node) -> None:
        """Return the subscription to its node, so that a following ``destroy_node`` destroys it."""
        node._subscriptions.append(self._subscription)


class Alarm:
    """A one-shot timer that runs a callback on the executor of its node, once for each ``after``.

    An rclpy timer that is reset with another period makes the events executor of rclpy 7.1 run other timers twice, and
    then not at all for a period. An exception in a task ends that executor with a segmentation fault, so an exception
    of the callback is raised in a timer.
    """

    def __init__(self, node: Node, callback: Callable[[], None]) -> None:
        self._node, self._callback = node, callback
        self._changed = threading.Condition()
        self._at: float | None = None
        """Time at which the callback is due, on the monotonic clock [s]; None while it is not due."""
        self._closed = False
        self._running = threading.RLock()
        self._thread = threading.Thread(target=self._wait, name='alarm', daemon=True)
        self._thread.start()

    def after(self, seconds: float) -> None:
        """Run the callback after a time [s], which replaces the time of an earlier call."""
        with self._changed:
            self._at = time.monotonic() + seconds
            self._changed.notify()

    def _wait(self) -> None:
        with self._changed:
            while not self._closed:
                executor = self._node.executor
                if self._at is None:
                    self._changed.wait()
                elif executor is None:
                    self._changed.wait(POLL_S)
                elif (left := self._at - time.monotonic()) > 0.0:
                    self._changed.wait(left)
                else:
                    self._at = None
                    with suppress(Exception):  # an executor that was shut down meanwhile
                        executor.create_task(self._run)

    def _run(self) -> None:
        with self._running:
            if self._closed:
                return
            try:
                self._callback()
            except BaseException as error:
                self._node.create_timer(0.0, partial(_raise, error))

    def close(self) -> None:
        """Never run the callback again; wait for a callback that still runs on another thread."""
        with self._running, self._changed:
            self._closed = True
            self._changed.notify()


def _raise(error: BaseException) -> None:
    raise error


def first_line(error: BaseException) -> str:
    """Return the first line of an error without source locations: rcl puts paths of its build machine there.

    Of unknown arguments rclpy gives the names alone. Of a parameter file rcl does not say that it does not exist, or
    what is wrong with its YAML, and of a list such as [1, 2.0] not what to do. That is added.
    """
    if isinstance(error, rclpy_implementation.UnknownROSArgsError):
        return (f'unknown ROS arguments {error}; after --ros-args give -p NAME:=VALUE, --params-file FILE.yaml, '
                '-r FROM:=TO or --log-level LEVEL')
    file = re.search(r"params file: '--params-file (.+?)'\. Error", str(error))
    if file:
        try:
            sections(file[1])
        except ParameterError as clearer:
            return str(clearer)
    text = str(error).strip().splitlines()
    line = (text[0] if text else type(error).__name__).split(', at ./')[0].split(', at /')[0]
    is_mixed = 'Sequence should be of same type' in str(error)
    return f'{line}; give a list of one type, each number with a point such as 1.0' if is_mixed else line


class ManagedNode(LifecycleNode):
    """A lifecycle node that rejects a transition which its state does not have.

    rclpy 7.1 raises in the service callback instead, which ends the node (https://github.com/ros2/rclpy/issues/1209).
    """

    def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:
        try:
            return super()._LifecycleNodeMixin__on_change_state(request, response)
        except RuntimeError as error:
            state = self._state_machine.current_state[1]
            self.get_logger().error(f"a transition was rejected in state '{state}': {first_line(error)}")
            response.success = False
            return response


def parameter_overrides(node: Node) -> dict[str, Parameter]:
    """Return the overrides given at start by file, command line or code; rclpy has no public name for them."""
    given: dict[str, Parameter] = node._parameter_overrides
    return given


def declare(node: Node, name: str, default: Any, kind: Parameter.Type, descriptor: ParameterDescriptor) -> Any:
    """Declare a parameter and return its value, from an override or the default; raises what rclpy raises.

    rclpy infers the type from the default and takes an empty list for a byte array: it then rejects every override but
    an empty one (https://github.com/ros2/rclpy/issues/912). So a parameter whose default is empty is declared by its
    type, and its value is set afterwards.
    """
    if not isinstance(default, list) or default:
        return node.declare_parameter(name, default, descriptor).value
    given = parameter_overrides(node).get(name)
    has_value = given is not None and not _is_empty(given.value)
    node.declare_parameter(name, kind, ignore_override=not has_value)
    if not has_value:
        node.set_parameters([Parameter(name, kind, [])])
    descriptor.type = kind.value
    node.set_descriptor(name, descriptor)
    return node.get_parameter(name).value


def _is_empty(value: Any) -> bool:
    return value is None or (isinstance(value, Sequence) and not isinstance(value, str) and not value)
