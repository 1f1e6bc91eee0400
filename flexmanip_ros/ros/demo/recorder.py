"""Node ``recorder``: what the other nodes say, into a bag that is closed and readable whatever happens.

It writes in the order of arrival, so that a replay meets events and samples as the identifier did.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import InertiaStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header

from flexmanip_ros import messages
from flexmanip_ros.errors import BagError
from flexmanip_ros.io.bag_writer import BagWriter, Value
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import JointStateReader, capture_event, inertia, labelled_array
from flexmanip_ros.ros.diagnostics import LossCounter
from flexmanip_ros.ros.node import sequence_number, with_info
from flexmanip_ros.types import CaptureEvent, JointRecord

NAME = 'recorder'
FLUSH_PERIOD = 0.25
IDENTIFIER = '/rpbsid_identifier'


class Recorder(Node):
    """Writes joint states, commands, events and the identifier's outputs; counts what it missed."""

    def __init__(self, path: Path, *, context: Context | None = None, namespace: str | None = None) -> None:
        """Open the bag; raises BagError when it exists or cannot be written."""
        super().__init__(NAME, context=context, namespace=namespace)
        self.writer = BagWriter(path)
        self.failure: BagError | None = None
        self.first_ns: int | None = None
        self.last_ns = 0
        self.joint_states = 0
        self.events: list[CaptureEvent] = []
        self.said: dict[str, list[messages.Value]] = {}
        self.losses = LossCounter()
        self._reader = JointStateReader()
        self._log_ns = 0
        self._deep = QoSProfile(depth=qos.SENSOR_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        self.create_subscription(JointState, 'joint_states', with_info(self._on_joint_states), self._deep,
                                 raw=True)
        self._listen(Float64MultiArray, 'effort_controller/commands', labelled_array)
        for topic in ('capture_event', 'capture_detected'):
            self._listen(Header, topic, capture_event, latched=True)
        for name, kind, convert in (
                (messages.MODEL, Float64MultiArray, labelled_array),
                (messages.MODES, Float64MultiArray, labelled_array),
                (messages.PAYLOAD_MASS, Float64, _number),
                (messages.PAYLOAD_ESTIMATE, Float64MultiArray, labelled_array),
                (messages.PAYLOAD, InertiaStamped, inertia)):
            self._listen(kind, f'{IDENTIFIER}/{name}', convert)
        self.create_timer(FLUSH_PERIOD, self._flush)

    def _listen(self, kind: type, topic: str, convert: Callable[[Any], Value], *,
                latched: bool = False) -> None:
        self.create_subscription(kind, topic, partial(self._on_message, topic, convert, latched),
                                 qos.latched_input() if latched else self._deep)

    def _on_joint_states(self, raw: bytes, info: object) -> None:
        self.losses.note(sequence_number(info))
        record: JointRecord = self._reader(raw)
        if self.first_ns is None:
            self.first_ns = record.stamp_ns
        self.last_ns = record.stamp_ns
        self.joint_states += 1
        self._write('/joint_states', record, latched=False)

    def _on_message(self, topic: str, convert: Callable[[Any], Value], latched: bool, message: Any) -> None:
        value = convert(message)
        if isinstance(value, CaptureEvent):
            self.events.append(value)
        if topic.startswith(IDENTIFIER) and isinstance(value, messages.Value):
            self.said.setdefault(topic.rpartition('/')[2], []).append(value)
        self._write('/' + topic.lstrip('/'), value, latched=latched)

    def _write(self, topic: str, value: Value, *, latched: bool) -> None:
        if self.failure is not None:
            return
        self._log_ns = max(time.time_ns(), self._log_ns)
        try:
            self.writer.write(topic, self._log_ns, value, latched=latched)
        except BagError as error:
            self.failure = error
            self.get_logger().error(f'recording ended: {error}')

    def _flush(self) -> None:
        if self.failure is not None:
            return
        try:
            self.writer.flush()
        except OSError as error:
            self.failure = BagError(f"bag '{self.writer.path}' cannot be written: {error.strerror}",
                                    'free some space; what was written before is kept')
            self.get_logger().error(f'recording ended: {self.failure}')

    def close(self) -> None:
        """Finish the bag; what could be written stays readable."""
        try:
            self.writer.close()
        except BagError as error:
            self.failure = self.failure or error


def _number(message: Float64) -> float:
    return float(message.data)

