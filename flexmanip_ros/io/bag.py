"""Recordings (rosbag2, sqlite3 or mcap) -> the messages that the identifier takes, in recorded order."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from rosbags.rosbag2 import Reader

from flexmanip_ros.errors import BagError
from flexmanip_ros.io import cdr, salvage
from flexmanip_ros.types import CaptureEvent, JointBlock, JointRecord

JOINT_STATE = 'sensor_msgs/msg/JointState'
HEADER = 'std_msgs/msg/Header'
BLOCK = 2048
"""Messages decoded at once at most: 2 s at 1 kHz, half a megabyte. Larger ones are no faster."""

Progress = Callable[[int, int | None], None]
"""Called with messages read and messages there (None when the recording does not say)."""


@dataclass(frozen=True)
class Topics:
    """Where to look. Without a leading slash a name is found in any one namespace."""

    joint_states: str = 'joint_states'
    events: tuple[str, ...] = ('capture_event', 'capture_detected')
    events_required: bool = False


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

    Joint states come in blocks of up to ``BLOCK`` messages; a block ends before an event and where names or array
    lengths change. Of a damaged recording everything before the fault is yielded, then BagError says what is
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
                if len(waiting) < BLOCK:
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


def event_topics(path: str | Path, topics: Topics | None = None) -> tuple[str, ...]:
    """Return the topics of events that a bag has, with or without messages on them.

    Of a bag that cannot be opened as it is the messages are looked through. Nothing is raised: reading it will say what
    is wrong.
    """
    recording: _Recording | None = None
    with suppress(BagError):
        recording = _Recording(Path(path), topics or Topics())
        with closing(recording.messages()) as messages:
            for _ in messages:
                if not recording.is_damaged:  # every topic is known from the start
                    break
    return () if recording is None else recording.event_topics


class _Recording:
    """One pass over one bag, and what was wrong on the way."""

    def __init__(self, path: Path, topics: Topics) -> None:
        self.path = path
        self.topics = topics
        self.joint_topic = ''
        self.taken = 0
        """Messages on the chosen topics."""
        self.total: int | None = None
        self._kinds: dict[str, str] = {}
        self._damage = ''
        self._faults: list[str] = []
        self._joint_states = 0
        self._layout: cdr.Layout | None = None
        self._run = BLOCK
        """Messages that are tried to be decoded at once: few where the names change often."""
        try:
            self._look()
        except OSError as err:
            raise BagError(f"bag '{path}' cannot be read: {err.strerror}", 'check the permissions') from err

    def _look(self) -> None:
        """Say at once what cannot be a bag."""
        path = self.path
        if not path.exists():
            raise BagError(f"bag '{path}' does not exist", 'check the path')
        if path.suffix == '.bag':
            raise BagError(f"'{path}' is a ROS 1 bag", 'convert it: rosbags-convert --src FILE --dst FOLDER')
        if path.is_file() and path.suffix not in ('.mcap', '.db3'):
            raise BagError(f"'{path}' is not a bag", 'give a rosbag2 directory, an .mcap or a .db3 file')
        if path.is_dir() and not (path / 'metadata.yaml').is_file() and not self._files():
            raise BagError(f"directory '{path}' is not a bag: metadata.yaml and recording are missing",
                           'give the directory that ros2 bag record made')
        if any(file.stat().st_size == 0 for file in self._files()):
            raise BagError(f"bag '{path}' is empty", 'record again; the recorder was stopped before it wrote')

    def _files(self) -> list[Path]:
        if self.path.is_file():
            return [self.path]
        return sorted(file for file in self.path.iterdir() if file.suffix in ('.mcap', '.db3'))

    def messages(self) -> Generator[tuple[str, bytes]]:
        """Yield topic and bytes of the messages on the chosen topics: what the library reads, then what is left."""
        try:
            reader = Reader(self.path)
            reader.open()
            with closing(reader):
                self._choose({connection.topic: connection.msgtype for connection in reader.connections})
                chosen = [item for item in reader.connections if item.topic in self._kinds]
                self.total = sum(connection.msgcount for connection in chosen)
                for connection, _, data in reader.messages(connections=chosen):
                    self.taken += 1
                    yield connection.topic, data
        except BagError:
            raise
        except Exception as err:  # broken bytes lead the library to errors of many kinds
            self._damage = ' '.join(str(err).split()).rstrip('.') or type(err).__name__
            yield from self._salvaged()

    def _salvaged(self) -> Iterator[tuple[str, bytes]]:
        """Read on from where the library gave up."""
        skip = self.taken
        self.total = None
        try:
            for file in self._files():
                for raw in salvage.messages(file):
                    if not self._choose({raw.topic: raw.msgtype}, complete=False):
                        continue
                    if skip:
                        skip -= 1
                        continue
                    self.taken += 1
                    yield raw.topic, raw.data
        except salvage.DamagedError as err:
            self._damage = str(err)

    @property
    def is_damaged(self) -> bool:
        """Whether the library gave up on it."""
        return bool(self._damage)

    @property
    def event_topics(self) -> tuple[str, ...]:
        """Topics of events that were seen so far."""
        return tuple(sorted(topic for topic, kind in self._kinds.items() if kind == HEADER))

    def joint_states(self, raws: list[bytes], first: int) -> Iterator[JointBlock]:
        """Decode joint states that follow one another, the first of which is message number ``first``."""
        done = 0
        while done < len(raws):
            tried = raws[done:done + self._run]
            try:
                block, self._layout = cdr.joint_block(tried, self._layout)
            except (cdr.CdrError, UnicodeDecodeError) as err:
                self._faults.append(f"message {first + done} (on '{self.joint_topic}') is garbled: {err}")
                done += 1
                continue
            count = len(block.stamp_ns)
            self._run = min(8 * self._run, BLOCK) if count == len(tried) else max(count, 1)
            self._joint_states += count
            done += count
            yield block

    def event(self, topic: str, raw: bytes) -> Iterator[CaptureEvent]:
        """Decode an event; note one that is none."""
        try:
            yield cdr.capture_event(raw)
        except (cdr.CdrError, UnicodeDecodeError) as err:
            self._faults.append(f"message {self.taken} (on '{topic}') is garbled: {err}")
        except ValueError as err:
            self._faults.append(f"an event on '{topic}' is neither capture nor release: {err}")

    def check(self) -> None:
        """Raise BagError with what was wrong."""
        count = f"{self._joint_states} messages on '{self.joint_topic}' were read"
        if self._damage and self._joint_states == 0:
            raise BagError(f"bag '{self.path}' cannot be read: {self._damage}",
                           'check that it is a rosbag2 recording and copied whole')
        if self._damage:
            raise BagError(f"bag '{self.path}' is damaged: {self._damage}; {count}",
                           "repair it with 'ros2 bag reindex' or 'mcap recover', or record again")
        if self._faults:
            more = f' (and {len(self._faults) - 1} more)' if len(self._faults) > 1 else ''
            raise BagError(f"bag '{self.path}': {self._faults[0]}{more}; {count}",
                           'correct the publisher and record again')
        if self._joint_states == 0:
            raise BagError(f"bag '{self.path}' has no message on '{self.joint_topic}'",
                           'record while the joint states are published')

    def _choose(self, there: dict[str, str], *, complete: bool = True) -> bool:
        """Choose the topics that are read; return whether one of ``there`` is among them."""
        if not self.joint_topic:
            found = _resolve(self.topics.joint_states, there, JOINT_STATE, self.path)
            if found is None and complete:
                listed = ', '.join(f'{name} ({kind})' for name, kind in sorted(there.items())) or 'none'
                raise BagError(f"bag '{self.path}' has no topic '{self.topics.joint_states}'",
                               f'the topics there are: {listed}')
            if found is not None:
                self.joint_topic = found
                self._kinds[found] = JOINT_STATE
        spaces = (self.joint_topic.rpartition('/')[0], '')
        for name in self.topics.events:
            near = there if name.startswith('/') else {
                topic: kind for topic, kind in there.items() if topic.rpartition('/')[0] in spaces}
            event = _resolve(name, near, HEADER, self.path)
            if event is not None:
                self._kinds[event] = HEADER
            elif complete and self.topics.events_required:
                listed = ', '.join(sorted(topic for topic, kind in there.items() if kind == HEADER)) or 'none'
                raise BagError(f"bag '{self.path}' has no topic '{name}'", f'the event topics there are: {listed}')
        return any(topic in self._kinds for topic in there)


def _resolve(wanted: str, there: dict[str, str], kind: str, path: Path) -> str | None:
    """Find a topic by its name, in any namespace when that is unambiguous."""
    exact = wanted if wanted.startswith('/') else '/' + wanted
    names = [name for name in there if name in (wanted, exact)]
    if not names and not wanted.startswith('/'):
        names = [name for name in there if name.endswith(exact)]
    if not names:
        return None
    if len(names) > 1:
        raise BagError(f"bag '{path}' has several topics '{wanted}': {', '.join(sorted(names))}",
                       'give the full name with its leading slash')
    if there[names[0]] != kind:
        raise BagError(f"topic '{names[0]}' in bag '{path}' is {there[names[0]]}, not {kind}",
                       'name another topic, or record the right type')
    return names[0]
