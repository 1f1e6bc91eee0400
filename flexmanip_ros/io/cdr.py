"""Decode JointState and Header directly from CDR bytes.

The messages of one publisher share one layout: names and array lengths, and with them every byte offset, stay the
same. So the messages of a recording are decoded many at a time as rows of one numpy table, after a check that their
names and lengths are equal. That takes about 0.1 us a message, the general decoder about 6 us.
"""

import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.types import CaptureEvent, EventKind, JointBlock, JointRecord

STAMP = struct.Struct('<iI')
COUNT = struct.Struct('<I')
START = 4
"""Size of the CDR encapsulation header [bytes]. The message begins after it, and alignment counts from there."""
HEAD = START + STAMP.size
"""Size of encapsulation header and stamp, after which frame_id begins [bytes]. Offsets count from the first byte."""
LITTLE_ENDIAN = b'\x00\x01'
BLOCK = 2048
"""Largest number of messages decoded at once: 2 s at 1 kHz, half a megabyte. Larger blocks are no faster."""


class CdrError(ValueError):
    """The bytes are not a message of the expected type."""


class Layout(NamedTuple):
    """Position of each field in JointStates that have the same size, frame_id, names and array lengths."""

    size: int
    """Size of a message [bytes]."""
    names: tuple[str, ...]
    words: bytes
    """The bytes of frame_id and names in the message, without the last zeros, which numpy leaves out."""
    counts: tuple[int, int, int]
    """Lengths of position, velocity and effort."""
    table: np.dtype[np.void]
    """A message as one row of a table: order, seconds, nanoseconds, words, then count0, position, count1, velocity,
    count2, effort. Bytes of padding belong to no column, as their content is undefined."""


def stamp_ns(raw: bytes) -> int:
    """Return the stamp of a message that begins with a Header [ns]. Raises CdrError."""
    if len(raw) < HEAD or raw[:2] != LITTLE_ENDIAN:
        raise CdrError('a message is not little-endian CDR with a header')
    seconds, nanoseconds = STAMP.unpack_from(raw, START)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def capture_event(raw: bytes) -> CaptureEvent:
    """Return the event in a Header. Raises ValueError when its frame_id is neither capture nor release."""
    stamp = stamp_ns(raw)
    frame, _ = _string(raw, HEAD)
    if frame not in (kind.value for kind in EventKind):
        raise ValueError(f"its frame_id is '{frame}', not 'capture' or 'release'")
    return CaptureEvent(stamp, EventKind(frame))


class Decoder:
    """Decodes JointStates. It keeps the layout of the latest message, which the next one mostly has as well."""

    def __init__(self) -> None:
        self._layout: Layout | None = None
        self._run = BLOCK
        """Number of messages that the next attempt decodes at once; small where the layout changes often."""

    def record(self, raw: bytes) -> JointRecord:
        """Return one message. Raises CdrError."""
        layout = self._layout
        if layout is None or len(raw) != layout.size:
            self._layout = layout = _joint_layout(raw)
        row: Any = np.frombuffer(raw, layout.table)[0].item()
        if (row[0], row[3], row[4::2]) != (LITTLE_ENDIAN, layout.words, layout.counts):
            self._layout = layout = _joint_layout(raw)
            row = np.frombuffer(raw, layout.table)[0].item()
        _, seconds, nanoseconds, _, _, position, _, velocity, _, effort = row
        return JointRecord(seconds * 1_000_000_000 + nanoseconds, layout.names, position, velocity, effort)

    def blocks(self, raws: Sequence[bytes]) -> Iterator[JointBlock | CdrError]:
        """Yield the messages in blocks of one layout each, and an error in place of each that is no JointState."""
        done = 0
        while done < len(raws):
            tried = raws[done:done + self._run]
            block = None if self._layout is None else _decoded(tried, self._layout)
            if block is None:
                try:
                    self._layout = _joint_layout(tried[0])
                except CdrError as error:
                    yield error
                    done += 1
                    continue
                block = _decoded(tried, self._layout)
                assert block is not None
            count = len(block.stamp_ns)
            self._run = min(8 * self._run, BLOCK) if count == len(tried) else count
            done += count
            yield block


def _decoded(raws: Sequence[bytes], layout: Layout) -> JointBlock | None:
    """Return the messages from the first on that have this layout; None where the first has another."""
    size = layout.size
    count = next((k for k, raw in enumerate(raws) if len(raw) != size), len(raws))
    if count == 0:
        return None
    table: NDArray[np.void] = np.frombuffer(b''.join(raws[:count]), layout.table)
    same = (table['order'] == LITTLE_ENDIAN) & (table['words'] == layout.words)
    for k, length in enumerate(layout.counts):
        same &= table[f'count{k}'] == length
    if not same.all():
        count = int(np.argmin(same))
        if count == 0:
            return None
        table = table[:count]
    stamps = table['seconds'].astype(np.int64) * 1_000_000_000 + table['nanoseconds']
    position, velocity, effort = (np.ascontiguousarray(table[name]) for name in ('position', 'velocity', 'effort'))
    return JointBlock(layout.names, stamps, position, velocity, effort)


def _joint_layout(raw: bytes) -> Layout:
    """Parse one JointState in full and return its layout. Raises CdrError."""
    stamp_ns(raw)
    _, at = _string(raw, HEAD)
    number, at = _count(raw, at)
    if number > len(raw):
        raise CdrError('a message has more names than bytes')
    names = []
    for _ in range(number):
        name, at = _string(raw, at)
        names.append(name)
    words = raw[HEAD:at]
    columns = {'order': ('S2', 0), 'seconds': ('<i4', START), 'nanoseconds': ('<u4', START + 4),
               'words': (f'S{len(words)}', HEAD)}
    counts = []
    for k, field in enumerate(('position', 'velocity', 'effort')):
        size, after = _count(raw, at)
        start = START + (after - START + 7 & -8) if size else after
        if start + 8 * size > len(raw):
            raise CdrError('an array runs past the end of its message')
        at = start + 8 * size
        columns[f'count{k}'] = ('<u4', after - COUNT.size)
        columns[field] = (f'({size},)<f8', start)
        counts.append(size)
    table = np.dtype({'names': list(columns), 'formats': [form for form, _ in columns.values()],
                      'offsets': [offset for _, offset in columns.values()], 'itemsize': len(raw)})
    return Layout(len(raw), tuple(names), words.rstrip(b'\0'), (counts[0], counts[1], counts[2]), table)


def _string(raw: bytes, at: int) -> tuple[str, int]:
    size, at = _count(raw, at)
    if size < 1 or at + size > len(raw) or raw[at + size - 1] != 0:
        raise CdrError('a text runs past the end of its message')
    try:
        return raw[at:at + size - 1].decode('utf-8'), at + size
    except UnicodeDecodeError as error:
        raise CdrError(str(error)) from error


def _count(raw: bytes, at: int) -> tuple[int, int]:
    at = START + (at - START + 3 & -4)
    if at + COUNT.size > len(raw):
        raise CdrError('a message ends too early')
    return COUNT.unpack_from(raw, at)[0], at + COUNT.size
