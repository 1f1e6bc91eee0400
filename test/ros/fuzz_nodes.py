"""Every node that listens, on a bench: what it is sent, what it says, and whether it is still well."""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from fuzz_messages import LATER, NEXT, messages
from geometry_msgs.msg import InertiaStamped
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from joint_states import STEP_NS, joint_state
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty, Float64, Float64MultiArray, Header

from flexmanip_ros.ros.conversions import time_message
from flexmanip_ros.ros.nodes.capture_trigger import CaptureTrigger
from flexmanip_ros.ros.nodes.excitation import Excitation
from flexmanip_ros.ros.nodes.live_view import LiveView
from flexmanip_ros.ros.nodes.payload_adapter import PayloadAdapter
from flexmanip_ros.ros.nodes.payload_controller import PayloadController
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.ros.nodes.rpbsid_identifier import RpbsidIdentifier

EVENTS = {'capture_event': Header, 'capture_detected': Header}
ESTIMATE = 'rpbsid_identifier/payload_estimate'
IDENTIFIED = {f'rpbsid_identifier/{name}': kind for name, kind in (
    ('model', Float64MultiArray), ('modes', Float64MultiArray), ('modes_interval', Float64MultiArray),
    ('payload_mass', Float64), ('payload_estimate', Float64MultiArray), ('payload', InertiaStamped))}
DEEP = QoSProfile(
    depth=1000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATER_NS = LATER * 10**9


class Subject(NamedTuple):
    """A node under test: its class and parameters, the topics it hears and says."""

    cls: Any
    values: dict[str, Any]
    hears: dict[str, type]
    says: dict[str, type]


SUBJECTS = {
    'rpbsid_identifier': Subject(
        RpbsidIdentifier, {}, {'joint_states': JointState, **EVENTS}, IDENTIFIED),
    'plant_simulator': Subject(
        PlantSimulator, {'rate': 200.0, 'noise': 'none', 'arm__modes': 1},
        {'effort_controller/commands': Float64MultiArray, 'capture_event': Header},
        {'joint_states': JointState}),
    'capture_trigger': Subject(
        CaptureTrigger, {'mode': 'auto'}, {'joint_states': JointState}, EVENTS),
    'capture_trigger_timed': Subject(
        CaptureTrigger, {'mode': 'time', 'capture_time': 0.0}, {'joint_states': JointState}, EVENTS),
    'payload_controller': Subject(
        PayloadController, {'arm__modes': 1}, {
            'joint_states': JointState, ESTIMATE: Float64MultiArray,
            'payload_controller/added_efforts': Float64MultiArray},
        {'effort_controller/commands': Float64MultiArray}),
    'payload_adapter': Subject(
        PayloadAdapter, {'target_node': 'nobody', 'settle_time': 0.0, 'min_period': 0.01},
        {ESTIMATE: Float64MultiArray, 'rpbsid_identifier/payload': InertiaStamped}, {}),
    'live_view': Subject(
        LiveView, {'port': 0}, {'joint_states': JointState, 'rpbsid_identifier/status': DiagnosticArray, **EVENTS}, {}),
    'excitation': Subject(
        Excitation, {'clock': 'joint_states', 'shape': 'multisine', 'rate': 200.0, 'arm__modes': 1},
        {'joint_states': JointState},
        {'effort_controller/commands': Float64MultiArray}),
}


class Bench:
    """One node, spun, with a writer for every topic it hears and a reader for every one it says."""

    def __init__(self, ros: Ros, name: str) -> None:
        self.ros = ros
        self.subject = SUBJECTS[name]
        self.node = ros.managed(self.subject.cls(
            context=ros.context, overrides=overrides(**self.subject.values)))
        self.said = {topic: ros.listen(kind, topic) for topic, kind in self.subject.says.items()}
        self.diagnostics = ros.listen(DiagnosticArray, '/diagnostics')
        self.writers = {topic: ros.publisher(kind, topic, DEEP) for topic, kind in self.subject.hears.items()}
        self._samples = self.sent = 0
        self._echoes = ros.listen(Empty, 'echo', node=self.node)
        self._echo = ros.publisher(Empty, 'echo')

    def send(self, sent: list[tuple[str, Any]], *, wait: bool = True) -> None:
        """Publish, and wait until whatever is in the queues before an echo was taken.

        A joint state stamped ``NEXT`` gets the stamp of the next sample.
        """
        for topic, message in sent:
            if isinstance(message, JointState) and message.header.stamp.nanosec == NEXT:
                self._samples += 1
                message.header.stamp = time_message(LATER_NS + self._samples * STEP_NS)
            self.writers[topic].publish(message)
            self.sent += 1
        if not wait:
            return
        before = len(self._echoes)
        self._echo.publish(Empty())
        self.ros.wait(lambda: len(self._echoes) > before, what='the node to take what was sent')

    def traffic(self) -> st.SearchStrategy[list[tuple[str, Any]]]:
        """Return a strategy for what comes in."""
        return st.lists(st.one_of([
            st.tuples(st.just(topic), messages(kind)) for topic, kind in self.subject.hears.items()
        ]), min_size=1, max_size=6)

    def check(self) -> None:
        """Everything said is a number, torques and the arm's states finite; nothing remembered has grown."""
        for topic, heard in self.said.items():
            fine = math.isfinite if 'identifier' not in topic else is_number  # an interval may be infinite
            if '/modes' in topic:  # NaN stands for a mode that there is not
                fine = is_bounded
            for message in heard:
                assert all(map(fine, numbers(message))), message
            heard.clear()
        assert len(self.node._logged_at) < 20
        assert len(self.node.events) < 20

    def remembered(self) -> int:
        """Return how many events, and samples to go back to, the node keeps."""
        if isinstance(self.node, PlantSimulator):
            return len(self.node._pending)
        state = self.node.state
        events = state.payload
        if events is None:
            return len(state.early)
        rows = events.cursor - events.snapshots[0].row if events.snapshots else 0
        return len(state.early) + len(events.applied) + len(events.pending) + len(events.snapshots) + rows

    def alive(self) -> None:
        """The node answers: its diagnostics come."""
        before = len(self.diagnostics)
        self.ros.wait(lambda: len(self.diagnostics) > before, what='diagnostics')
        gc.collect()


def fuzz(bench: Bench, examples: int) -> None:
    """Send what hypothesis makes up, and look at what the node says to each of it."""
    @settings(max_examples=examples, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
    @given(bench.traffic())
    def run(sent: list[tuple[str, Any]]) -> None:
        bench.send(sent)
        bench.check()

    run()


def good(kind: type, k: int) -> Any:
    """Return message k of a stream that a node can use; of joint states the stamps advance."""
    if kind is JointState:
        return joint_state(k, start_ns=LATER_NS)
    if kind is InertiaStamped:
        message = InertiaStamped()
        message.inertia.m, message.inertia.ixx, message.inertia.iyy, message.inertia.izz = 20.0, 0.5, 0.5, 1.0
        return message
    return kind(data=[20.0, 0.1, 19.8, 20.2, 1.0])


def is_number(value: float) -> bool:
    """Say whether a value is no NaN."""
    return not math.isnan(value)


def is_bounded(value: float) -> bool:
    """Say whether a value is not infinite."""
    return not math.isinf(value)


def numbers(message: Any) -> Iterator[float]:
    """Yield every floating-point number in a message."""
    for owner, key in places(message):
        yield getattr(owner, key) if isinstance(key, str) else owner[key]


def poison(message: Any, place: int, value: float) -> None:
    """Set number ``place`` of a message, in the order of ``numbers``."""
    owner, key = list(places(message))[place]
    if isinstance(key, str):
        setattr(owner, key, value)
    else:
        owner[key] = value


def places(message: Any) -> Iterator[tuple[Any, str | int]]:
    """Yield where each floating-point number of a message stands: a message and a field, or an array and an index."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if hasattr(value, 'get_fields_and_field_types'):
            yield from places(value)
        elif 'double' in kind:
            yield from ((value, k) for k in range(len(value))) if hasattr(value, '__len__') else ((message, name),)
