"""All nodes of the demonstration, and a recorder, in one process on one executor, over DDS."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import Executor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header
from visualization_msgs.msg import MarkerArray

from flexmanip_ros import messages
from flexmanip_ros.errors import BagError, FlexmanipError
from flexmanip_ros.io.bag_writer import BagWriter
from flexmanip_ros.parameters import DemoParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import JointStateReader, capture_event, from_message
from flexmanip_ros.ros.diagnostics import LossCounter
from flexmanip_ros.ros.nodes.capture_trigger import CaptureTrigger
from flexmanip_ros.ros.nodes.excitation import Excitation
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.ros.nodes.rpbsid_identifier import TOPICS, RpbsidIdentifier
from flexmanip_ros.ros.rclpy_workarounds import make_executor, sequence_number, with_info

READERS = 4
"""Number of subscriptions to joint_states in this process: identifier, trigger, excitation, recorder."""
SHOWN = {'/rpbsid_identifier/arm': (MarkerArray, 'visualization_msgs/msg/MarkerArray'),
         '/diagnostics': (DiagnosticArray, 'diagnostic_msgs/msg/DiagnosticArray')}
"""Topics recorded for viewers only, as serialized: message class and type name. A replay does not repeat them."""
DISCOVERY_TIMEOUT_S = 20.0
DRAIN_TIMEOUT_S = 30.0
"""Longest wait for messages under way [s]: a busy machine has a backlog, an idle one needs milliseconds."""
FLUSH_PERIOD_S = 0.25


class CompositionError(FlexmanipError):
    """The nodes cannot be configured or connected, or another arm is on their topics."""


class Recorder(Node):
    """Writes joint states, commands, events, outputs and diagnostics into a bag; counts the joint states it missed.

    Messages are written in the order of arrival, so that a replay processes events and samples in the order in which
    the identifier did. The bag is closed and readable whatever happens.
    """

    def __init__(self, path: Path, **options: Any) -> None:
        """Open the bag; raises BagError when it exists or cannot be written."""
        super().__init__('recorder', **options)
        self.writer = BagWriter(path)
        self.failure: BagError | None = None
        self.first_ns: int | None = None
        self.last_ns = self.joint_states = self._log_ns = 0
        self.published: dict[str, list[messages.Value]] = {name: [] for name in TOPICS}
        """Values that the identifier published, by topic, in the order of arrival."""
        self.losses = LossCounter()
        self._reader = JointStateReader()
        deep = QoSProfile(depth=qos.SENSOR_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        self.create_subscription(JointState, 'joint_states', with_info(self._on_joint_states), deep, raw=True)
        self.create_subscription(Float64MultiArray, 'effort_controller/commands', self._on_command, deep)
        for topic in ('capture_event', 'capture_detected'):
            self.create_subscription(Header, topic, partial(self._on_event, '/' + topic), qos.latched_input())
        for name, (kind, _) in TOPICS.items():
            self.create_subscription(kind, f'/rpbsid_identifier/{name}', partial(self._on_output, name), deep)
        for topic, (shown, name) in SHOWN.items():
            self.create_subscription(shown, topic, partial(self._on_shown, topic, name), deep, raw=True)
        self.create_timer(FLUSH_PERIOD_S, self._flush)

    def _on_joint_states(self, raw: bytes, info: object) -> None:
        self.losses.note(sequence_number(info))
        record = self._reader(raw)
        if self.first_ns is None:
            self.first_ns = record.stamp_ns
        self.last_ns = record.stamp_ns
        self.joint_states += 1
        self._record(self.writer.write, '/joint_states', record)

    def _on_command(self, message: Float64MultiArray) -> None:
        self._record(self.writer.write, '/effort_controller/commands', from_message(message))

    def _on_event(self, topic: str, message: Header) -> None:
        self._record(self.writer.write, topic, capture_event(message), latched=True)

    def _on_output(self, name: str, message: Any) -> None:
        value = from_message(message)
        self.published[name].append(value)
        self._record(self.writer.write, f'/rpbsid_identifier/{name}', value)

    def _on_shown(self, topic: str, kind: str, raw: bytes) -> None:
        self._record(self.writer.write_raw, topic, raw, kind)

    def _record(self, write: Callable[..., None], topic: str, *content: Any, latched: bool = False) -> None:
        if self.failure is not None:
            return
        self._log_ns = max(time.time_ns(), self._log_ns)
        try:
            write(topic, self._log_ns, *content, latched=latched)
        except BagError as error:
            self._fail(error)

    def _flush(self) -> None:
        try:
            if self.failure is None:
                self.writer.flush()
        except OSError as error:
            self._fail(BagError(f"bag '{self.writer.path}' cannot be written: {error.strerror}",
                                'free some space; what was written before is kept'))

    def _fail(self, error: BagError) -> None:
        self.failure = error
        self.get_logger().error(f'recording ended: {error}')

    def close(self) -> None:
        """Finish the bag; what could be written stays readable."""
        try:
            self.writer.close()
        except BagError as error:
            self.failure = self.failure or error


class Composition:
    """Plant, excitation, trigger, identifier and recorder; made, started, and ended as one."""

    def __init__(self, config: DemoParameters, bag: Path) -> None:
        """Create every node; nothing runs and nothing is written yet."""
        self.config = config
        self._nodes: list[Any] = []
        self._bag = bag
        self.recorder: Recorder
        """It exists from the call of ``connect`` on."""
        self.executor: Executor = make_executor()
        try:
            self.plant: PlantSimulator = self._add(PlantSimulator())
            self.excitation: Excitation = self._add(Excitation())
            self.trigger: CaptureTrigger = self._add(CaptureTrigger())
            self.identifier: RpbsidIdentifier = self._add(RpbsidIdentifier())
        except BaseException:
            self.close()
            raise
        # Subscribers start first, the plant and its clock last.
        self._managed = self.identifier, self.trigger, self.excitation, self.plant

    def _add(self, node: Any) -> Any:
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def configure(self) -> None:
        """Configure every node. It builds states and compiles kernels, which is slow, before any clock runs."""
        for node in self._managed:
            if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
                raise CompositionError(f'{node.get_name()} could not be configured', 'see its log above')

    def connect(self, others: int = 0) -> None:
        """Open the bag, wait until all publishers and subscriptions are matched, and check that there is no other arm.

        others: number of further subscriptions to the joint states, in other processes.
        """
        self.recorder = self._add(Recorder(self._bag))
        if not self.wait(lambda: self._matched(others), DISCOVERY_TIMEOUT_S):
            raise CompositionError(f'the nodes did not find each other within {DISCOVERY_TIMEOUT_S:.0f} s',
                                   'unset ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_STATIC_PEERS')
        if foreign_arm(self.recorder, own_writers=1, own_readers=2):
            raise CompositionError('another arm or controller is on these topics',
                                   'run again, or set ROS_DOMAIN_ID to a free number')

    def _matched(self, others: int) -> bool:
        commands, events = self.excitation.commands, self.trigger.events_publisher
        return (self.plant.joint_states.get_subscription_count() >= READERS + others
                and commands.get_subscription_count() >= 2 and events.get_subscription_count() >= 3 + others
                and all(item.get_subscription_count() >= 1 for item in self.identifier.outputs.values()))

    def start(self) -> None:
        """Activate every node."""
        for node in self._managed:
            node.trigger_activate()

    @property
    def elapsed(self) -> float:
        """Time from the first to the last recorded joint state [s]."""
        recorder = self.recorder
        return 0.0 if recorder.first_ns is None else (recorder.last_ns - recorder.first_ns) * 1e-9

    @property
    def finished(self) -> bool:
        """Whether the last sample of the run was recorded."""
        return self.recorder.joint_states >= round(self.config.duration * self.config.rate)

    @property
    def lost(self) -> int:
        """Number of joint states that the recorder missed plus number that the identifier missed."""
        return self.recorder.losses.lost + self.identifier.losses.lost

    def drain(self) -> None:
        """Stop the plant and the excitation, and let every node process the messages still under way."""
        self.plant.trigger_deactivate()
        self.excitation.trigger_deactivate()
        sent, recorder, identifier = self.plant.samples, self.recorder, self.identifier
        self.wait(lambda: recorder.joint_states + recorder.losses.lost >= sent
                         and identifier.state.counters.received + identifier.losses.lost >= sent)
        identifier.trigger_deactivate()  # publishes the last model
        self.wait(lambda: sum(map(len, recorder.published.values())) >= identifier.published)

    def wait(self, condition: Callable[[], bool], seconds: float = DRAIN_TIMEOUT_S) -> bool:
        """Run callbacks until a condition holds, at most for ``seconds``; return whether it holds."""
        limit = time.monotonic() + seconds
        while time.monotonic() < limit and not condition():
            self.executor.spin_once(timeout_sec=0.02)
        return condition()

    def close(self) -> None:
        """Finish the bag, stop and destroy every node. May be called at any moment, and again."""
        for node in self._nodes:
            node.close()
        self.executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
        self._nodes = []


def foreign_arm(node: Node, own_writers: int, own_readers: int) -> bool:
    """Return whether another process publishes joint states or efforts, or subscribes to efforts, on this domain.

    own_writers, own_readers: number of publishers and of subscriptions per topic in this process.
    """
    return bool(node.count_publishers('joint_states') > own_writers
                or node.count_subscribers('effort_controller/commands') > own_readers
                or node.count_publishers('effort_controller/commands') > own_writers)
