"""Messages of one shape as bytes: rclpy's own encoder lays the first one out, the next change numbers in it.

What goes out at a high rate has the same names and sizes every time. Filling a message class and encoding it
takes several times as long as writing the numbers where they belong (benchmarks/ros_latency.py).
"""

from __future__ import annotations

import struct

import numpy as np
from rclpy.serialization import serialize_message

from flexmanip_ros.io import cdr
from flexmanip_ros.messages import Inertia, LabelledArray, Value
from flexmanip_ros.ros.conversions import clamped, joint_state, to_message
from flexmanip_ros.types import JointRecord

_BODY = struct.Struct('<10d')
"""Mass, centre of mass, inertia: the end of an InertiaStamped."""
_NUMBER = struct.Struct('<d')
_MOST = 100
"""Layouts kept."""


class Encoder:
    """Values an estimate publishes to bytes. Layouts are kept: a model's labels change."""

    def __init__(self) -> None:
        self._layouts: dict[object, bytes] = {}

    def __call__(self, value: Value) -> bytes:
        """Return the message as it goes over the wire."""
        if isinstance(value, Inertia):
            raw = bytearray(self._layout(value.frame_id, value))
            cdr.STAMP.pack_into(raw, cdr.START, *clamped(value.stamp_ns))
            _BODY.pack_into(raw, len(raw) - _BODY.size, value.mass, *value.com, *value.inertia)
            return bytes(raw)
        if isinstance(value, LabelledArray):
            numbers = np.ascontiguousarray(value.data, dtype='<f8').tobytes()
            layout = self._layout((value.dimensions, len(numbers)), value)
            return layout[:len(layout) - len(numbers)] + numbers
        return self._layout(float, value)[:-_NUMBER.size] + _NUMBER.pack(value)

    def _layout(self, key: object, value: Value) -> bytes:
        layout = self._layouts.get(key)
        if layout is None:
            if len(self._layouts) >= _MOST:
                self._layouts.clear()
            layout = self._layouts[key] = serialize_message(to_message(value))
        return layout


class JointStateWriter:
    """Records of one plant to the bytes of a JointState."""

    def __init__(self) -> None:
        self._raw = b''
        self._layout: cdr.Layout | None = None

    def __call__(self, record: JointRecord) -> bytes:
        """Return the message as it goes over the wire."""
        parts = record.position, record.velocity, record.effort
        layout = self._layout
        if layout is None or layout.names != record.names or layout.counts != tuple(p.size for p in parts):
            self._raw = serialize_message(joint_state(record))
            self._layout = cdr.joint_layout(self._raw)
            return self._raw
        raw = bytearray(self._raw)
        cdr.STAMP.pack_into(raw, cdr.START, *clamped(record.stamp_ns))
        for start, part in zip(layout.starts, parts, strict=True):
            raw[start:start + 8 * part.size] = np.ascontiguousarray(part, dtype='<f8').tobytes()
        return bytes(raw)
