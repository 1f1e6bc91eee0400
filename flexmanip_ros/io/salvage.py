"""What a damaged recording still holds: messages in file order up to the fault.

The reading libraries give up on a recording whose end is missing, or drop the whole chunk the fault is in
(with 1 MiB chunks several seconds at 1 kHz). Here every complete message before the fault comes out.
MCAP records: https://mcap.dev/spec (opcode, length, content; chunks hold records of their own).
"""

from __future__ import annotations

import sqlite3
import struct
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b'\x89MCAP0\r\n'
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
RECORD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')
CHUNK_HEAD = struct.Struct('<QQQI')
U16 = struct.Struct('<H')
U32 = struct.Struct('<I')
LARGEST_CHUNK = 1 << 30


class Raw(NamedTuple):
    """One message as it was stored."""

    topic: str
    msgtype: str
    log_ns: int
    data: bytes


class DamagedError(Exception):
    """The recording ends before it should, or holds bytes that mean nothing. Says what."""


def messages(path: Path) -> Iterator[Raw]:
    """Yield what an .mcap or .db3 file holds, in file order; raise DamagedError at the first fault."""
    if path.suffix == '.mcap':
        yield from _mcap(path)
    elif path.suffix == '.db3':
        yield from _sqlite(path)
    else:
        raise DamagedError(f'{path.name} is neither .mcap nor .db3')


class _Channels:
    """Schemas and channels met so far."""

    def __init__(self) -> None:
        self.schemas: dict[int, str] = {}
        self.channels: dict[int, tuple[str, str]] = {}

    def take(self, opcode: int, content: bytes) -> Raw | None:
        """Remember a schema or channel, or return the message a record holds."""
        if opcode == MESSAGE:
            channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(content)
            if channel not in self.channels:
                raise DamagedError('a message belongs to no channel')
            return Raw(*self.channels[channel], log_ns, content[MESSAGE_HEAD.size:])
        if opcode == SCHEMA:
            self.schemas[U16.unpack_from(content)[0]] = _text(content, 2)[0]
        elif opcode == CHANNEL:
            schema = self.schemas.get(U16.unpack_from(content, 2)[0], '')
            self.channels[U16.unpack_from(content)[0]] = (_text(content, 4)[0], schema)
        return None


def _text(content: bytes, at: int) -> tuple[str, int]:
    end = at + 4 + U32.unpack_from(content, at)[0]
    if end > len(content):
        raise DamagedError('a text runs past the end of its record')
    return content[at + 4:end].decode('utf-8'), end


def _mcap(path: Path) -> Iterator[Raw]:
    known = _Channels()
    size = path.stat().st_size
    with path.open('rb') as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise DamagedError('it does not begin like an mcap file')
        while True:
            head = file.read(RECORD.size)
            if len(head) < RECORD.size:
                raise DamagedError('its end is missing')
            opcode, length = RECORD.unpack(head)
            if opcode == DATA_END:
                return
            whole = length <= size - file.tell()
            if opcode == CHUNK:
                yield from _chunk(known, file.read(min(length, LARGEST_CHUNK)), whole)
            elif whole:
                try:
                    found = known.take(opcode, file.read(length))
                except (struct.error, UnicodeDecodeError) as err:
                    raise DamagedError('a record is garbled') from err
                if found is not None:
                    yield found
            if not whole:
                raise DamagedError('its end is missing')


def _chunk(known: _Channels, content: bytes, whole: bool) -> Iterator[Raw]:
    try:
        compression, at = _text(content, CHUNK_HEAD.size)
        records = _unpacked(compression, content[at + 8:])
        at = 0
        while at + RECORD.size <= len(records):
            opcode, length = RECORD.unpack_from(records, at)
            at += RECORD.size
            if length > len(records) - at:
                break
            found = known.take(opcode, records[at:at + length])
            at += length
            if found is not None:
                yield found
        if at != len(records) and whole:
            raise DamagedError('a chunk is garbled')
    except (struct.error, UnicodeDecodeError, zstd.ZstdError, RuntimeError, EOFError) as err:
        raise DamagedError('a chunk is garbled') from err


def _unpacked(compression: str, packed: bytes) -> bytes:
    """Return as much of a chunk as its bytes give."""
    if compression == '':
        return packed
    if compression == 'zstd':
        return zstd.ZstdDecompressor().decompress(packed, LARGEST_CHUNK)
    if compression == 'lz4':
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, LARGEST_CHUNK))
    raise DamagedError(f"a chunk is compressed by '{compression}'")


def _sqlite(path: Path) -> Iterator[Raw]:
    try:
        with closing(sqlite3.connect(f'{path.resolve().as_uri()}?immutable=1', uri=True)) as database:
            database.execute('PRAGMA writable_schema=ON')  # lets a file shorter than its header says be read
            topics = {number: (name, kind)
                      for number, name, kind in database.execute('SELECT id, name, type FROM topics')}
            # In row order, without the index: the rows come out until the first missing page.
            for number, log_ns, data in database.execute('SELECT topic_id, timestamp, data FROM messages'):
                if number not in topics or not isinstance(data, bytes) or not isinstance(log_ns, int):
                    raise DamagedError('a row is garbled')
                yield Raw(*topics[number], log_ns, data)
    except (sqlite3.Error, UnicodeDecodeError, OverflowError) as err:
        raise DamagedError(f'the database is damaged ({err})') from err
