"""What a damaged recording still holds: its messages in file order up to the fault.

The reading libraries reject an mcap file whose end is missing, or lose the whole chunk that the fault is in (several
seconds at 1 kHz). Here every complete message before the fault comes out. An mcap file is a sequence of records
(opcode, length, content; https://mcap.dev/spec); chunks hold such a sequence, compressed. Of a .db3 file sqlite
itself returns the rows before the first missing page.
"""

from __future__ import annotations

import sqlite3
import struct
import sys
from collections.abc import Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

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
LARGEST = 1 << 30
"""Bytes read of a record at most, whatever its length says."""


class Raw(NamedTuple):
    """One message as it was stored."""

    topic: str
    msgtype: str
    data: bytes


class DamagedError(Exception):
    """The recording ends before it should, or holds bytes that mean nothing. Its text says which."""


def messages(path: Path) -> Iterator[Raw]:
    """Yield the messages of an .mcap or .db3 file in file order; raise DamagedError at the first fault."""
    try:
        if path.suffix == '.mcap':
            with path.open('rb') as file:
                yield from _mcap(file)
        else:
            yield from _sqlite(path)
    except (struct.error, KeyError, UnicodeDecodeError, OverflowError, zstd.ZstdError, RuntimeError, EOFError) as err:
        raise DamagedError('a record is garbled') from err
    except sqlite3.Error as err:
        raise DamagedError(f'the database is damaged ({err})') from err


def _mcap(file: BinaryIO) -> Iterator[Raw]:
    if file.read(len(MAGIC)) != MAGIC:
        raise DamagedError('it does not begin like an mcap file')
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    for opcode, content in _records(file):
        if opcode == MESSAGE:
            yield Raw(*channels[MESSAGE_HEAD.unpack_from(content)[0]], content[MESSAGE_HEAD.size:])
        elif opcode == SCHEMA:
            schemas[U16.unpack_from(content)[0]] = _text(content, 2)
        elif opcode == CHANNEL:
            channels[U16.unpack_from(content)[0]] = (_text(content, 4), schemas.get(U16.unpack_from(content, 2)[0], ''))
        elif opcode == DATA_END:
            return
    raise DamagedError('its end is missing')


def _records(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield the complete records of a file or an unpacked chunk, those inside its chunks too."""
    while head := stream.read(RECORD.size):
        if len(head) < RECORD.size:
            raise DamagedError('its end is missing')
        opcode, length = RECORD.unpack(head)
        content = stream.read(min(length, LARGEST))
        if opcode == CHUNK:
            yield from _records(BytesIO(_unpacked(content)))
        if len(content) < length:
            raise DamagedError('its end is missing')
        yield opcode, content


def _unpacked(chunk: bytes) -> bytes:
    """Return the records of a chunk, as many as its bytes give where its end is missing."""
    compression = _text(chunk, CHUNK_HEAD.size)
    packed = chunk[CHUNK_HEAD.size + 4 + len(compression) + 8:]
    if compression == 'zstd':
        return zstd.ZstdDecompressor().decompress(packed, LARGEST)
    if compression == 'lz4':
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, LARGEST))
    if compression:
        raise DamagedError(f"a chunk is compressed by '{compression}'")
    return packed


def _text(content: bytes, at: int) -> str:
    size = U32.unpack_from(content, at)[0]
    if at + 4 + size > len(content):
        raise DamagedError('a text runs past the end of its record')
    return content[at + 4:at + 4 + size].decode('utf-8')


def _sqlite(path: Path) -> Iterator[Raw]:
    with closing(sqlite3.connect(f'{path.resolve().as_uri()}?immutable=1', uri=True)) as database:
        database.execute('PRAGMA writable_schema=ON')  # a file shorter than its header says is read all the same
        topics = {number: (name, kind) for number, name, kind in database.execute('SELECT id, name, type FROM topics')}
        # In row order, without the index: the rows come out until the first missing page.
        for number, data in database.execute('SELECT topic_id, data FROM messages'):
            if number not in topics or not isinstance(data, bytes):
                raise DamagedError('a row is garbled')
            yield Raw(*topics[number], data)
