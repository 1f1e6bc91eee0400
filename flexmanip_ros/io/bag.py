"""Read the messages that the identifier needs from a rosbag2 recording (sqlite3 or mcap), in recorded order.

From a damaged recording this module reads every complete message before the fault. It parses mcap files itself for
this: the reading libraries reject a file whose end is missing, or lose the whole chunk with the fault (several seconds
at 1 kHz). An mcap file is a sequence of records (opcode, length, content; https://mcap.dev/spec). A chunk is a record
that holds such a sequence, compressed. A fault inside a compressed chunk costs that chunk. From a .db3 file sqlite
itself returns the rows before the first missing page.
"""

import re
import sqlite3
import struct
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]

from flexmanip_ros.errors import BagError
from flexmanip_ros.io import cdr
from flexmanip_ros.types import CaptureEvent, JointBlock, JointRecord

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
"""Largest number of bytes that are read of a record, whatever length it states."""


class Raw(NamedTuple):
    """One message as it was stored."""

    topic: str
    msgtype: str
    data: bytes


class DamagedError(Exception):
    """The recording ends too early or contains invalid bytes. The text of the error says which."""


def salvaged(path: Path) -> Iterator[Raw]:
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
    """Yield the complete records of a file or an unpacked chunk, including those inside its chunks."""
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
    """Return the unpacked records of a chunk; where its end is missing, as many as can be unpacked."""
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


def _has_log(path: Path) -> bool:
    """Whether a .db3 file has a write-ahead log: `--storage-preset-profile resilient`, and the recorder was killed."""
    log = path.with_name(f'{path.name}-wal')
    return path.suffix == '.db3' and log.is_file() and log.stat().st_size > 0


def _sqlite(path: Path) -> Iterator[Raw]:
    how = 'mode=ro' if _has_log(path) else 'immutable=1'  # an immutable database is read without its log
    with closing(sqlite3.connect(f'{path.resolve().as_uri()}?{how}', uri=True)) as database:
        database.execute('PRAGMA writable_schema=ON')  # a file shorter than its header says is read all the same
        topics = {number: (name, kind) for number, name, kind in database.execute('SELECT id, name, type FROM topics')}
        # In row order, without the index: the rows come out until the first missing page.
        for number, data in database.execute('SELECT topic_id, data FROM messages'):
            if number not in topics or not isinstance(data, bytes):
                raise DamagedError('a row is garbled')
            yield Raw(*topics[number], data)


STORAGE = ('.mcap', '.db3')
COMPRESSED = tuple(f'{ending}.zstd' for ending in STORAGE)
"""Ends of the names of a recording's files; the second ones are of `ros2 bag record --compression-mode file`."""
PACKED = b'\x28\xb5\x2f\xfd'
"""First bytes of a message that `ros2 bag record --compression-mode message` compressed; CDR begins otherwise."""
METADATA_FAULTS = ('Could not load YAML', 'Invalid bag metadata', 'A metadata key is missing')
"""How the library begins what it says of a metadata.yaml whose content is unusable."""
JOINT_STATE = 'sensor_msgs/msg/JointState'
HEADER = 'std_msgs/msg/Header'

Progress = Callable[[int, int | None], None]
"""Callback with the number of messages read and their total number (None when the recording does not state it)."""


@dataclass(frozen=True)
class Topics:
    """Names of the topics to read. A name without a leading slash is found in any one namespace."""

    joint_states: str = 'joint_states'
    events: tuple[str, ...] = ('capture_event', 'capture_detected')
    events_required: bool = False
    """Whether a missing event topic is an error, as it is where the user named the topics."""


def read(path: str | Path, topics: Topics | None = None, progress: Progress | None = None
         ) -> Iterator[JointRecord | CaptureEvent]:
    """Yield the messages of ``read_blocks`` one by one."""
    for item in read_blocks(path, topics, progress):
        if isinstance(item, JointBlock):
            yield from (item.record(k) for k in range(len(item.stamp_ns)))
        else:
            yield item


def read_blocks(path: str | Path, topics: Topics | None = None, progress: Progress | None = None
                ) -> Iterator[JointBlock | CaptureEvent]:
    """Yield the joint states and events of a bag (its directory, or the .mcap or .db3 file itself).

    Joint states come in blocks of up to ``cdr.BLOCK`` messages; a block ends before an event and where names or array
    lengths change. From a damaged recording everything before the fault is yielded; then BagError says what is
    wrong, so that nothing recorded is lost and no damage goes unseen.
    """
    recording = _Recording(Path(path), topics or Topics())
    waiting: list[bytes] = []
    first = 0
    try:
        for topic, raw in recording.messages():
            if topic == recording.joint_topic:
                first = first if waiting else recording.taken
                waiting.append(raw)
                if len(waiting) < cdr.BLOCK:
                    continue
            yield from recording.joint_states(waiting, first)
            waiting = []
            if topic != recording.joint_topic:
                yield from recording.event(topic, raw)
            if progress is not None:
                progress(recording.taken, recording.total)
    except BagError:
        yield from recording.joint_states(waiting, first)
        raise
    yield from recording.joint_states(waiting, first)
    if progress is not None:
        progress(recording.taken, recording.taken)
    recording.check()


def check(path: str | Path) -> None:
    """Raise BagError for a path that cannot be a bag. Nothing is read."""
    _Recording(Path(path), Topics())


def event_topics(path: str | Path, topics: Topics | None = None) -> tuple[str, ...]:
    """Return the event topics of a bag, with or without messages on them.

    If the library cannot open the bag, its messages are searched for topics. The function raises no error for a faulty
    bag: reading the bag reports the fault.
    """
    recording: _Recording | None = None
    with suppress(BagError):
        recording = _Recording(Path(path), topics or Topics())
        with closing(recording.messages()) as messages:
            next(messages, None)  # every topic is known before the first message
    return () if recording is None else tuple(sorted(set(recording.event_topics.values())))


class _Recording:
    """One pass over one bag, with the faults that it found."""

    def __init__(self, path: Path, topics: Topics) -> None:
        self.path = path
        self.topics = topics
        self.joint_topic = ''
        self.taken = 0
        """Number of messages on the chosen topics that were read so far."""
        self.total: int | None = None
        self.event_topics: dict[str, str] = {}
        """Event topics that were found so far, by the names that were asked for."""
        self._there: dict[str, str] = {}
        """Types of the topics of the messages, where the library did not tell them."""
        self._metadata = ''
        """What is wrong with metadata.yaml."""
        self._damage = ''
        """What is wrong with the data."""
        self._fault: tuple[str, str] | None = None
        """What is wrong with the first message that is left out, and what to do."""
        self._left_out = 0
        self._joint_states = 0
        self._decoder = cdr.Decoder()
        try:
            self._look()
        except OSError as err:
            raise BagError(f"bag '{path}' cannot be read: {err.strerror}", 'check the permissions') from err

    def _look(self) -> None:
        """Raise BagError for a path that cannot be a bag."""
        path = self.path
        if not path.exists():
            raise BagError(f"bag '{path}' does not exist", 'check the path')
        if path.suffix == '.bag':
            raise BagError(f"'{path}' is a ROS 1 bag", 'convert it: rosbags-convert --src FILE --dst FOLDER')
        if path.is_file() and path.name.endswith(COMPRESSED):
            raise BagError(f"'{path}' is compressed", f'give its directory with metadata.yaml, or {_unpacking(path)}')
        if path.is_file() and path.suffix not in STORAGE:
            raise BagError(f"'{path}' is not a bag", 'give a rosbag2 directory, an .mcap or a .db3 file')
        if path.is_dir() and not (path / 'metadata.yaml').is_file() and not self._files():
            raise BagError(f"directory '{path}' is not a bag: metadata.yaml and recording are missing",
                           'give the directory that ros2 bag record made')
        if not any(file.stat().st_size for file in self._files()):
            raise BagError(f"bag '{path}' is empty", 'record again; the recorder was stopped before it wrote')

    def _files(self) -> list[Path]:
        if self.path.is_file():
            return [self.path]
        found = (file for file in self.path.iterdir() if file.suffix in STORAGE or (
            file.name.endswith(COMPRESSED) and not file.with_suffix('').exists()))  # one that was decompressed is read
        return sorted(found, key=lambda file: [  # file 10 of a split recording comes after file 9
            (part.isdigit(), int(part) if part.isdigit() else 0, part) for part in re.split(r'(\d+)', file.name)])

    def messages(self) -> Generator[tuple[str, bytes]]:
        """Yield topic and bytes of each message on the chosen topics: those that the library reads, then the others."""
        from rosbags.rosbag2 import Reader  # not before a recording is read: it takes 20 ms

        try:
            if any(_has_log(file) for file in self._files()):  # which the library does not read
                raise DamagedError('its recorder was killed, and the last messages are in its write-ahead log')
            reader = Reader(self.path)
            reader.open()
            with closing(reader):
                self._choose({connection.topic: connection.msgtype for connection in reader.connections})
                chosen = [item for item in reader.connections if self._is_chosen(item.topic)]
                self.total = sum(connection.msgcount for connection in chosen)
                for connection, _, data in reader.messages(connections=chosen):
                    self.taken += 1
                    yield connection.topic, _plain(data)
        except BagError:
            raise
        except Exception as err:  # broken bytes lead the library to errors of many kinds
            words = ' '.join(str(err).split()).rstrip('.') or type(err).__name__
            if self.path.is_dir() and not (self.path / 'metadata.yaml').is_file():
                self._metadata = 'metadata.yaml is missing'
            elif words.startswith(METADATA_FAULTS):
                self._metadata = 'metadata.yaml is not what ros2 bag record writes'
            else:
                self._damage = words
            yield from self._salvaged()

    def _salvaged(self) -> Iterator[tuple[str, bytes]]:
        """Yield the messages after the last one that the library could read."""
        skip = self.taken
        self.total = None
        if not self.joint_topic:  # the topics of all messages decide, as those of a whole recording do
            for file in self._files():
                with suppress(DamagedError, OSError):
                    self._there.update((raw.topic, raw.msgtype) for raw in salvaged(file))
            self._choose(self._there, complete=False)
        try:
            for file in self._files():
                if file.name.endswith(COMPRESSED):
                    raise BagError(f"bag '{self.path}' cannot be read: {self._metadata or self._damage}, and its files "
                                   'are compressed', f'{_unpacking(file)}; then give that file or the directory')
                for raw in salvaged(file):
                    if not self._is_chosen(raw.topic):
                        continue
                    if skip:
                        skip -= 1
                        continue
                    self.taken += 1
                    yield raw.topic, _plain(raw.data)
            self._damage = self._damage or _hole(self._files())
        except DamagedError as err:
            self._damage = str(err)
        except OSError as err:  # no permission to read, or a disk that was taken out
            self._damage = err.strerror or str(err)

    @property
    def is_damaged(self) -> bool:
        """Whether the library failed to read the bag."""
        return bool(self._metadata or self._damage)

    def _is_chosen(self, topic: str) -> bool:
        return topic == self.joint_topic or topic in self.event_topics.values()

    def joint_states(self, raws: list[bytes], first: int) -> Iterator[JointBlock]:
        """Decode consecutive joint states; ``first`` is the number of the first one among the messages read."""
        for found in self._decoder.blocks(raws):
            if isinstance(found, cdr.CdrError):
                self._garbled(first, self.joint_topic, found)
                first += 1
            else:
                self._joint_states += len(found.stamp_ns)
                first += len(found.stamp_ns)
                yield found

    def event(self, topic: str, raw: bytes) -> Iterator[CaptureEvent]:
        """Decode an event; record a fault if the message is not an event."""
        try:
            yield cdr.capture_event(raw).heard_on(topic)
        except cdr.CdrError as err:
            self._garbled(self.taken, topic, err)
        except ValueError as err:
            self._leave_out(f"an event on '{topic}' is left out: {err}",
                            "publish 'capture' or 'release' as its frame_id; of this recording give --capture-time or "
                            '--release-time, or let --detect look for it in the signals')

    def _garbled(self, number: int, topic: str, err: Exception) -> None:
        self._leave_out(f"message {number} (on '{topic}') is garbled: {err}", 'correct the publisher and record again')

    def _leave_out(self, fault: str, remedy: str) -> None:
        self._fault = self._fault or (fault, remedy)
        self._left_out += 1

    def check(self) -> None:
        """Raise BagError if a fault was found, or no joint state."""
        count = f"{self._joint_states} messages on '{self.joint_topic}' were read"
        missing = [name for name in self.topics.events if name not in self.event_topics]
        if self.is_damaged and self.topics.events_required and missing:
            count += f", and none on '{missing[0]}' ({_event_topics(self._there)})"
        if self._metadata and not self._damage and not self.joint_topic:
            self._choose(self._there)  # raises what it says of a whole recording without the topic
        if self.is_damaged and self._joint_states == 0:
            raise BagError(f"bag '{self.path}' cannot be read: {self._damage or self._metadata}",
                           'check that it is a rosbag2 recording and copied whole')
        if self._damage:
            raise BagError(f"bag '{self.path}' is damaged: {self._damage}; {count}",
                           "repair it with 'ros2 bag reindex' or 'mcap recover', or record again")
        if self._fault is not None:
            fault, remedy = self._fault
            more = f' (and {self._left_out - 1} more)' if self._left_out > 1 else ''
            raise BagError(f"bag '{self.path}': {fault}{more}; {count}", remedy)
        if self._metadata:
            raise BagError(f"bag '{self.path}': {self._metadata}; its data are whole: {count}",
                           "make it with 'ros2 bag reindex'")
        if self._joint_states == 0:
            raise BagError(f"bag '{self.path}' has no message on '{self.joint_topic}'",
                           'record while the joint states are published')

    def _choose(self, there: dict[str, str], *, complete: bool = True) -> None:
        """Choose the topics to be read among ``there`` (topic -> type). complete: these are all topics."""
        if not self.joint_topic:
            found = _resolve(self.topics.joint_states, there, JOINT_STATE, self.path, '--joint-states')
            if found is None and complete:
                listed = ', '.join(f'{name} ({kind})' for name, kind in sorted(there.items())) or 'none'
                raise BagError(f"bag '{self.path}' has no topic '{self.topics.joint_states}'",
                               f'name one with --joint-states NAME; the topics there are: {listed}')
            self.joint_topic = found or ''
        spaces = (self.joint_topic.rpartition('/')[0], '')
        for name in self.topics.events:
            near = there if name.startswith('/') else {
                topic: kind for topic, kind in there.items() if topic.rpartition('/')[0] in spaces}
            event = _resolve(name, near, HEADER, self.path, '--capture-event')
            if event is not None:
                self.event_topics[name] = event
            elif complete and self.topics.events_required:
                raise BagError(f"bag '{self.path}' has no topic '{name}'", _event_topics(there))


def _plain(data: bytes) -> bytes:
    """Return a message as it was published: metadata.yaml alone says that each one is compressed."""
    if data.startswith(PACKED):
        with suppress(zstd.ZstdError, EOFError):
            return zstd.decompress(data)
    return data


def _hole(files: list[Path]) -> str:
    """Return which file of a split recording, NAME_0, NAME_1 and so on, is missing between the others; '': none."""
    parts = [re.fullmatch(r'(.*_)(\d+)(\.\w+)', file.name) for file in files]
    found = sorted((part[1], part[3], int(part[2])) for part in parts if part)
    for (*kind, number), (*following, another) in pairwise(found):
        if kind == following and another > number + 1:
            return f"file '{kind[0]}{number + 1}{kind[1]}' of the recording is missing"
    return ''


def _event_topics(there: dict[str, str]) -> str:
    listed = ', '.join(sorted(topic for topic, kind in there.items() if kind == HEADER)) or 'none'
    return f'the event topics there are: {listed}'


def _unpacking(file: Path) -> str:
    """Return what to do with a compressed file. zstd takes the name's end .zstd only where it writes to stdout."""
    return f"decompress it with 'zstd -dc {file.name} > {file.stem}'"


def _resolve(wanted: str, there: dict[str, str], kind: str, path: Path, option: str) -> str | None:
    """Find a topic by its name, in any namespace when that is unambiguous; option: of the programs, to name one."""
    exact = wanted if wanted.startswith('/') else '/' + wanted
    names = [name for name in there if name in (wanted, exact)]
    if not names and not wanted.startswith('/'):
        names = [name for name in there if name.endswith(exact)]
    if not names:
        return None
    if len(names) > 1:
        raise BagError(f"bag '{path}' has several topics '{wanted}': {', '.join(sorted(names))}",
                       f'choose one: {option} {min(names)}')
    if there[names[0]] != kind:
        raise BagError(f"topic '{names[0]}' in bag '{path}' is {there[names[0]]}, not {kind}",
                       'name another topic, or record the right type')
    return names[0]
