"""All nodes of the demonstration, and a recorder, in one process on one executor, over DDS."""

import math
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
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header
from visualization_msgs.msg import MarkerArray

from flexmanip_ros import messages
from flexmanip_ros.errors import BagError, FlexmanipError
from flexmanip_ros.io import cdr
from flexmanip_ros.io.bag_writer import BagWriter
from flexmanip_ros.parameters import DemoParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import type_name
from flexmanip_ros.ros.diagnostics import LossCounter
from flexmanip_ros.ros.nodes.capture_trigger import CaptureTrigger
from flexmanip_ros.ros.nodes.excitation import Excitation
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.ros.nodes.rpbsid_identifier import TOPICS, RpbsidIdentifier
from flexmanip_ros.ros.rclpy_workarounds import make_executor, sequence_number, spin, with_info
from flexmanip_ros.types import Payload, Status

READERS = 4
"""Number of subscriptions to joint_states in this process: identifier, trigger, excitation, recorder."""
RECORDED: dict[str, type[Any]] = {
    '/joint_states': JointState, '/effort_controller/commands': Float64MultiArray, '/capture_event': Header,
    '/capture_detected': Header, **{f'/rpbsid_identifier/{name}': kind for name, kind in TOPICS.items()},
    '/rpbsid_identifier/arm': MarkerArray, '/diagnostics': DiagnosticArray,
}
"""Recorded topics. The last two are for viewers alone: a replay does not repeat them."""
DISCOVERY_TIMEOUT_S = 20.0
DRAIN_TIMEOUT_S = 30.0
"""Longest wait for messages under way [s]: a busy machine has a backlog, an idle one needs milliseconds."""
FLUSH_PERIOD_S = 0.25


class Recorder(Node):
    """Writes the messages of ``RECORDED`` into a bag; keeps what the identifier said, and counts lost joint states.

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
        self.published: dict[str, list[Any]] = {name: [] for name in TOPICS}
        """Messages that the identifier published, by topic, in the order of arrival."""
        self.losses = LossCounter()
        deep = QoSProfile(depth=qos.SENSOR_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        for topic, kind in RECORDED.items():
            self.create_subscription(kind, topic, with_info(partial(self._on_message, topic, kind)),
                                     qos.latched_input() if kind is Header else deep, raw=True)
        self.create_timer(FLUSH_PERIOD_S, self._flush)

    def _on_message(self, topic: str, kind: type[Any], raw: bytes, info: Any) -> None:
        name = topic.rpartition('/')[2]
        if kind is JointState:
            self.losses.note(sequence_number(info))
            self.last_ns = cdr.stamp_ns(raw)
            self.first_ns = self.last_ns if self.first_ns is None else self.first_ns
            self.joint_states += 1
        elif name in self.published:
            self.published[name].append(deserialize_message(raw, kind))
        if self.failure is not None:
            return
        self._log_ns = max(time.time_ns(), self._log_ns)
        try:
            self.writer.write_raw(topic, self._log_ns, raw, type_name(kind),
                                  latched=kind is Header or name in messages.LATCHED)
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
                raise FlexmanipError(f'{node.get_name()} could not be configured', 'see its log above')

    def connect(self, others: int = 0) -> None:
        """Open the bag, wait until all publishers and subscriptions are matched, and check that there is no other arm.

        others: number of further subscriptions to the joint states, in other processes.
        """
        self.recorder = self._add(Recorder(self._bag))
        if not self.wait(lambda: self._matched(others), DISCOVERY_TIMEOUT_S):
            raise FlexmanipError(f'the nodes did not find each other within {DISCOVERY_TIMEOUT_S:.0f} s',
                                 'unset ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_STATIC_PEERS')
        if foreign_arm(self.recorder, own_writers=1, own_readers=2):
            raise FlexmanipError('another arm or controller is on these topics',
                                 'run again, or set ROS_DOMAIN_ID to a free number')

    def _matched(self, others: int) -> bool:
        commands, events = self.excitation.commands, self.trigger.events_publisher
        return (self.plant.joint_states.get_subscription_count() >= READERS + others
                and commands.get_subscription_count() >= 2 and events.get_subscription_count() >= 3 + others
                and all(item.get_subscription_count() >= 1 for item in self.identifier.outputs.values()))

    def run(self, show: Callable[[str], None]) -> None:
        """Activate every node, and run until the last sample is recorded; ``show`` gets a line once a second.

        Raises what ended the simulation early.
        """
        for node in self._managed:
            node.trigger_activate()
        timer = self.recorder.create_timer(1.0, lambda: show(self._progress()))
        count = round(self.config.duration * self.config.rate)
        spin(self.executor, until=lambda: self.recorder.joint_states >= count or self.plant.fault is not None)
        timer.cancel()
        if self.plant.fault is not None:
            raise self.plant.fault

    def _progress(self) -> str:
        """Return the recorded time of the run and the latest estimate."""
        estimate, event, recorder = self.identifier.estimate, self.trigger.latest, self.recorder
        elapsed_s = 0.0 if recorder.first_ns is None else (recorder.last_ns - recorder.first_ns) * 1e-9
        time_s = f'{elapsed_s:5.1f} / {self.config.duration:.1f} s'
        if estimate is None:
            return f'{time_s}  warming up'
        words = [' '.join(f'{mode.frequency_hz:.2f}' for mode in estimate.modes[:2]) + ' Hz'] if estimate.modes else []
        if event is not None and event.stamp_ns <= estimate.stamp_ns:  # announced ahead
            words.append(event.kind.value)
        if estimate.payload is not None:
            words.append(payload_words(estimate.payload))
        return f'{time_s}  {", ".join(words)}'

    @property
    def lost(self) -> int:
        """Number of joint states that the recorder missed plus number that the identifier missed."""
        return self.recorder.losses.lost + self.identifier.losses.lost

    def drain(self) -> None:
        """Stop the plant and the excitation, and let every node process the messages still under way."""
        self.plant.trigger_deactivate()
        self.excitation.trigger_deactivate()
        sent, recorder, identifier = self.plant.published, self.recorder, self.identifier
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


def payload_words(payload: Payload) -> str:
    """Return a payload as text for the progress line; it has numbers only where the payload is known."""
    if not math.isfinite(payload.std):
        return 'payload not known'
    doubt = '' if payload.status is Status.TRACKING else f' ({payload.status.name})'
    return f'payload {payload.mass:.2f} +- {payload.std:.2g} kg{doubt}'


def foreign_arm(node: Node, own_writers: int, own_readers: int) -> bool:
    """Return whether another process publishes joint states or efforts, or subscribes to efforts, on this domain.

    own_writers, own_readers: number of publishers and of subscriptions per topic in this process.
    """
    return bool(node.count_publishers('joint_states') > own_writers
                or node.count_subscribers('effort_controller/commands') > own_readers
                or node.count_publishers('effort_controller/commands') > own_writers)
