"""Conversion of ROS messages to values of the core, and back; ``samples.sampling`` decides which can be used."""

from __future__ import annotations

import array
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Inertia, InertiaStamped, Vector3
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header, MultiArrayDimension, MultiArrayLayout

from flexmanip_ros import messages
from flexmanip_ros.errors import SignalError
from flexmanip_ros.io import cdr
from flexmanip_ros.messages import SECOND, AnyValue, Diagnostics
from flexmanip_ros.types import Array, CaptureEvent, EventKind, JointBlock, JointRecord


def stamp_ns(stamp: Time) -> int:
    """Return a stamp in nanoseconds."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def time_message(nanoseconds: int) -> Time:
    """Return nanoseconds as a stamp; a time beyond the range of stamps becomes the nearest stamp."""
    return Time(**messages.stamp(nanoseconds))


class JointStateReader:
    """Decoder of the bytes of a raw subscription, the one that reads bags: it takes a third of the time of rclpy's."""

    def __init__(self) -> None:
        self._decoder = cdr.Decoder()

    def __call__(self, raw: bytes) -> JointRecord:
        """Return the message; rclpy's own decoder is used where the bytes have another encoding.

        Raises SignalError for bytes that are no JointState.
        """
        try:
            return self._decoder.record(raw)
        except cdr.CdrError:
            return _decoded(raw)

    def blocks(self, raws: Sequence[bytes]) -> Iterator[JointBlock | SignalError]:
        """Yield the messages in blocks of one layout each; yield a SignalError for bytes that are no JointState."""
        done = 0
        for found in self._decoder.blocks(raws):
            if isinstance(found, JointBlock):
                yield found
                done += len(found.stamp_ns)
                continue
            try:
                yield JointBlock.of(_decoded(raws[done]))
            except SignalError as error:
                yield error
            done += 1


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


def capture_event(message: Header) -> CaptureEvent:
    """Return the event in a message. Raises SignalError when frame_id is neither capture nor release."""
    try:
        kind = EventKind(message.frame_id)
    except ValueError as error:
        raise SignalError(
            f"an event has frame_id '{message.frame_id}'",
            f'write one of {", ".join(item.value for item in EventKind)}') from error
    return CaptureEvent(stamp_ns(message.stamp), kind)


def doubles(values: Array) -> array.array[float]:
    """Return values as rclpy keeps a float64[]: an array.array, filled without a Python loop."""
    return array.array('d', np.ascontiguousarray(values, dtype=np.float64).tobytes())


def diagnostics(message: DiagnosticArray) -> Diagnostics:
    """Return a message as diagnostic entries."""
    return Diagnostics(stamp_ns(message.header.stamp), tuple(
        messages.DiagnosticStatus(item.level[0], item.name, item.message, item.hardware_id,
                                  tuple((pair.key, pair.value) for pair in item.values))
        for item in message.status))


def type_name(kind: type[Any]) -> str:
    """Return the name of a message type, such as std_msgs/msg/Header."""
    return f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}'


_TYPES = {type_name(kind): kind for kind in (
    DiagnosticArray, DiagnosticStatus, Float64, Float64MultiArray, Header, Inertia, InertiaStamped, JointState,
    KeyValue, MultiArrayDimension, MultiArrayLayout, Time, Vector3)}


def to_message(value: AnyValue) -> Any:
    """Return a value as the message that a node publishes."""
    return messages.message(value, _new)


def _new(kind: str, **fields: Any) -> Any:
    if 'level' in fields:  # rclpy keeps a byte as bytes
        fields['level'] = bytes([fields['level']])
    return _TYPES[kind](**{name: doubles(part) if isinstance(part, np.ndarray) else part
                           for name, part in fields.items()})
