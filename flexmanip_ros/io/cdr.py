"""JointState and Header straight from their CDR bytes: messages of one recording share one layout.

Reading through the general decoder costs several times what the identifier does with the sample
(benchmarks/io_bag_reading.py). The names of a message are compared as bytes with those of the message
before; only when they differ is the message parsed in full.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from flexmanip_ros.types import Array, CaptureEvent, EventKind, JointRecord

STAMP = struct.Struct('<iI')
COUNT = struct.Struct('<I')
_ARRAY, _NUMBERS = struct.Struct('<3I'), 20
"""Dimensions, data offset and size of a Float64MultiArray, and where its numbers begin if it has none."""
START = 4
"""Where a message begins, after its encapsulation."""
HEAD = START + STAMP.size
"""Bytes before frame_id: encapsulation and stamp (offsets below count from the encapsulation's start)."""
LITTLE_ENDIAN = b'\x00\x01'


class CdrError(ValueError):
    """The bytes are not a message of the expected type."""


class Layout(NamedTuple):
    """Where everything stands in messages of one size, with the same frame_id and names."""

    size: int
    head: struct.Struct
    """Unpacks encapsulation, seconds, nanoseconds, ``words`` and the three lengths."""
    words: bytes
    """frame_id and names as bytes."""
    counts: tuple[int, int, int]
    starts: tuple[int, int, int]
    names: tuple[str, ...]


def stamp_ns(raw: bytes) -> int:
    """Return the stamp of a message that begins with a Header [ns]."""
    if len(raw) < HEAD or raw[:2] != LITTLE_ENDIAN:
        raise CdrError('a message is not little-endian CDR with a header')
    seconds, nanoseconds = STAMP.unpack_from(raw, START)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def doubles(raw: bytes) -> Array:
    """Return the numbers of a Float64MultiArray without dimensions, as commands are; else CdrError."""
    dimensions, _, count = _ARRAY.unpack_from(raw, START) if len(raw) >= START + _ARRAY.size else (1, 0, 0)
    if raw[:2] != LITTLE_ENDIAN or dimensions or len(raw) != _NUMBERS + 8 * count:
        raise CdrError('not a plain array of numbers')
    return np.frombuffer(raw, '<f8', count, _NUMBERS)


def _string(raw: bytes, at: int) -> tuple[str, int]:
    size, at = _count(raw, at)
    if size < 1 or at + size > len(raw) or raw[at + size - 1] != 0:
        raise CdrError('a text runs past the end of its message')
    return raw[at:at + size - 1].decode('utf-8'), at + size


def _count(raw: bytes, at: int) -> tuple[int, int]:
    at = 4 + (at - 4 + 3 & -4)
    if at + 4 > len(raw):
        raise CdrError('a message ends too early')
    return COUNT.unpack_from(raw, at)[0], at + 4


def joint_layout(raw: bytes) -> Layout:
    """Parse one JointState in full and return where its arrays stand."""
    stamp_ns(raw)
    _, at = _string(raw, HEAD)
    number, at = _count(raw, at)
    if number > len(raw):
        raise CdrError('more names than bytes')
    names = []
    for _ in range(number):
        name, at = _string(raw, at)
        names.append(name)
    words = raw[HEAD:at]
    pattern = f'<2s2xiI{len(words)}s'
    counts, starts = [], []
    for _ in range(3):
        size, after = _count(raw, at)
        start = 4 + (after - 4 + 7 & -8) if size else after
        if size > len(raw) or start + 8 * size > len(raw):
            raise CdrError('an array runs past the end of its message')
        pattern += f'{after - 4 - at}xI{start + 8 * size - after}x'
        counts.append(size)
        starts.append(start)
        at = start + 8 * size
    return Layout(len(raw), struct.Struct(pattern), words, (counts[0], counts[1], counts[2]),
                  (starts[0], starts[1], starts[2]), tuple(names))


def joint_record(raw: bytes, layout: Layout | None) -> tuple[JointRecord, Layout]:
    """Return the message and its layout, which makes the next one of the same layout cheap."""
    if layout is None or len(raw) != layout.size:
        layout = joint_layout(raw)
    order, seconds, nanoseconds, words, *counts = layout.head.unpack_from(raw)
    if words != layout.words or tuple(counts) != layout.counts or order != LITTLE_ENDIAN:
        layout = joint_layout(raw)
    (a, b, c), (at_a, at_b, at_c) = layout.counts, layout.starts
    stamp = seconds * 1_000_000_000 + nanoseconds
    return JointRecord(
        stamp, layout.names, np.frombuffer(raw, '<f8', a, at_a) if a else _EMPTY,
        np.frombuffer(raw, '<f8', b, at_b) if b else _EMPTY,
        np.frombuffer(raw, '<f8', c, at_c) if c else _EMPTY), layout


_EMPTY = np.empty(0)
_EMPTY.setflags(write=False)


def capture_event(raw: bytes) -> CaptureEvent:
    """Return the event in a Header; ValueError when its frame_id is neither capture nor release."""
    stamp = stamp_ns(raw)
    frame, _ = _string(raw, HEAD)
    return CaptureEvent(stamp, EventKind(frame))
