"""What a node asks of the system so that a sample is worked on when it comes, as parameters of the node."""

from __future__ import annotations

from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from flexmanip_ros.ros import affinity, priority
from flexmanip_ros.ros.declaration import declare
from flexmanip_ros.ros.diagnostics import Report
from flexmanip_ros.ros.wake_latency import LONGEST, UNASKED, WakeLatency

PARAMETERS = 'thread_priority', 'wake_latency', 'cpu_affinity'


class RealTime:
    """Declares the parameters; asks for what they say, and says once where the system refuses."""

    def __init__(self, node: Node, thread_priority: int, wake_latency: int) -> None:
        """Declare with these defaults; raises what rclpy raises for values out of range."""
        self._node = node
        self._priority = self._declared(
            'thread_priority', thread_priority, priority.LOWEST, priority.HIGHEST,
            'real-time priority (SCHED_FIFO) of the process where the system permits it; '
            '0: ordinary scheduling')
        self._wake = WakeLatency(self._declared(
            'wake_latency', wake_latency, UNASKED, LONGEST,
            'time within which the cores of the processor must wake while samples come, where the system '
            'permits to ask for it (PM QoS) [us]; 0: they do not sleep, -1: as they like'))
        self._cores: list[int] = list(declare(
            node, 'cpu_affinity', [], Parameter.Type.INTEGER_ARRAY, ParameterDescriptor(
                description='cores of the processor that the process may use, such as [0, 2]; empty: any',
                read_only=True)))
        self._taken = self._refused = False

    def _declared(self, name: str, default: int, lowest: int, highest: int, words: str) -> int:
        descriptor = ParameterDescriptor(description=words, read_only=True, integer_range=[
            IntegerRange(from_value=lowest, to_value=highest, step=1)])
        return int(self._node.declare_parameter(name, default, descriptor).value)

    def take(self) -> None:
        """Take cores and priority, for this whole process."""
        refused = affinity.take(self._cores)
        if refused:
            self._node.get_logger().warning(
                f'cpu_affinity {self._cores} was refused ({refused}); '
                f'this process may use {affinity.current()}')
        refused = priority.take(self._priority)
        self._taken = not refused
        if refused:
            self._node.get_logger().info(
                f'ordinary scheduling: real-time priority {self._priority} was refused ({refused}); '
                'permit it (docs/nodes.md), or set thread_priority to 0')

    def join(self) -> None:
        """Give the calling thread the priority that comes next to this, if it was taken."""
        if self._taken:
            priority.join(self._priority)

    def stay_awake(self, wanted: bool = True) -> None:
        """Ask for cores that wake in time, or no longer."""
        if not wanted:
            self._wake.release()
            return
        refused = self._wake.hold()
        if refused and not self._refused:
            self._refused = True
            self._node.get_logger().info(
                f'cores may sleep deeply: the request to wake in time was refused ({refused}); '
                'permit it (docs/nodes.md), or set wake_latency to -1')

    def report(self, report: Report) -> None:
        """Tell what the node really has."""
        report.values['thread_priority'] = priority.current()
        report.values['cpu_affinity'] = affinity.current()
        report.values['wake_latency'] = self._wake.current
