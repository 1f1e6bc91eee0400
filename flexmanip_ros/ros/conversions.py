"""Conversion of ROS messages to values of the core, and back; ``samples.sampling`` decides which can be used."""

from __future__ import annotations

import array
import struct
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import InertiaStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header, MultiArrayDimension

from flexmanip_ros import messages
from flexmanip_ros.errors import SignalError
from flexmanip_ros.io import cdr
from flexmanip_ros.messages import Diagnostics, Dimension, Inertia, LabelledArray, Value
from flexmanip_ros.types import Array, CaptureEvent, EventKind, JointBlock, JointRecord

SECOND = 1_000_000_000
FIRST_NS, LAST_NS = -(1 << 31) * SECOND, (1 << 31) * SECOND - 1
"""Smallest and largest time that a stamp can hold [ns] (its seconds have 32 bits)."""


def stamp_ns(stamp: Time) -> int:
    """Return a stamp in nanoseconds."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def time_message(nanoseconds: int) -> Time:
    """Return nanoseconds as a stamp; a time beyond the range of stamps becomes the nearest stamp."""
    sec, nanosec = divmod(min(max(nanoseconds, FIRST_NS), LAST_NS), SECOND)
    return Time(sec=sec, nanosec=nanosec)


class JointStateReader:
    """Decoder of the bytes of a raw subscription, the one that reads bags: it takes a third of the time of rclpy's."""

    def __init__(self) -> None:
        self._layout: cdr.Layout | None = None

    def __call__(self, raw: bytes) -> JointRecord:
        """Return the message; rclpy's own decoder is used where the bytes have another encoding.

        Raises SignalError for bytes that are no JointState.
        """
        try:
            record, self._layout = cdr.joint_record(raw, self._layout)
        except (cdr.CdrError, UnicodeDecodeError, struct.error):
            return _decoded(raw)
        return record

    def blocks(self, raws: Sequence[bytes]) -> Iterator[JointBlock | SignalError]:
        """Yield the messages in blocks of one layout each; yield a SignalError for bytes that are no JointState."""
        first, most = 0, len(raws)
        while first < len(raws):
            part = raws[first:first + most]
            try:
                block, self._layout = cdr.joint_block(part, self._layout)
            except (cdr.CdrError, UnicodeDecodeError, struct.error):
                try:
                    block = JointBlock.of(_decoded(part[0]))
                except SignalError as error:
                    yield error
                    first += 1
                    continue
            yield block
            count = len(block.stamp_ns)
            first, most = first + count, 2 * count  # where layouts alternate, a block does not scan all the rest


def _decoded(raw: bytes) -> JointRecord:
    """Return a message through rclpy's own decoder, for bytes of another encoding or shape."""
    try:
        return joint_record(deserialize_message(raw, JointState))
    except (RuntimeError, MemoryError) as error:  # the errors of the middleware
        raise SignalError('the bytes of a message are no JointState', 'look at its publisher') from error


def joint_record(message: JointState) -> JointRecord:
    """Return a JointState with its arrays copied; sizes and values are taken as they are."""
    return JointRecord(
        stamp_ns(message.header.stamp), tuple(message.name), np.array(message.position, dtype=np.float64),
        np.array(message.velocity, dtype=np.float64), np.array(message.effort, dtype=np.float64))


def joint_state(record: JointRecord) -> JointState:
    """Return a record as a JointState."""
    message = JointState()
    message.header.stamp = time_message(record.stamp_ns)
    message.name = list(record.names)
    message.position = doubles(record.position)
    message.velocity = doubles(record.velocity)
    message.effort = doubles(record.effort)
    return message


def capture_event(message: Header) -> CaptureEvent:
    """Return the event in a message. Raises SignalError when frame_id is neither capture nor release."""
    try:
        kind = EventKind(message.frame_id)
    except ValueError as error:
        raise SignalError(
            f"an event has frame_id '{message.frame_id}'",
            f'write one of {", ".join(item.value for item in EventKind)}') from error
    return CaptureEvent(stamp_ns(message.stamp), kind)


def header(event: CaptureEvent) -> Header:
    """Return an event as the Header that is published."""
    return Header(stamp=time_message(event.stamp_ns), frame_id=event.kind.value)


def doubles(values: Array) -> array.array[float]:
    """Return values as rclpy keeps a float64[]: an array.array, filled without a Python loop."""
    return array.array('d', np.ascontiguousarray(values, dtype=np.float64).tobytes())


def multi_array(values: LabelledArray) -> Float64MultiArray:
    """Return a labelled array as a message."""
    message = Float64MultiArray()
    message.layout.dim = [
        MultiArrayDimension(label=item.label, size=item.size, stride=item.stride)
        for item in values.dimensions]
    message.data = doubles(values.data)
    return message


def labelled_array(message: Float64MultiArray) -> LabelledArray:
    """Return a message as a labelled array."""
    dimensions = tuple(Dimension(item.label, item.size, item.stride) for item in message.layout.dim)
    return LabelledArray(dimensions, np.array(message.data, dtype=np.float64))


def inertia_stamped(value: Inertia) -> InertiaStamped:
    """Return a payload as an InertiaStamped, the message that a robot driver takes."""
    message = InertiaStamped()
    message.header.stamp = time_message(value.stamp_ns)
    message.header.frame_id = value.frame_id
    body = message.inertia
    body.m = float(value.mass)
    body.com.x, body.com.y, body.com.z = map(float, value.com)
    body.ixx, body.ixy, body.ixz, body.iyy, body.iyz, body.izz = map(float, value.inertia)
    return message


def inertia(message: InertiaStamped) -> Inertia:
    """Return a payload message as a value."""
    body, com = message.inertia, message.inertia.com
    return Inertia(stamp_ns(message.header.stamp), message.header.frame_id, body.m, (com.x, com.y, com.z),
                   (body.ixx, body.ixy, body.ixz, body.iyy, body.iyz, body.izz))


def diagnostic_array(value: Diagnostics) -> DiagnosticArray:
    """Return diagnostic entries as a message."""
    message = DiagnosticArray(status=[
        DiagnosticStatus(level=bytes([item.level]), name=item.name, message=item.message, hardware_id=item.hardware_id,
                         values=[KeyValue(key=key, value=text) for key, text in item.values])
        for item in value.statuses])
    message.header.stamp = time_message(value.stamp_ns)
    return message


def diagnostics(message: DiagnosticArray) -> Diagnostics:
    """Return a message as diagnostic entries."""
    return Diagnostics(stamp_ns(message.header.stamp), tuple(
        messages.DiagnosticStatus(item.level[0], item.name, item.message, item.hardware_id,
                                  tuple((pair.key, pair.value) for pair in item.values))
        for item in message.status))


def to_message(value: Value) -> Float64MultiArray | InertiaStamped | DiagnosticArray | Float64:
    """Return a value that the identifier publishes as its message."""
    if isinstance(value, Diagnostics):
        return diagnostic_array(value)
    if isinstance(value, LabelledArray):
        return multi_array(value)
    if isinstance(value, Inertia):
        return inertia_stamped(value)
    return Float64(data=float(value))


def from_message(message: Any) -> Value:
    """Return the value of a message that the identifier publishes; the inverse of ``to_message``."""
    if isinstance(message, DiagnosticArray):
        return diagnostics(message)
    if isinstance(message, Float64MultiArray):
        return labelled_array(message)
    return inertia(message) if isinstance(message, InertiaStamped) else float(message.data)
